"""The simplified skeleton that all simulated bodies share: rigid segments, and how a pose is written down.

Body frame: x to the person's left, y to the person's back, z up, metres. In the *canonical* posture all segment
rotations are the identity: upright, facing -y, arms stretched out sideways with the palms down (right arm along -x,
left arm along +x), legs straight down (-z), feet pointing to -y.

A pose is one rotation per segment, `R_body_segment` of shape (21, 3, 3): absolute, not relative to the parent. So the
right forearm points along `R[right_forearm] @ (-1, 0, 0)`, the left thigh along `R[left_thigh] @ (0, 0, -1)`, and the
person faces `R[chest] @ (0, -1, 0)`.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from understudy.skeleton import JOINTS

SEGMENTS: Final = (
    "pelvis", "abdomen", "chest", "neck", "head",
    "right_clavicle", "right_upper_arm", "right_forearm", "right_hand", "right_fingers",
    "left_clavicle", "left_upper_arm", "left_forearm", "left_hand", "left_fingers",
    "right_thigh", "right_shin", "right_foot",
    "left_thigh", "left_shin", "left_foot",
)  # fmt: skip
"""Names; a parent always comes before its children."""

SEGMENT: Final = MappingProxyType({name: i for i, name in enumerate(SEGMENTS)})
"""Name -> index."""

_PARENT = {
    "abdomen": "pelvis", "chest": "abdomen", "neck": "chest", "head": "neck",
    "right_thigh": "pelvis", "right_shin": "right_thigh", "right_foot": "right_shin",
    "left_thigh": "pelvis", "left_shin": "left_thigh", "left_foot": "left_shin",
    "right_clavicle": "chest", "right_upper_arm": "right_clavicle", "right_forearm": "right_upper_arm",
    "right_hand": "right_forearm", "right_fingers": "right_hand",
    "left_clavicle": "chest", "left_upper_arm": "left_clavicle", "left_forearm": "left_upper_arm",
    "left_hand": "left_forearm", "left_fingers": "left_hand",
}  # fmt: skip

PARENTS: Final = tuple(SEGMENT[_PARENT[name]] if name in _PARENT else -1 for name in SEGMENTS)
"""Index of each segment's parent; -1 for the pelvis, whose origin is the midpoint of the hips."""

_JOINT_SEGMENT = {
    "shoulder": "upper_arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hip": "thigh",
    "knee": "shin",
    "ankle": "foot",
}


def _carrier(joint: str) -> str:
    side, _, kind = joint.rpartition("_")
    return f"{side}_{_JOINT_SEGMENT[kind]}" if kind in _JOINT_SEGMENT else "head" if joint != "neck" else "chest"


JOINT_SEGMENT: Final = tuple(SEGMENT[_carrier(joint)] for joint in JOINTS)
"""For each COCO-18 joint the segment that carries it. Limb joints are the segments' origins (a shoulder is the origin
of the upper arm); face joints are fixed to the head; the neck is the midpoint of the shoulders."""
