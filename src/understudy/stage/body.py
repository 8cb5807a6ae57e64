"""Rest bodies of random adults from anny (Apache-2.0, data CC0): skeleton, skin mesh and skinning weights.

Body frame: x forward, y to the person's left, z up; below the middle of the hips, on the ground that the bare soles
stand on. Metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from understudy.cli.common import needs_extra
from understudy.geometry import rigid
from understudy.skeleton import JOINT
from understudy.stage.kinematics import unit

SOLE: Final = 0.022
"""Thickness of the shoes' soles, metres: a bare sole is this far above the floor."""
EAR_IN: Final = 0.008
"""metres inward from the regressor's ear, as in `synthetic.body_anny`"""
SIDES: Final = ("left", "right")

_PARTS = (
    "head",
    "eye_front.L",
    "eye_front.R",
    "eye_back.L",
    "eye_back.R",
    "eye_cavity.L",
    "eye_cavity.R",
    "mouth_cavity",
    "tongue",
)
_LIMB_JOINTS = {
    "shoulder": "upperarm01",
    "elbow": "lowerarm01",
    "wrist": "wrist",
    "hip": "upperleg01",
    "knee": "lowerleg01",
    "ankle": "foot",
}
_FACE_JOINTS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear")


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A person's bones at rest."""

    labels: tuple[str, ...]
    """anny's names: `upperarm01.L` ..."""
    parents: tuple[int, ...]
    heads: Float[np.ndarray, "b 3"]
    face: Float[np.ndarray, "5 3"]
    """nose, right and left eye, right and left ear, as COCO has them"""
    T_body_hand: Mapping[str, Float[np.ndarray, "4 4"]]
    """side -> hand frame at rest: origin midway from wrist to middle knuckle, z out of the palm, x to the fingers"""
    stature_m: float

    def bone(self, name: str, side: str = "") -> int:
        """Index of a bone; side: left, right or none."""
        return self.labels.index(f"{name}.{side[0].upper()}" if side else name)

    def head(self, name: str, side: str = "") -> Float[np.ndarray, "3"]:
        """Place of a bone's head at rest."""
        return np.asarray(self.heads[self.bone(name, side)])

    def length(self, start: str, end: str, side: str) -> float:
        """Distance between two bones' heads."""
        return float(np.linalg.norm(self.head(end, side) - self.head(start, side)))

    def joints(self, R: Float[np.ndarray, "t b 3 3"], p: Float[np.ndarray, "t b 3"]) -> Float[np.ndarray, "t 18 3"]:
        """COCO-18 joints of posed bones, defined as in `synthetic.body_anny`: limb joints are bones' heads."""
        out = np.empty((len(p), len(JOINT), 3))
        for side in SIDES:
            for joint, bone in _LIMB_JOINTS.items():
                out[:, JOINT[f"{side}_{joint}"]] = p[:, self.bone(bone, side)]
        out[:, JOINT["neck"]] = (out[:, JOINT["left_shoulder"]] + out[:, JOINT["right_shoulder"]]) / 2
        head = self.bone("head")
        rows = [JOINT[name] for name in _FACE_JOINTS]
        out[:, rows] = (self.face - self.heads[head]) @ R[:, head].mT + p[:, head, None]
        return out

    def hand(
        self, R: Float[np.ndarray, "t b 3 3"], p: Float[np.ndarray, "t b 3"], side: str
    ) -> Float[np.ndarray, "t 4 4"]:
        """T_world_hand of posed bones."""
        wrist = self.bone("wrist", side)
        rest = self.T_body_hand[side]
        T = np.tile(np.eye(4), (len(p), 1, 1))
        T[:, :3, :3] = R[:, wrist] @ rest[:3, :3]
        T[:, :3, 3] = R[:, wrist] @ (rest[:3, 3] - self.heads[wrist]) + p[:, wrist]
        return T


@dataclass(frozen=True, eq=False)
class Body:
    """A naked person at rest."""

    skeleton: Skeleton
    female: bool
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    weights: sparse.csr_matrix
    """(v, b) skinning weights; rows sum to 1"""
    parts: Mapping[str, Bool[np.ndarray, " f"]]
    """which faces are the head's, the eyes' ..."""

    def weight_of(self, *beginnings: str) -> Float[np.ndarray, " v"]:
        """Summed weight per vertex of the bones whose names begin so."""
        columns = [i for i, label in enumerate(self.skeleton.labels) if label.startswith(beginnings)]
        return np.asarray(self.weights[:, columns].sum(1)).ravel()


@lru_cache(maxsize=1)
def _model() -> tuple[Any, Any, dict[str, np.ndarray]]:
    with needs_extra("the stage's people", "train"):
        import torch
        from anny import Anny
        from anny.face_segmentation import get_face_segmentation_mask
        from anny.keypoints import KeypointsRegressor
    model = Anny(rig="anny", topology="anny", phenotypes="all").to(torch.float32)
    parts = {name: get_face_segmentation_mask(model, [name]).numpy() for name in _PARTS}
    return model, KeypointsRegressor.coco(model), parts


def draw_body(seed: int) -> Body:
    """A random adult with ANSUR II's statures. Deterministic; about a tenth of a second once anny is loaded.

    Raises MissingExtraError without anny and torch.
    """
    model, regressor, parts = _model()
    import torch

    from understudy.synthetic.ansur import draw_stature
    from understudy.synthetic.body_anny import draw_phenotypes, with_stature

    generator = torch.Generator().manual_seed(seed)
    female = torch.rand(1, generator=generator) < 0.5
    stature = draw_stature(female, generator)
    phenotypes = draw_phenotypes(female, generator)
    phenotypes["age"] = phenotypes["age"].clamp(0.62, 0.85)
    phenotypes["weight"] = phenotypes["weight"].clamp(0.25, 0.8)
    vertices, heads = with_stature(model, phenotypes, stature)
    key = dict(zip(regressor.labels, _upright(regressor({"vertices": vertices})[0].numpy()), strict=True))
    spots, bones = _upright(vertices[0].numpy()), _upright(heads[0].numpy())
    labels = tuple(model.bone_labels)
    hips = bones[[labels.index("upperleg01.L"), labels.index("upperleg01.R")]].mean(0)
    ground = np.array([hips[0], hips[1], spots[:, 2].min()])
    face = np.stack([key[name] for name in _FACE_JOINTS]) - ground
    face[3:, 1] -= EAR_IN * np.sign(face[3:, 1])
    _straighten(labels, bones)
    skeleton = Skeleton(
        labels,
        tuple(int(i) for i in model.bone_parents),
        bones - ground,
        face,
        {side: _hand_frame(labels, bones - ground, side) for side in SIDES},
        float(stature[0]),
    )
    index = model.vertex_bone_indices.numpy()
    rows = np.repeat(np.arange(len(index)), index.shape[1])
    values = model.vertex_bone_weights.numpy().astype(np.float64).ravel()
    weights = sparse.csr_matrix((values, (rows, index.ravel())), shape=(len(index), len(labels)))
    weights = sparse.csr_matrix(sparse.diags(1 / np.asarray(weights.sum(1)).ravel()) @ weights)
    faces = model.faces.numpy().astype(np.int64)
    return Body(skeleton, bool(female[0]), spots - ground, faces, weights, parts)


def _upright(points: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """anny's axes (x to the left, y backwards) to ours."""
    return np.stack([-points[:, 1], points[:, 0], points[:, 2]], 1).astype(np.float64)


def _straighten(labels: tuple[str, ...], heads: np.ndarray) -> None:
    """Puts the bone in the middle of each upper arm and forearm onto its axis, about which it will be twisted."""
    for end in "LR":
        for start, middle, stop in (("upperarm01", "upperarm02", "lowerarm01"), ("lowerarm01", "lowerarm02", "wrist")):
            a, b, c = (labels.index(f"{name}.{end}") for name in (start, middle, stop))
            along = unit(heads[c] - heads[a])
            heads[b] = heads[a] + along * ((heads[b] - heads[a]) @ along)


def _hand_frame(labels: tuple[str, ...], heads: np.ndarray, side: str) -> Float[np.ndarray, "4 4"]:
    end = side[0].upper()
    wrist, index, middle, pinky = (
        heads[labels.index(f"{bone}.{end}")] for bone in ("wrist", "finger2-1", "finger3-1", "finger5-1")
    )
    normal = unit(np.cross(index - wrist, pinky - wrist)) * (1 if side == "right" else -1)
    y = unit(np.cross(normal, middle - wrist))
    return rigid(np.column_stack([np.cross(y, normal), y, normal]), (wrist + middle) / 2)
