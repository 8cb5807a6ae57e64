"""Methods that the voxel network must beat, as lifters (numpy): naive lifting with offsets, and a small MLP.

    python benchmarks/paper_tables.py --fit-offsets    or    python -m understudy.baselines RECORDING...

fits the offsets of `NaiveOffsetLifter` anew on recordings with truth (simulated ones: `understudy synth`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float, Float32

from understudy.assembly import of_network
from understudy.errors import MissingExtraError, ModelFileError, UnderstudyError
from understudy.floor import Floor
from understudy.lifting import NaiveLifter
from understudy.skeleton import FLIP, JOINTS, N_JOINTS
from understudy.types import Keypoints2D, Person, RegisteredFrame
from understudy.voxel_lifting import VoxelLifter
from understudy.voxelposenet.predictor import Prediction, Predictor
from understudy.voxels import CELL, CELLS, EMPTY, HALF, PersonView

if TYPE_CHECKING:
    from understudy.recordings.base import Recording

# --- naive lifting with offsets ---

OFFSETS_M: Final[Mapping[str, float]] = {
    "nose": 0.007, "neck": 0.121, "shoulder": 0.070, "elbow": 0.052, "wrist": 0.029,
    "hip": 0.124, "knee": 0.074, "ankle": 0.052, "eye": 0.010, "ear": 0.011,
}  # fmt: skip
"""Kind of joint -> metres along the ray from the surface that naive lifting finds to the joint. Made by
`python benchmarks/paper_tables.py --fit-offsets --frames 20`: simulated recordings with the training's bodies.
"""


class NaiveOffsetLifter:
    """Naive lifting, each joint then moved away from the camera along its ray by a constant of its kind.

    Confidence and sigma stay those of naive lifting.
    """

    def __init__(self, min_score: float = 0.2, offsets_m: Mapping[str, float] = OFFSETS_M):
        self._naive = NaiveLifter(min_score)
        self._offset = np.array([offsets_m[kind(name)] for name in JOINTS])

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        return [self._moved(p) for p in self._naive.lift(frame, people)]

    def _moved(self, person: Person) -> Person:
        ray = person.keypoints / np.linalg.norm(person.keypoints, axis=1, keepdims=True)
        return replace(person, keypoints=person.keypoints + self._offset[:, None] * ray)


def kind(joint: str) -> str:
    """'left_hip' -> 'hip'."""
    return joint.rpartition("_")[2]


def fit_offsets(
    naive: Float[np.ndarray, "n 18 3"], truth: Float[np.ndarray, "n 18 3"], visible: Bool[np.ndarray, "n 18"]
) -> dict[str, float]:
    """Offsets (metres) by kind of joint: the median, over visible joints that were lifted, of how much farther along
    the ray of the lifted joint the true one lies. Left and right share one. A kind that nobody shows gets 0.
    """
    ray = naive / np.linalg.norm(naive, axis=-1, keepdims=True)
    farther = ((truth - naive) * ray).sum(-1)
    use = visible & np.isfinite(farther)
    kinds = np.array([kind(name) for name in JOINTS])
    chosen = {k: farther[:, kinds == k][use[:, kinds == k]] for k in dict.fromkeys(kinds.tolist())}
    return {k: round(float(np.median(v)), 3) if v.size else 0.0 for k, v in chosen.items()}


def fit_offsets_on(recordings: Iterable[Recording]) -> dict[str, float]:
    """`fit_offsets` with the true 2D positions of visible joints, so that nothing but the depth decides."""
    from understudy.registration import register

    naive, truth, visible = [], [], []
    lifter = NaiveLifter()
    for recording in recordings:
        if recording.truth is None:
            raise UnderstudyError(f"{recording.path}: offsets are fitted to the truth, but there is no truth.json")
        for frame in recording:
            registered = register(frame)
            people = recording.truth.frames.get(frame.index, ())
            clear = [p.in_view & ~p.occluded & np.isfinite(p.keypoints).all(1) for p in people]
            seen = [
                Keypoints2D.where(registered.camera.project(p.keypoints), c.astype(float))
                for p, c in zip(people, clear, strict=True)
            ]
            naive += [p.keypoints for p in lifter.lift(registered, seen)]
            truth += [p.keypoints for p in people]
            visible += clear
    shape = (-1, N_JOINTS, 3)
    return fit_offsets(
        np.array(naive).reshape(shape), np.array(truth).reshape(shape), np.array(visible, bool).reshape(-1, N_JOINTS)
    )


# --- the MLP ---

FORMAT: Final = "understudy-mlp/1"
PER_JOINT: Final = 8
N_FEATURES: Final = N_JOINTS * PER_JOINT + 2
_WINDOW = 2  # cells about a keypoint in which depths are looked for
_REACH = 2.5  # cells


def grid_depths(
    depth: Float32[np.ndarray, "n 2 64 64"], xy: Float[np.ndarray, "n 18 2"]
) -> Float32[np.ndarray, "n 18 3"]:
    """The 3 valid depths of the nearest surface that are nearest to each keypoint (view coordinates), nearest first;
    NaN where there are fewer within 10 cm.
    """
    cell = (xy + HALF) / CELL - 0.5
    step = np.arange(-_WINDOW, _WINDOW + 1)
    at = np.rint(np.nan_to_num(cell, nan=-1e3).clip(-1e3, 1e3)).astype(np.int64)
    column, row = at[..., 0, None, None] + step, at[..., 1, None, None] + step[:, None]
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    person = np.arange(len(depth))[:, None, None, None]
    z = depth[person, 0, row.clip(0, CELLS - 1), column.clip(0, CELLS - 1)]
    away = (column - cell[..., 0, None, None]) ** 2 + (row - cell[..., 1, None, None]) ** 2
    away = np.where(inside & (z < EMPTY - 0.1) & (away <= _REACH**2), away, np.inf)
    z, away = z.reshape(*z.shape[:2], -1), away.reshape(*away.shape[:2], -1)
    order = np.argsort(away, axis=-1, kind="stable")[..., :3]
    found = np.isfinite(np.take_along_axis(away, order, -1))
    return np.where(found, np.take_along_axis(z, order, -1), np.nan).astype(np.float32)


def mlp_input(
    depth: Float32[np.ndarray, "n 2 64 64"],
    keypoints: Float32[np.ndarray, "n 18 3"],
    root_z: Float32[np.ndarray, "n 1"],
) -> tuple[Float32[np.ndarray, "n features"], Float32[np.ndarray, "n 18 3"]]:
    """What the MLP sees of the network's inputs, and the naive estimate that it corrects (view coordinates).

    Per joint: x, y, score, found; nearest depth and median of the nearest 3 (both relative to the root), and whether
    they are there. Then the root's depth and its inverse.
    """
    found = keypoints[..., 2] > 0
    z = grid_depths(depth, np.where(found[..., None], keypoints[..., :2], np.nan))
    one, three = np.isfinite(z[..., 0]), np.isfinite(z).all(-1)
    nearest = np.where(one, z[..., 0], 0.0)
    median = np.where(three, np.median(np.where(three[..., None], z, 0.0), -1), nearest)
    joints = np.stack([*np.moveaxis(keypoints, -1, 0), found, nearest, median, one, three], -1)
    features = np.concatenate([joints.reshape(len(keypoints), -1), root_z, 1 / root_z], 1).astype(np.float32)
    naive = np.concatenate([keypoints[..., :2], median.clip(-1, 1)[..., None]], -1) * found[..., None]
    return features, naive.astype(np.float32)


@dataclass(frozen=True, eq=False)
class MlpOutput:
    """View coordinates, as the network's."""

    joints: Float[np.ndarray, "n 18 3"]
    sigma: Float[np.ndarray, "n 18"]
    """metres: 68 % of errors are smaller"""
    confidence: Float[np.ndarray, "n 18"]


class MlpPredictor(Predictor):
    """The trained MLP (`voxelposenet.mlp.train_mlp`), by plain matrix products, in the network's place."""

    def __init__(self, weights: Path):
        try:
            from safetensors import SafetensorError, safe_open
        except ImportError as e:
            raise MissingExtraError("the MLP baseline", "train") from e
        try:
            with safe_open(weights, "np") as f:
                words = f.metadata() or {}
                self._w = {k: f.get_tensor(k) for k in f.keys()}  # noqa: SIM118
        except (SafetensorError, OSError) as e:
            raise ModelFileError(f"{weights}: not a readable safetensors file: {e}") from e
        if words.get("format") != FORMAT:
            raise ModelFileError(f"{weights}: format is {words.get('format')!r}, must be {FORMAT!r}")
        self.about: Final[dict[str, str]] = words
        self._blocks = int(words["blocks"])

    def __call__(
        self,
        views: list[PersonView],
        depth: Float32[np.ndarray, "n 2 64 64"],
        keypoints: Float32[np.ndarray, "n 18 3"],
        floor: Floor | None = None,
    ) -> list[Prediction]:
        if not views:
            return []
        out = self.forward(*mlp_input(depth, keypoints, np.array([[v.root_z] for v in views], np.float32)))
        spread = np.repeat(out.sigma[..., None] / np.sqrt(3), 3, -1)
        found = (keypoints[..., 2] > 0).astype(np.float64)
        columns = (out.joints, spread, out.sigma, out.confidence, found)
        return [Prediction(*person) for person in zip(*columns, strict=True)]

    def forward(self, features: Float32[np.ndarray, "n f"], naive: Float32[np.ndarray, "n 18 3"]) -> MlpOutput:
        """features, naive: `mlp_input`."""
        x = self._linear("first", (features - self._w["mean"]) / self._w["std"])
        for i in range(self._blocks):
            x = x + self._linear(f"blocks.{i}.2", np.maximum(self._linear(f"blocks.{i}.0", np.maximum(x, 0)), 0))
        x = np.maximum(x, 0)
        joints = naive + self._linear("joints", x).reshape(naive.shape)
        log_sigma, logit = self._linear("judge", x).reshape(-1, 2, N_JOINTS).transpose(1, 0, 2).astype(np.float64)
        return MlpOutput(joints.astype(np.float64), np.exp(log_sigma), 1 / (1 + np.exp(-logit)))

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return np.asarray(x @ self._w[f"{name}.weight"].T + self._w[f"{name}.bias"])


class MlpLifter(VoxelLifter):
    """2D keypoints and the depths under them -> 3D joints, by the MLP. Roots and views are those of the network; no
    assembly, no second looks.
    """

    def __init__(self, weights: Path, min_score: float = 0.2):
        self.min_score, self.second_looks = min_score, 0
        self.predictor = MlpPredictor(weights)
        self._assemble = of_network


def mirrored(keypoints: Float[np.ndarray, "n 18 c"]) -> Float[np.ndarray, "n 18 c"]:
    """People seen in a mirror: x changes its sign, left and right their names."""
    out = keypoints[:, FLIP].copy()
    out[..., 0] *= -1
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the fitted offsets."""
    from understudy import recordings

    parser = argparse.ArgumentParser(prog="python -m understudy.baselines", description=main.__doc__)
    parser.add_argument("recordings", nargs="+", type=Path, help="recordings with truth.json")
    chosen = parser.parse_args(arguments)
    print(json.dumps(fit_offsets_on(recordings.open(path) for path in chosen.recordings), indent=1))


if __name__ == "__main__":
    main()
