"""Joint names, bones, left and right, and maps from other skeletons to COCO-18 (OpenPose's order)."""

from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError, one_of

JOINTS: Final = (
    "nose", "neck",
    "right_shoulder", "right_elbow", "right_wrist",
    "left_shoulder", "left_elbow", "left_wrist",
    "right_hip", "right_knee", "right_ankle",
    "left_hip", "left_knee", "left_ankle",
    "right_eye", "left_eye", "right_ear", "left_ear",
)  # fmt: skip
"""COCO-18 joint names, in the order of every array of joints."""

JOINT: Final = MappingProxyType({name: i for i, name in enumerate(JOINTS)})
"""Joint name -> row."""

N_JOINTS: Final = len(JOINTS)


def rows(*names: str) -> np.ndarray:
    """Rows of the named joints, as an index array."""
    return np.array([JOINT[n] for n in names])


BONES: Final = tuple(
    (JOINT[a], JOINT[b])
    for a, b in (
        ("neck", "right_shoulder"), ("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"),
        ("neck", "left_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"),
        ("neck", "right_hip"), ("right_hip", "right_knee"), ("right_knee", "right_ankle"),
        ("neck", "left_hip"), ("left_hip", "left_knee"), ("left_knee", "left_ankle"),
        ("right_hip", "left_hip"), ("neck", "nose"),
        ("nose", "right_eye"), ("right_eye", "right_ear"), ("nose", "left_eye"), ("left_eye", "left_ear"),
    )
)  # fmt: skip
"""Pairs of rows that a drawing joins."""

FLIP: Final = np.array([JOINT[n.replace("left", "LR").replace("right", "left").replace("LR", "right")] for n in JOINTS])
"""`keypoints[FLIP]` exchanges left and right."""

TORSO: Final = rows("neck", "right_shoulder", "left_shoulder", "right_hip", "left_hip")
FACE: Final = rows("nose", "right_eye", "left_eye", "right_ear", "left_ear")

# Each layout: for every COCO-18 joint the row(s) in the other skeleton; two rows mean their midpoint.
_BLAZEPOSE = (0, (11, 12), 12, 14, 16, 11, 13, 15, 24, 26, 28, 23, 25, 27, 5, 2, 8, 7)
_BODY_25 = (0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18)
_BODY_25B = (0, (5, 6), 6, 8, 10, 5, 7, 9, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3)
_COCO_17 = (0, (5, 6), 6, 8, 10, 5, 7, 9, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3)

LAYOUTS: Final = MappingProxyType(
    {
        "coco_18": (18, tuple(range(18))),
        "coco_17": (17, _COCO_17),
        "body_25": (25, _BODY_25),
        "body_25b": (25, _BODY_25B),
        "blazepose": (33, _BLAZEPOSE),
    }
)
"""Name -> (number of rows, map to COCO-18)."""


def to_coco18(keypoints: Float[np.ndarray, "n 3"], layout: str) -> Float[np.ndarray, "18 3"]:
    """Rows `(u, v, score)` of another skeleton -> COCO-18 rows.

    A midpoint exists only where both its ends do (score > 0); its score is the smaller one.
    A joint that was not found (score 0) becomes `(0, 0, 0)`.
    """
    if layout not in LAYOUTS:
        raise UnderstudyError(f"skeleton layout {layout!r}: must be {one_of(LAYOUTS)}")
    n, mapping = LAYOUTS[layout]
    if keypoints.shape != (n, 3):
        raise UnderstudyError(f"skeleton layout {layout!r} has {n} rows of 3, got shape {keypoints.shape}")
    first, second = np.array([m if isinstance(m, tuple) else (m, m) for m in mapping]).T
    a, b = keypoints[first], keypoints[second]
    out = (a + b) / 2
    out[:, 2] = np.minimum(a[:, 2], b[:, 2])
    out[out[:, 2] <= 0] = 0.0
    return out


_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
HAND_KEYPOINTS: Final = ("wrist", *(f"{finger}_{k}" for finger in _FINGERS for k in range(1, 5)))
"""The 21 keypoints of a hand, in MediaPipe's order: the wrist, then three joints and the tip of each finger."""

HAND_BONES: Final = tuple((a - 1 if a % 4 != 1 else 0, a) for a in range(1, 21))
"""Pairs of rows of `HAND_KEYPOINTS`: from the wrist along each finger."""
