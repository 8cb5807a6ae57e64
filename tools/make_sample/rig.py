"""Posing: forward kinematics with absolute bone rotations, two-bone inverse kinematics, skinning."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from bodies import Body
from layout import SOLE, Array, rodrigues

X, Z = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def unit(v: Array) -> Array:
    """Scaled to length one."""
    return np.asarray(v, float) / np.linalg.norm(v)


def rot_x(a: float) -> Array:
    """About the person's left: positive leans forward, or points toes down."""
    return rodrigues(X, a)


def rot_y(a: float) -> Array:
    """About the person's back axis: positive tips the head to the person's left."""
    return rodrigues(np.array([0, 1.0, 0]), a)


def rot_z(a: float) -> Array:
    """About the vertical: positive turns to the person's left."""
    return rodrigues(Z, a)


def frame(along: Array, side: Array) -> Array:
    """Axes as columns: `along`, the part of `side` square to it, and their cross product."""
    a = unit(along)
    s = unit(side - a * (a @ side))
    return np.stack([a, s, np.cross(a, s)], 1)


def half_turn(rot: Array, axis: Array, share: float) -> Array:
    """`share` of the twist of `rot` about `axis`."""
    c = frame(axis, X if abs(axis[0]) < 0.9 else Z)
    local = c.T @ rot @ c
    angle = np.arctan2(local[2, 1] - local[1, 2], local[1, 1] + local[2, 2])
    return rodrigues(axis, share * angle)


@dataclass
class Foot:
    """Where a flat foot would stand (ankle over x, y), lifted and pitched about ball or heel."""

    xy: tuple[float, float]
    yaw: float
    lift: float = 0.0
    pitch: float = 0.0


@dataclass
class Arm:
    """A wrist target, in the world, or from the shoulder in the chest's frame when `local`."""

    wrist: Array
    elbow: Array  # direction in which the elbow points, same frame
    fingers: Array
    palm: Array
    local: bool = True
    curl: float = 0.35
    hand_pull: float = 1.0


@dataclass
class Pose:
    """All that makes one posture."""

    pelvis: Array  # midpoint of the hips
    yaw: float
    feet: dict[str, Foot]
    arms: dict[str, Arm]
    tilt: float = 0.0  # pelvis forward
    roll: float = 0.0  # pelvis sideways
    spine: tuple[float, float, float] = (0.0, 0.0, 0.0)  # forward, sideways, twist over the whole spine
    head: tuple[float, float, float] = (0.0, 0.0, 0.0)  # nod, tip, turn relative to the chest
    knee_out: dict[str, float] = field(default_factory=dict)


def forward(body: Body, rots: dict[str, Array], root: Array) -> tuple[Array, Array]:
    """World rotation and head position of every bone; a bone not in `rots` follows its parent."""
    n = len(body.bones)
    rot, pos = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for i, (label, parent) in enumerate(zip(body.bones, body.parents, strict=True)):
        if parent < 0:
            rot[i], pos[i] = rots.get(label, np.eye(3)), root
            continue
        rot[i] = rots.get(label, rot[parent])
        pos[i] = pos[parent] + rot[parent] @ (body.heads[i] - body.heads[parent])
    return rot, pos


def two_bone(start: Array, goal: Array, l1: float, l2: float, pole: Array) -> Array:
    """The middle joint of a chain from start towards goal, bent towards `pole`."""
    to = goal - start
    dist = min(np.linalg.norm(to), 0.9985 * (l1 + l2))
    along = unit(to)
    side = unit(pole - along * (along @ pole))
    a = (l1 * l1 - l2 * l2 + dist * dist) / (2 * dist)
    return start + along * a + side * np.sqrt(max(l1 * l1 - a * a, 0.0))


def limb(
    body: Body,
    rots: dict[str, Array],
    names: tuple[str, str, str, str, str],
    base: Array,
    start: Array,
    goal: Array,
    pole: Array,
) -> None:
    """Set the four bones of an arm or a leg so that its end reaches the goal."""
    up1, up2, low1, low2, end = names
    r0, r1, r2 = body.head_of(up1), body.head_of(low1), body.head_of(end)
    l1, l2 = float(np.linalg.norm(r1 - r0)), float(np.linalg.norm(r2 - r1))
    mid = two_bone(start, goal, l1, l2, pole)
    hinge = np.cross(r1 - r0, r2 - r1)
    new_hinge = np.cross(mid - start, goal - mid)
    upper = frame(mid - start, new_hinge) @ frame(r1 - r0, hinge).T
    lower = frame(goal - mid, new_hinge) @ frame(r2 - r1, hinge).T
    twist = half_turn(upper @ base.T, unit(mid - start), -0.5)
    rots[up1], rots[up2], rots[low1], rots[low2] = twist @ upper, upper, lower, lower


def place_foot(body: Body, side: str, foot: Foot) -> tuple[Array, Array]:
    """Rotation of the foot and position of the ankle."""
    ankle = body.head_of(f"foot.{side}")
    rot = rot_z(foot.yaw) @ rot_x(foot.pitch)
    pivot = body.head_of(f"toe2-1.{side}") if foot.pitch >= 0 else np.array([ankle[0], ankle[1] + 0.045, -SOLE])
    flat = np.array([foot.xy[0], foot.xy[1], ankle[2] + SOLE + foot.lift])
    ground = flat + rot_z(foot.yaw) @ (pivot - ankle)
    return rot, ground + rot @ (ankle - pivot)


def palm_of(index: Array, pinky: Array, wrist: Array, side: str) -> Array:
    """Unit vector out of the palm."""
    n = unit(np.cross(index - wrist, pinky - wrist))
    return n if side == "R" else -n


def rest_palm(body: Body, side: str) -> tuple[Array, Array]:
    """Direction of the fingers and of the palm at rest."""
    wrist = body.head_of(f"wrist.{side}")
    index, pinky = body.head_of(f"finger2-1.{side}"), body.head_of(f"finger5-1.{side}")
    return unit(0.5 * (index + pinky) - wrist), palm_of(index, pinky, wrist, side)


def pose_arm(body: Body, rots: dict[str, Array], side: str, arm: Arm, chest: Array, shoulder: Array) -> None:
    """Arm, forearm twist, hand and fingers."""
    turn = chest if arm.local else np.eye(3)
    goal = shoulder + chest @ arm.wrist if arm.local else arm.wrist
    names = tuple(f"{b}.{side}" for b in ("upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist"))
    limb(body, rots, names, chest, shoulder, goal, turn @ arm.elbow)
    forearm = rots[names[2]]
    fingers, palm = rest_palm(body, side)
    hand = frame(turn @ arm.fingers, turn @ arm.palm) @ frame(fingers, palm).T
    axis = unit(forearm @ (body.head_of(names[4]) - body.head_of(names[2])))
    delta = hand @ forearm.T
    rots[names[2]] = half_turn(delta, axis, 0.2) @ forearm
    rots[names[3]] = half_turn(delta, axis, 0.6) @ forearm
    rots[names[4]] = hand
    for k in range(2, 6):
        tip = body.head_of(f"finger{k}-3.{side}") - body.head_of(f"finger{k}-1.{side}")
        axis = unit(np.cross(tip, palm))
        for j in range(1, 4):
            share = (0.8, 1.8, 2.4)[j - 1]
            rots[f"finger{k}-{j}.{side}"] = hand @ rodrigues(axis, arm.curl * share * (0.85 + 0.08 * k))


def solve(body: Body, pose: Pose) -> tuple[Array, Array]:
    """World rotation and position of every bone of a posed body."""
    rots: dict[str, Array] = {}
    root = rot_z(pose.yaw) @ rot_x(pose.tilt) @ rot_y(pose.roll)
    rots["root"] = root
    hips = 0.5 * (body.head_of("upperleg01.L") + body.head_of("upperleg01.R"))
    origin = pose.pelvis - root @ (hips - body.head_of("root"))
    bend, lean, twist = pose.spine
    chest = root
    for k, label in enumerate(("spine05", "spine04", "spine03", "spine02", "spine01")):
        share = (k + 1) / 5
        chest = root @ rot_z(twist * share) @ rot_x(bend * share) @ rot_y(lean * share)
        rots[label] = chest
    nod, tip, turn = pose.head
    for k, label in enumerate(("neck01", "neck02", "neck03", "head")):
        share = (k + 1) / 4
        rots[label] = chest @ rot_z(turn * share) @ rot_x(nod * share) @ rot_y(tip * share)
    for side in "LR":  # the collar bone follows a raised arm a little
        arm = pose.arms[side]
        if not arm.local:
            out = 1.0 if side == "L" else -1.0
            rots[f"clavicle.{side}"] = chest @ rot_z(-out * 0.22 * arm.hand_pull)
    _, pos = forward(body, rots, origin)
    for side in "LR":
        foot_rot, ankle = place_foot(body, side, pose.feet[side])
        out = pose.knee_out.get(side, 0.12) * (1 if side == "L" else -1)
        pole = rot_z(pose.feet[side].yaw) @ np.array([out, -1.0, 0.0])
        names = tuple(f"{b}.{side}" for b in ("upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot"))
        limb(body, rots, names, root, pos[body.bones.index(names[0])], ankle, pole)
        rots[names[4]] = foot_rot
        if pose.feet[side].pitch > 0:  # the toes stay level while the heel is up
            level = rot_z(pose.feet[side].yaw)
            rots.update({b: level for b in body.bones if b.startswith("toe") and b.endswith(side)})
        shoulder = pos[body.bones.index(f"upperarm01.{side}")]
        pose_arm(body, rots, side, pose.arms[side], chest, shoulder)
    return forward(body, rots, origin)


def skin(vertices: Array, weights: Array, heads: Array, rot: Array, pos: Array) -> Array:
    """Linear blend skinning."""
    shift = pos - np.einsum("bij,bj->bi", rot, heads)
    mats = np.einsum("vb,bk->vk", weights, np.concatenate([rot.reshape(-1, 9), shift], 1))
    return np.einsum("vij,vj->vi", mats[:, :9].reshape(-1, 3, 3), vertices) + mats[:, 9:]
