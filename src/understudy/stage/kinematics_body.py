"""From where pelvis, trunk, feet and hands are to the rotations of all bones, at all times at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.stage.body import SIDES, Skeleton
from understudy.stage.kinematics import X, Y, Z, about, apply, forward, frame, middle_joint, twist_angle, unit

SPINE: Final = ("spine05", "spine04", "spine03", "spine02", "spine01")
_PELVIS_SHARE: Final = 0.35  # of the trunk's bend: the pelvis tips along
_NECK: Final = ("neck01", "neck02", "neck03", "head")
_SHRUG: Final = 0.30  # radians at most that the collar bone follows a reaching arm
_REFERENCE_ARM, _REFERENCE_POLE = np.array([0.8, 0.0, -0.6]), np.array([-0.45, 0.62, -0.6])


@dataclass(frozen=True, eq=False)
class Trunk:
    """How pelvis, spine and head are held, over time."""

    hips: Float[np.ndarray, "t 3"]
    """midpoint of the hip joints, world"""
    yaw: Float[np.ndarray, " t"]
    """of the pelvis"""
    bend: Float[np.ndarray, " t"]
    """forwards"""
    lean: Float[np.ndarray, " t"]
    """to the person's right"""
    twist: Float[np.ndarray, " t"]
    """of the chest against the pelvis, to the left"""
    nod: Float[np.ndarray, " t"]
    """of the head against the chest, down"""
    turn: Float[np.ndarray, " t"]
    """of the head against the chest, to the left"""
    forth: Mapping[str, Float[np.ndarray, " t"]]
    """side -> 0 to 1: how much the shoulder goes forward with the arm"""


@dataclass(frozen=True, eq=False)
class Foot:
    """A foot over time."""

    ankle: Float[np.ndarray, "t 3"]
    yaw: Float[np.ndarray, " t"]
    pitch: Float[np.ndarray, " t"]
    """toes down"""


@dataclass(frozen=True, eq=False)
class Limb:
    """Where a posed arm is, and how far its wrist is turned."""

    elbow: Float[np.ndarray, "t 3"]
    wrist: Float[np.ndarray, "t 3"]
    upper: Float[np.ndarray, "t 3 3"]
    lower: Float[np.ndarray, "t 3 3"]
    hand: Float[np.ndarray, "t 3 3"]
    """rotations from the rest pose"""
    bend: Float[np.ndarray, " t"]
    """angle between forearm and hand"""
    pronation: Float[np.ndarray, " t"]
    """turn of the hand about the forearm, from the rest pose"""


def trunk_rotations(skeleton: Skeleton, trunk: Trunk) -> dict[int, Float[np.ndarray, "t 3 3"]]:
    """World rotations of pelvis, spine, neck, head and collar bones."""
    heading = about(Z, trunk.yaw)
    pelvis = heading @ about(Y, _PELVIS_SHARE * trunk.bend)
    out = {skeleton.bone("root"): pelvis}
    chest = pelvis
    for k, name in enumerate(SPINE):
        share = (k + 1) / len(SPINE)
        bend = (_PELVIS_SHARE + (1 - _PELVIS_SHARE) * share) * trunk.bend
        chest = heading @ about(Z, share * trunk.twist) @ about(Y, bend) @ about(X, share * trunk.lean)
        out[skeleton.bone(name)] = chest
    for k, name in enumerate(_NECK):
        share = (k + 1) / len(_NECK)
        out[skeleton.bone(name)] = chest @ about(Z, share * trunk.turn) @ about(Y, share * trunk.nod)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out[skeleton.bone("clavicle", side)] = chest @ about(Z, -sign * _SHRUG * trunk.forth[side])
    return out


def root_of(skeleton: Skeleton, trunk: Trunk, pelvis: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3"]:
    """Place of the root bone's head, so that the hips are where they should be."""
    hips = (skeleton.head("upperleg01", "left") + skeleton.head("upperleg01", "right")) / 2
    return trunk.hips - pelvis @ (hips - skeleton.head("root"))


def elbow_pole(
    chest: Float[np.ndarray, "t 3 3"], along: Float[np.ndarray, "t 3"], side: str, swivel: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t 3"]:
    """Where an elbow points: down, out and back for an arm ahead, backwards for a hanging one; plus the swivel.

    along: unit vectors from shoulder to wrist, world. swivel: about them.
    """
    mirror = np.array([1.0, 1.0 if side == "left" else -1.0, 1.0])
    local = apply(chest.mT, along)
    axis = np.cross(_REFERENCE_ARM, local)
    angle = np.arctan2(np.linalg.norm(axis, axis=-1), local @ _REFERENCE_ARM)
    pole = about(unit(axis), angle) @ (_REFERENCE_POLE * mirror)
    return apply(about(along, swivel * mirror[1]), apply(chest, pole))


def solve_arm(
    skeleton: Skeleton,
    side: str,
    chest: Float[np.ndarray, "t 3 3"],
    shoulder: Float[np.ndarray, "t 3"],
    T_world_hand: Float[np.ndarray, "t 4 4"],
    swivel: Float[np.ndarray, " t"],
) -> Limb:
    """An arm whose hand is at T_world_hand (or as near as the arm is long)."""
    rest = [skeleton.head(name, side) for name in ("upperarm01", "lowerarm01", "wrist")]
    T_rest = skeleton.T_body_hand[side]
    hand = T_world_hand[:, :3, :3] @ T_rest[:3, :3].T
    goal = T_world_hand[:, :3, 3] - hand @ (T_rest[:3, 3] - rest[2])
    lengths = (float(np.linalg.norm(rest[1] - rest[0])), float(np.linalg.norm(rest[2] - rest[1])))
    pole = elbow_pole(chest, unit(goal - shoulder), side, swivel)
    elbow, wrist = middle_joint(shoulder, goal, lengths, pole)
    upper, lower = _two_bones(rest, shoulder, elbow, wrist)
    along = unit(wrist - elbow)
    return Limb(
        elbow,
        wrist,
        upper,
        lower,
        hand,
        np.arccos(np.clip(np.sum(along * T_world_hand[:, :3, 0], -1), -1, 1)),
        twist_angle(hand @ lower.mT, along),
    )


def _two_bones(
    rest: list[Float[np.ndarray, "3"]],
    start: Float[np.ndarray, "t 3"],
    middle: Float[np.ndarray, "t 3"],
    end: Float[np.ndarray, "t 3"],
) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3 3"]]:
    """Rotations of the two bones of a limb, from its hinge at rest to its hinge now."""
    a, b, c = rest
    hinge, now = np.cross(b - a, c - b), np.cross(middle - start, end - middle)
    return (
        frame(middle - start, now) @ frame(b - a, hinge).T,
        frame(end - middle, now) @ frame(c - b, hinge).T,
    )


def pose(
    skeleton: Skeleton,
    trunk: Trunk,
    feet: Mapping[str, Foot],
    T_world_hand: Mapping[str, Float[np.ndarray, "t 4 4"]],
    swivel: Mapping[str, Float[np.ndarray, " t"]],
    flex: Mapping[str, Float[np.ndarray, "t 5 3"]],
) -> tuple[Float[np.ndarray, "t b 3 3"], Float[np.ndarray, "t b 3"]]:
    """World rotation (identity at rest) and place of every bone. flex: radians of the fingers' joints, thumb first."""
    R = trunk_rotations(skeleton, trunk)
    pelvis, chest = R[skeleton.bone("root")], R[skeleton.bone(SPINE[-1])]
    root = root_of(skeleton, trunk, pelvis)
    place = forward(skeleton.parents, skeleton.heads, R, root)[1]
    for side in SIDES:
        _add_leg(skeleton, side, pelvis, place[:, skeleton.bone("upperleg01", side)], feet[side], R)
        shoulder = place[:, skeleton.bone("upperarm01", side)]
        arm = solve_arm(skeleton, side, chest, shoulder, T_world_hand[side], swivel[side])
        _add_arm(skeleton, side, chest, shoulder, arm, R)
        _add_fingers(skeleton, side, arm.hand, flex[side], R)
    return forward(skeleton.parents, skeleton.heads, R, root)


def _add_leg(
    skeleton: Skeleton,
    side: str,
    pelvis: Float[np.ndarray, "t 3 3"],
    hip: Float[np.ndarray, "t 3"],
    foot: Foot,
    R: dict[int, Float[np.ndarray, "t 3 3"]],
) -> None:
    heading = about(Z, foot.yaw)
    rest = [skeleton.head(name, side) for name in ("upperleg01", "lowerleg01", "foot")]
    lengths = (float(np.linalg.norm(rest[1] - rest[0])), float(np.linalg.norm(rest[2] - rest[1])))
    pole = heading @ X + pelvis @ X
    knee, ankle = middle_joint(hip, foot.ankle, lengths, pole)
    # a knee's hinge is square to the way the foot points; the hinge at rest is poorly defined, as the leg is straight
    hinge = np.cross(Z, pole)
    for upper, lower, a, b, start, end in (
        ("upperleg01", "upperleg02", rest[0], rest[1], hip, knee),
        ("lowerleg01", "lowerleg02", rest[1], rest[2], knee, ankle),
    ):
        turn = frame(end - start, hinge) @ frame(b - a, Y).T
        R[skeleton.bone(upper, side)] = R[skeleton.bone(lower, side)] = turn
    R[skeleton.bone("foot", side)] = heading @ about(Y, foot.pitch)
    for k in range(1, 6):  # toes stay level while the heel is up
        R[skeleton.bone(f"toe{k}-1", side)] = heading @ about(Y, np.minimum(foot.pitch, 0.0))


def _add_arm(
    skeleton: Skeleton,
    side: str,
    chest: Float[np.ndarray, "t 3 3"],
    shoulder: Float[np.ndarray, "t 3"],
    arm: Limb,
    R: dict[int, Float[np.ndarray, "t 3 3"]],
) -> None:
    along = unit(arm.elbow - shoulder)
    half = about(along, -0.5 * twist_angle(arm.upper @ chest.mT, along))
    R[skeleton.bone("upperarm01", side)] = half @ arm.upper
    R[skeleton.bone("upperarm02", side)] = arm.upper
    along = unit(arm.wrist - arm.elbow)
    for name, share in (("lowerarm01", 0.2), ("lowerarm02", 0.65)):
        R[skeleton.bone(name, side)] = about(along, share * arm.pronation) @ arm.lower
    R[skeleton.bone("wrist", side)] = arm.hand


def _add_fingers(
    skeleton: Skeleton,
    side: str,
    hand: Float[np.ndarray, "t 3 3"],
    flex: Float[np.ndarray, "t 5 3"],
    R: dict[int, Float[np.ndarray, "t 3 3"]],
) -> None:
    palm = skeleton.T_body_hand[side][:3, 2]
    for k in range(5):
        base, tip = skeleton.head(f"finger{k + 1}-1", side), skeleton.head(f"finger{k + 1}-3", side)
        pinky = skeleton.head("finger5-1", side)
        towards = palm if k else unit(unit(pinky - base) + 0.6 * palm)
        axis = unit(np.cross(tip - base, towards))
        total = np.cumsum(flex[:, k], axis=1)
        for j in range(3):
            R[skeleton.bone(f"finger{k + 1}-{j + 1}", side)] = hand @ about(axis, total[:, j])
