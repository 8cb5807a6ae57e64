"""Measures of a body, posing with raised shoulders, and a check of limbs against the own body."""

from __future__ import annotations

from dataclasses import dataclass

import common  # noqa: F401
import numpy as np
from bodies import Body
from common import Array
from layout import SOLE
from rig import Arm, Foot, Pose, forward, limb, place_foot, pose_arm, rot_x, rot_y, rot_z, skin

SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
NECK = ("neck01", "neck02", "neck03", "head")


@dataclass
class Fit:
    """Sizes of one body in the rest pose, from the hips' midpoint (x, y) and the floor (z, in shoes)."""

    body: Body
    hip: float
    leg: float
    arm: float
    shoulder: Array  # the left one
    ear: Array  # the left one
    hands: float  # wrist to knuckles

    def surface(self, z: float, back: bool = False) -> float:
        """y of the clothed torso's front (or back) at height z."""
        v, keep = self._torso
        near = v[keep & (np.abs(v[:, 2] - z) < 0.05)]
        if len(near) == 0:
            return 0.15 if back else -0.15
        return float(near[:, 1].max() + 0.035) if back else float(near[:, 1].min() - 0.035)

    def wide(self, z: float) -> float:
        """Half of the clothed torso's width at height z."""
        v, keep = self._torso
        near = v[keep & (np.abs(v[:, 2] - z) < 0.05)]
        return float(np.abs(near[:, 0]).max() + 0.03) if len(near) else 0.18

    @property
    def _torso(self) -> tuple[Array, Array]:
        b = self.body
        hips = 0.5 * (b.head_of("upperleg01.L") + b.head_of("upperleg01.R"))
        keep = b.weight_of("upperarm", "lowerarm", "wrist", "finger", "metacarpal") < 0.3
        return b.vertices - np.array([hips[0], hips[1], -SOLE]), keep


def fit(body: Body) -> Fit:
    """Measure a body."""
    hips = 0.5 * (body.head_of("upperleg01.L") + body.head_of("upperleg01.R"))
    off = np.array([hips[0], hips[1], -SOLE])
    s, e, w = (body.head_of(f"{b}.L") for b in ("upperarm01", "lowerarm01", "wrist"))
    knee, ankle = body.head_of("lowerleg01.L"), body.head_of("foot.L")
    arm = float(np.linalg.norm(e - s) + np.linalg.norm(w - e))
    leg = float(np.linalg.norm(knee - body.head_of("upperleg01.L")) + np.linalg.norm(ankle - knee))
    hands = float(np.linalg.norm(body.head_of("finger3-1.L") - w))
    # A straight leg under the hip carries it lower than in the rest pose, whose legs are spread.
    hip = leg + float(ankle[2]) + SOLE - 0.008
    drop = np.array([0.0, 0.0, hips[2] + SOLE - hip])
    return Fit(body, hip, leg, arm, s - off - drop, body.coco["left_ear"] - off - drop, hands)


def solve_pose(body: Body, pose: Pose, lift: dict[str, float], pull: dict[str, float]) -> tuple[Array, Array]:
    """Rotation and position of every bone; `lift` raises a shoulder, `pull` brings it forward (radians)."""
    rots: dict[str, Array] = {}
    root = rot_z(pose.yaw) @ rot_x(pose.tilt) @ rot_y(pose.roll)
    rots["root"] = root
    hips = 0.5 * (body.head_of("upperleg01.L") + body.head_of("upperleg01.R"))
    origin = pose.pelvis - root @ (hips - body.head_of("root"))
    bend, lean, twist = pose.spine
    chest = root
    for k, label in enumerate(SPINE):
        share = (k + 1) / len(SPINE)
        chest = root @ rot_z(twist * share) @ rot_x(bend * share) @ rot_y(lean * share)
        rots[label] = chest
    nod, tip, look = pose.head
    for k, label in enumerate(NECK):
        share = (k + 1) / len(NECK)
        rots[label] = chest @ rot_z(look * share) @ rot_x(nod * share) @ rot_y(tip * share)
    for side, out in (("L", 1.0), ("R", -1.0)):
        turned = chest @ rot_z(-out * pull.get(side, 0.0)) @ rot_y(-out * lift.get(side, 0.0))
        rots[f"clavicle.{side}"] = turned
    _, pos = forward(body, rots, origin)
    for side in "LR":
        foot_rot, ankle = place_foot(body, side, pose.feet[side])
        out = pose.knee_out.get(side, 0.12) * (1 if side == "L" else -1)
        pole = rot_z(pose.feet[side].yaw) @ np.array([out, -1.0, 0.0])
        names = tuple(f"{b}.{side}" for b in ("upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot"))
        start = pos[body.bones.index(names[0])]
        limb(body, rots, names, root, start, ankle, pole)
        rots[names[4]] = foot_rot
        if pose.feet[side].pitch > 0:
            level = rot_z(pose.feet[side].yaw)
            rots.update({b: level for b in body.bones if b.startswith("toe") and b.endswith(side)})
        shoulder = pos[body.bones.index(f"upperarm01.{side}")]
        pose_arm(body, rots, side, pose.arms[side], chest, shoulder)
    return forward(body, rots, origin)


def bare(body: Body, rot: Array, pos: Array) -> Array:
    """The posed skin."""
    return skin(body.vertices, body.weights, body.heads, rot, pos)


def _segments_gap(a0: Array, a1: Array, b0: Array, b1: Array) -> float:
    """Least distance of two segments, sampled."""
    t = np.linspace(0, 1, 9)[:, None]
    p, q = a0 + (a1 - a0) * t, b0 + (b1 - b0) * t
    return float(np.linalg.norm(p[:, None] - q[None], axis=2).min())


def self_contact(f: Fit, pos: Array) -> float:
    """How deep (metres) forearms and hands lie in torso, head, thighs or the other arm; also thigh in thigh."""
    b = f.body

    def at(label: str) -> Array:
        return pos[b.bones.index(label)]

    hips = 0.5 * (at("upperleg01.L") + at("upperleg01.R"))
    across = (at("upperleg01.L") - at("upperleg01.R")) * 0.22
    top = 0.5 * (at("upperarm01.L") + at("upperarm01.R"))
    over = (at("upperarm01.L") - at("upperarm01.R")) * 0.2
    depth = 0.42 * (f.surface(f.hip + 0.2, True) - f.surface(f.hip + 0.2))
    centre = 0.5 * (f.surface(f.hip + 0.2, True) + f.surface(f.hip + 0.2))
    side = np.cross(top - hips, at("upperleg01.L") - at("upperleg01.R"))
    shift = centre * side / max(np.linalg.norm(side), 1e-6)
    worst = 0.0
    for s, o in (("L", "R"), ("R", "L")):
        elbow, wrist, knuckle = at(f"lowerarm01.{s}"), at(f"wrist.{s}"), at(f"finger3-1.{s}")
        tip = knuckle + 0.6 * (knuckle - wrist)
        for p, q, r in ((elbow + 0.35 * (wrist - elbow), wrist, 0.035), (wrist, tip, 0.02)):
            for sign in (-1, 1):
                gap = _segments_gap(p, q, hips + sign * across + shift, top + sign * over + shift)
                worst = max(worst, depth + r - gap)
            head = at("head") + 0.55 * (at("head") - at("neck02"))
            worst = max(worst, 0.085 + r - _segments_gap(p, q, head, head))
            for leg in "LR":
                hip, knee = at(f"upperleg01.{leg}"), at(f"lowerleg01.{leg}")
                worst = max(worst, 0.075 + r - _segments_gap(p, q, hip, knee))
            other = _segments_gap(p, q, at(f"lowerarm01.{o}"), at(f"wrist.{o}"))
            worst = max(worst, 0.03 + r - other)
            worst = max(worst, 0.04 + r - _segments_gap(p, q, at(f"upperarm01.{o}"), at(f"lowerarm01.{o}")))
    legs = [(at(f"upperleg01.{s}") * 0.5 + at(f"lowerleg01.{s}") * 0.5, at(f"lowerleg01.{s}")) for s in "LR"]
    shins = [(at(f"lowerleg01.{s}"), at(f"foot.{s}")) for s in "LR"]
    worst = max(worst, 0.12 - _segments_gap(*legs[0], *legs[1]), 0.09 - _segments_gap(*shins[0], *shins[1]))
    return worst


__all__ = ["Arm", "Fit", "Foot", "Pose", "bare", "fit", "self_contact", "solve_pose"]
