"""The default network in use: inputs of all people of a frame in, joints with their uncertainty out. No torch."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import expit

from understudy import runtime
from understudy.camera import Camera
from understudy.floor import Floor
from understudy.skeleton import FLIP
from understudy.types import Keypoints2D
from understudy.voxels import PersonView

WEIGHTS = "voxelposenet.onnx"


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the network says of one person, in view coordinates (understudy.voxels)."""

    joints: Float[np.ndarray, "18 3"]
    """metres"""
    spread: Float[np.ndarray, "18 3"]
    """standard deviation along the axes of the view, metres"""
    sigma: Float[np.ndarray, "18"]
    """metres: 68 % of errors are smaller"""
    confidence: Float[np.ndarray, "18"]
    """probability of being within 10 cm"""
    seen: Float[np.ndarray, "18"]
    """probability that the camera sees the joint"""

    def flipped(self) -> Prediction:
        """Left joints as right ones, and right ones as left ones."""
        return Prediction(*(getattr(self, field.name)[FLIP] for field in fields(self)))


def weights_path() -> Path:
    """The network that comes with the package."""
    return Path(str(resources.files("understudy.voxelposenet") / WEIGHTS))


class Predictor:
    """The exported network. Stateless; may be called from several threads."""

    def __init__(self, weights: Path | None = None, threads: int | None = None):
        outputs = ("joints", "spread", "head")
        self.network = runtime.load_rows(weights or weights_path(), threads=threads, outputs=outputs)

    def __call__(
        self,
        views: list[PersonView],
        depth: Float32[np.ndarray, "n 2 64 64"],
        keypoints: Float32[np.ndarray, "n 18 3"],
        floor: Floor | None = None,
    ) -> list[Prediction]:
        """depth, keypoints: of each view, as `PersonView.depth_grid` and `keypoint_input` make them. floor: of all."""
        if not views:
            return []
        root_z = np.array([[v.root_z] for v in views], np.float32)
        given = {"depth": depth, "keypoints": keypoints, "root_z": root_z}
        if "floor" in self.network.inputs:
            given["floor"] = np.stack([v.floor_plane(floor) for v in views])
        joints, spread, head = self.network(**given)
        return [
            Prediction(
                j.astype(np.float64),
                s.astype(np.float64),
                np.exp(h[:, 0].astype(np.float64)),
                expit(h[:, 1].astype(np.float64)),
                expit(h[:, 2].astype(np.float64)),
            )
            for j, s, h in zip(joints, spread, head, strict=True)
        ]


def keypoint_input(
    view: PersonView, camera: Camera, person: Keypoints2D, min_score: float
) -> Float32[np.ndarray, "18 3"]:
    """Rows (x, y, score) in view coordinates; zeros for what is not found."""
    xy = view.columns(camera, person.uv)
    use = person.found & (person.score >= min_score) & np.isfinite(xy).all(1)
    return np.where(use[:, None], np.column_stack([xy, person.score]), 0.0).astype(np.float32)
