"""Simulated recordings with exact truth, in the recording format: `write_synthetic`.

The people, rooms, sensors and detections are those of `samples.py`; here they are drawn in full, as a colour and a
depth camera at their native resolutions see them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from tqdm import tqdm

from understudy.camera import Camera, RGBDCamera
from understudy.errors import MissingExtraError, UnderstudyError, one_of
from understudy.files import write_atomically
from understudy.geometry import rigid
from understudy.recordings.folder import INFO
from understudy.recordings.truth import Truth, TruthPerson
from understudy.recordings.writer import FolderWriter
from understudy.registration import register
from understudy.synthetic import view
from understudy.synthetic.actors import Moment, Motions, make_actor
from understudy.synthetic.bodies import BodyBank, load_bank
from understudy.synthetic.detections import DetectorConfig, detect
from understudy.synthetic.draw import Draw
from understudy.synthetic.room import Room, View, look, make_room, shade
from understudy.synthetic.samples import FROM_BEHIND, LEAST_SEEN, hidden_joints
from understudy.synthetic.scene import SceneConfig
from understudy.synthetic.sensors import Rig
from understudy.synthetic.surfels import neighbours
from understudy.types import Frame, Keypoints2D

SETTINGS: Final = "synthetic.json"
"""Name of the file beside recording.json that says how the recording was made."""

IMAGES: Final = MappingProxyType(
    {
        "kinect2": ((960, 540, 540.0), (512, 424, 365.0)),
        "azure": ((1280, 720, 610.0), (640, 576, 504.0)),
        "realsense": ((848, 480, 615.0), (848, 480, 425.0)),
    }
)
"""Sensor -> width, height and focal length (pixels) of the colour and of the depth camera."""

MOST_PEOPLE: Final = 6
_PIXEL_M: Final = 0.0206
"""Pixel of the simulated network input at the person, metres; `Rig.degrade` is meant for such pixels."""
_REACH: Final = 1.0
"""Metres by which people stay nearer than the sensor's range."""
_NOTE: Final = "simulated; limb joints are centres of rotation, the neck is the midpoint of the shoulders"


@dataclass(frozen=True)
class RecordingConfig:
    """What is recorded, and with what."""

    sensor: str = "kinect2"
    bodies: str = "anny"
    """kind of bodies, see `bodies.load_bank`"""
    body_count: int = 60
    body_seed: int = 1001
    """the bank of bodies; training uses others"""
    people: int | None = None
    """in each frame; None: one to three"""
    sequence: bool = False
    """people move, the camera stands still; otherwise every frame is another scene"""
    fps: float = 10.0
    """of a sequence"""
    activity: str | None = None
    """what everybody does; None: all kinds of things"""
    bvh: str | None = None
    """folder of motion capture to take the movements from"""
    registered: bool = False
    """depth in the colour image's pixels"""
    scene: SceneConfig = field(default_factory=lambda: SceneConfig(distance_m=(1.5, 5.0)))
    detector: DetectorConfig = field(default_factory=DetectorConfig)

    def __post_init__(self) -> None:
        if self.sensor not in IMAGES:
            raise UnderstudyError(f"sensor {self.sensor!r}: must be {one_of(IMAGES)}")
        if self.people is not None and not 1 <= self.people <= MOST_PEOPLE:
            raise UnderstudyError(f"people must be 1 to {MOST_PEOPLE}, got {self.people}")
        if self.body_count < 1:
            raise UnderstudyError(f"body_count must be above 0, got {self.body_count}")
        if not (self.fps > 0 and np.isfinite(self.fps)):
            raise UnderstudyError(f"fps must be above 0, got {self.fps}")


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """A frame, who is in it, and what a detector says of them."""

    frame: Frame
    truth: tuple[TruthPerson, ...]
    """everybody of whom a joint is inside the colour image"""
    keypoints: list[Keypoints2D]
    """in no particular order; people who are hardly visible are missing"""


def write_synthetic(
    out: str | Path,
    frames: int = 40,
    seed: int = 0,
    config: RecordingConfig | None = None,
    *,
    bank: BodyBank | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Writes a simulated recording; the same one for the same arguments.

    bank: bodies to use in place of those that `config` names. overwrite: a recording that is there is replaced; one
    whose writing was interrupted (it has no recording.json) always is. Returns the folder.
    """
    config = config or RecordingConfig()
    out = Path(out)
    studio = Studio(frames, seed, config, bank)
    interrupted = (out / SETTINGS).exists() and not (out / INFO).exists()
    options: dict[str, Any] = {"fps": config.fps} if config.sequence else {}
    writer = FolderWriter(out, studio.camera, overwrite=overwrite or interrupted, **options)
    settings = {"frames": frames, "seed": seed, **asdict(config)}
    write_atomically(out / SETTINGS, json.dumps(settings, indent=1))
    truth: dict[int, tuple[TruthPerson, ...]] = {}
    keypoints: dict[int, list[Keypoints2D]] = {}
    steps: Iterable[int] = tqdm(range(frames), unit="frame", disable=not progress)
    for index in steps:
        made = studio.frame(index)
        writer.write(made.frame)
        truth[index], keypoints[index] = made.truth, made.keypoints
    writer.close(Truth(truth, _NOTE), keypoints)
    return out


class Studio:
    """Makes the frames of one simulated recording, in any order."""

    def __init__(self, frames: int, seed: int = 0, config: RecordingConfig | None = None, bank: BodyBank | None = None):
        if frames < 1:
            raise UnderstudyError(f"frames must be above 0, got {frames}")
        self.frames, self.seed, self.config = frames, seed, config or RecordingConfig()
        self.motions = Motions(self.config.activity, self.config.bvh)
        self.bank = bank or _bank(self.config)
        self._near = neighbours(self.bank.points.mean(0), self.bank.normals.mean(0))
        draw = self._draw(0)
        self.rig = Rig(draw, (self.config.sensor,), 1)
        self.raw_camera = _cameras(draw, self.config.sensor, self.rig)
        registered = RGBDCamera.aligned(self.raw_camera.color)
        self.camera = registered if self.config.registered else self.raw_camera
        self._sequence = self._room(self._draw(1), frames) if self.config.sequence else None

    def _draw(self, number: int) -> Draw:
        return Draw((self.seed * 1_000_003 + 500_000 + number) % 2**63)

    def _room(self, draw: Draw, frames: int) -> Room:
        count = self.config.people or 1 + int(torch.bucketize(draw.uniform(0, 1, 1), torch.tensor([0.5, 0.85])))
        actors = []
        for _ in range(count):
            rotations, activity = self.motions.draw(draw, frames, self.config.fps)
            actors.append(make_actor(draw, self.bank, self._near, rotations, activity, self.config.fps))
        scene = self.config.scene
        near, far = scene.distance_m
        limit = max(near, float(self.rig.max_z) - _REACH)
        scene = replace(scene, distance_m=(near, min(far, limit)))
        return make_room(draw, scene, self.raw_camera.color, actors)

    def __iter__(self) -> Iterator[SyntheticFrame]:
        return (self.frame(i) for i in range(self.frames))

    @torch.no_grad()
    def frame(self, index: int) -> SyntheticFrame:
        """Frame number `index`."""
        draw = self._draw(2 + index)
        room = self._sequence or self._room(draw, 1)
        moments = room.moments(index if self._sequence else 0)
        R, center = room.cameras.R_cam_world[0], room.cameras.center[0]
        seen = look(room, moments, self.raw_camera.color, R, center)
        color = _photo(draw, shade(room, seen, R, center))
        depth = self._depth(draw, room, moments)
        time = index / self.config.fps if self._sequence else None
        frame = Frame(color, depth, self.raw_camera, index, time)
        if self.config.registered:
            frame = Frame(color, register(frame).depth.z, self.camera, index, time)
        joints = room.cameras.to_cam(torch.stack([m.joints for m in moments]))
        camera = self.camera.color
        truth = [_truth(i, joints[i], m, room, seen, camera) for i, m in enumerate(moments)]
        keypoints = _detections(draw, self.config.detector, truth, moments, room, camera)
        return SyntheticFrame(frame, tuple(t for t in truth if t.in_view.any()), keypoints)

    def _depth(self, draw: Draw, room: Room, moments: list[Moment]) -> Float32[np.ndarray, "h w"]:
        """What the depth camera measures, metres."""
        T = self.raw_camera.T_color_depth
        R_world = room.cameras.R_cam_world[0]
        R = torch.tensor(T[:3, :3].T, dtype=torch.float32) @ R_world
        center = room.cameras.center[0] + R_world.T @ torch.tensor(T[:3, 3], dtype=torch.float32)
        camera = self.raw_camera.depth
        seen = look(room, moments, camera, R, center)
        dark = (seen.values[..., 3] > 0.5) & (seen.people < seen.boxes)
        distance = room.cameras.to_cam(moments[0].joints[None])[0, 1, 2]
        finer = round(_PIXEL_M * camera.fx / float(distance.clamp(0.5, 8.0)))
        measured = self.rig.degrade(draw, seen.depth[None], dark[None], max(1, finer))[0]
        return measured.numpy().astype(np.float32)


def _bank(config: RecordingConfig) -> BodyBank:
    try:
        return load_bank(config.bodies, config.body_count, config.body_seed)
    except ImportError as e:
        raise MissingExtraError(f"Bodies of kind {config.bodies!r}", "train") from e


def _cameras(draw: Draw, sensor: str, rig: Rig) -> RGBDCamera:
    """The sensor's cameras, with the small differences that units have."""
    made = []
    for width, height, f in IMAGES[sensor]:
        f = f * float(draw.uniform(0.985, 1.015, 1))
        cx, cy = (draw.normal(2) * 3.0 + torch.tensor([width - 1, height - 1]) / 2).tolist()
        made.append(Camera(width, height, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])))
    c, s = np.cos(float(rig.pitch)), np.sin(float(rig.pitch))
    R_color_depth = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])
    return RGBDCamera(made[0], made[1], rigid(R_color_depth, rig.baseline[0].double().numpy()))


def _photo(draw: Draw, color: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """What a colour camera makes of it: slightly soft, and noisy."""
    image = cv2.GaussianBlur(color.numpy(), (3, 3), 0.6) + 0.008 * draw.normal(*color.shape).numpy()
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def _truth(
    id: int, joints: Float[Tensor, "18 3"], moment: Moment, room: Room, seen: View, camera: Camera
) -> TruthPerson:
    """One person's truth. joints: colour camera's frame."""
    p = joints.double().numpy()
    uv = camera.project(p)
    in_view = camera.contains(uv)
    u, v = np.rint(np.where(in_view[:, None], uv, 0.0)).astype(int).T
    surface, person = seen.depth[v, u], seen.people[v, u]
    hidden, _ = hidden_joints(surface[None], person[None], joints[None, :, 2])
    palms = (moment.palms @ room.cameras.R_cam_world[0].T).double().numpy()
    palms /= np.linalg.norm(palms, axis=1, keepdims=True)
    hands = camera.contains(camera.project(room.cameras.to_cam(moment.hands[None])[0].double().numpy()))
    return TruthPerson(
        id,
        p,
        in_view,
        hidden[0].numpy() & in_view,
        {"left": palms[0], "right": palms[1]},
        {"left": bool(hands[0]), "right": bool(hands[1])},
    )


def _detections(
    draw: Draw, config: DetectorConfig, truth: list[TruthPerson], moments: list[Moment], room: Room, camera: Camera
) -> list[Keypoints2D]:
    """Whom a detector finds, in random order."""
    joints = torch.from_numpy(np.stack([t.keypoints for t in truth])).float()
    hidden = torch.from_numpy(np.stack([t.occluded for t in truth]))
    in_view = torch.from_numpy(np.stack([t.in_view for t in truth]))
    middle = joints[:, [1, 8, 11]].mean(1)
    root_z = middle.norm(dim=-1)
    R = view.rotation_to(middle)
    xy = view.columns(joints @ R.mT, root_z)[..., :2]
    other_xy = torch.full_like(xy, torch.nan)
    if len(truth) > 1:
        apart = torch.cdist(middle, middle).fill_diagonal_(torch.inf)
        other_xy = view.columns(joints[apart.argmin(1)] @ R.mT, root_z)[..., :2]
    to_camera = torch.nn.functional.normalize(room.cameras.center - torch.stack([m.joints[1] for m in moments]), dim=-1)
    front = (torch.stack([m.facing for m in moments]) * to_camera).sum(-1)
    found = detect(draw, config, xy, root_z, hidden, in_view, front < FROM_BEHIND, other_xy)
    rays = torch.cat([found[..., :2] / root_z[:, None, None], torch.ones(*hidden.shape, 1)], -1) @ R
    uv = camera.project(rays.double().numpy())
    seen = (in_view & ~hidden).sum(1) >= LEAST_SEEN
    order = torch.randperm(len(truth), generator=draw.generator).tolist()
    rows = found[..., 2].double().numpy()
    return [Keypoints2D.where(uv[i], rows[i]) for i in order if seen[i]]
