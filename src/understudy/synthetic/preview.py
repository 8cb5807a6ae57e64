"""Pictures of simulated network input: what the network is given, and the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from understudy.drawing import Canvas, Rgb
from understudy.errors import MissingExtraError, UnderstudyError
from understudy.files import write_atomically
from understudy.skeleton import BONES, JOINTS
from understudy.synthetic.actors import Motions
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.bvh import load_folder
from understudy.synthetic.recording import RecordingConfig
from understudy.synthetic.samples import Batch, SampleConfig, Samples
from understudy.voxels import HALF

_TILE: Final = 256  # pixels: a side of the grid
_COLUMNS: Final = 3
_RIGHT: Final[Rgb] = (255, 140, 0)
_LEFT: Final[Rgb] = (60, 220, 60)
_HIDDEN: Final[Rgb] = (255, 60, 60)
_SEEN: Final[Rgb] = (255, 255, 255)
_DETECTED: Final[Rgb] = (255, 255, 0)


def samples_of(config: RecordingConfig, seed: int = 0) -> Samples:
    """Network input of the bodies, movements and the sensor that `config` names."""
    motions = Motions(config.activity, config.bvh)
    try:
        bank = load_bank(config.bodies, config.body_count, config.body_seed)
    except ImportError as e:
        raise MissingExtraError(f"Bodies of kind {config.bodies!r}", "train") from e
    activities = None if motions.activity is None else {motions.activity: 1.0}
    poses = None if config.bvh is None else torch.from_numpy(load_folder(config.bvh))
    if poses is not None and not len(poses):
        raise UnderstudyError(f"{config.bvh}: holds no readable .bvh files")
    sample_config = SampleConfig(config.scene, config.detector, (config.sensor,), activities)
    return Samples(bank, sample_config, seed, poses)


def write_preview(path: str | Path, samples: Samples, count: int = 12) -> None:
    """Draws the first samples into a PNG file."""
    if Path(path).suffix.lower() != ".png":
        raise UnderstudyError(f"{path}: the picture's name must end in .png")
    sheet = draw_sheet(samples.batch(0, count))
    write_atomically(Path(path), cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())


def draw_sheet(batch: Batch) -> UInt8[np.ndarray, "h w 3"]:
    """Each sample from the front (nearest depths, keypoints, truth) and from the person's right side of the view.

    Yellow crosses: keypoints as detected. Bones: truth, the person's left side green; red joints: hidden.
    """
    tiles = [np.hstack([_front(batch, i), _side(batch, i)]) for i in range(len(batch.depth))]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    return np.ascontiguousarray(np.vstack(rows))


def _pixel(metres: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return (metres + HALF) / (2 * HALF) * _TILE - 0.5


def _front(batch: Batch, i: int) -> UInt8[np.ndarray, "t t 3"]:
    near = batch.depth[i, 0].numpy()
    level = (255 * (1 - (near + HALF) / (2 * HALF))).clip(0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(level, cv2.COLORMAP_BONE)
    bgr[np.abs(near) >= HALF] = (60, 30, 0)
    image = cv2.cvtColor(cv2.resize(bgr, (_TILE, _TILE), interpolation=cv2.INTER_NEAREST), cv2.COLOR_BGR2RGB)
    canvas = Canvas(np.ascontiguousarray(image))
    _skeleton(canvas, _pixel(batch.joints[i, :, :2].numpy()), batch.occluded[i].numpy())
    for u, v, score in batch.keypoints[i].tolist():
        if score > 0:
            canvas.outlined_cross(_pixel(np.array([u, v])), 1.5 + 1.5 * score, _DETECTED)
    return canvas.image


def _side(batch: Batch, i: int) -> UInt8[np.ndarray, "t t 3"]:
    """Depth to the right, down as in the image: every column's nearest depth, and the truth."""
    image = np.full((_TILE, _TILE, 3), 24, np.uint8)
    for surface, color in ((batch.depth[i, 1].numpy(), (70, 70, 90)), (batch.depth[i, 0].numpy(), (150, 150, 170))):
        row, column = np.nonzero(np.abs(surface) < HALF)
        u = _pixel(surface[row, column]).round().astype(int).clip(0, _TILE - 1)
        v = ((row + 0.5) * _TILE / len(surface)).astype(int)
        image[v, u] = color
    canvas = Canvas(image)
    _skeleton(canvas, _pixel(batch.joints[i][:, [2, 1]].numpy()), batch.occluded[i].numpy())
    return canvas.image


def _skeleton(canvas: Canvas, at: Float[np.ndarray, "18 2"], hidden: np.ndarray) -> None:
    at = at.clip(-1e4, 1e4)
    for a, b in BONES:
        canvas.line(at[a], at[b], _LEFT if "left" in JOINTS[b] else _RIGHT, 1)
    for j, place in enumerate(at):
        canvas.disc(place, 2.5, _HIDDEN if hidden[j] else _SEEN)
