"""Postures: each function returns a pose in the person's own frame and, later, the things that belong to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import common  # noqa: F401
import furniture as fu
import numpy as np
from bodies import Body
from common import Array, Rng
from furniture import Prop
from posing import Arm, Fit, Foot, Pose, bare, self_contact, solve_pose
from rig import place_foot, two_bone, unit

Maker = Callable[[Fit, Array, Array, Array], list[Prop]]  # fit, rot, pos, posed skin


@dataclass
class Setup:
    """A pose, its shoulders, the maker of its things and how it may be turned to the camera."""

    pose: Pose
    lift: dict[str, float] = field(default_factory=dict)
    pull: dict[str, float] = field(default_factory=dict)
    things: Maker | None = None
    facing: str = "any"  # 'away': the person's front, with the furniture there, must not face the camera
    touch: float = 0.045  # how deep limbs may lie in the own body


def vec(*x: float) -> Array:
    """A float array."""
    return np.array(x, float)


def signs(side: str) -> float:
    """+1 for the left."""
    return 1.0 if side == "L" else -1.0


def bone(f: Fit, pos: Array, label: str) -> Array:
    """A posed bone's head."""
    return pos[f.body.bones.index(label)]


def grip_of(f: Fit, pos: Array, side: str, share: float = 1.25) -> Array:
    """Middle of the grip: a bit beyond the knuckles."""
    w, k = bone(f, pos, f"wrist.{side}"), bone(f, pos, f"finger3-1.{side}")
    return w + share * (k - w)


# Arms -------------------------------------------------------------------------------------------------------------


def spot(f: Fit, side: str, place: Array) -> Array:
    """A place of the rest pose (x outward) as a wrist target from the shoulder."""
    s = signs(side)
    shoulder = f.shoulder * np.array([s, 1, 1])
    return vec(s * place[0], place[1], place[2]) - shoulder


def hang(f: Fit, rng: Rng, side: str, swing: float = 0.0) -> Arm:
    """Relaxed at the side; `swing` forward in arm lengths."""
    s = signs(side)
    d = unit(vec(s * rng.uniform(0.10, 0.24), -rng.uniform(0.0, 0.14) - swing, -1.0))
    return Arm(
        d * f.arm * rng.uniform(0.93, 0.985),
        vec(0.45 * s, 1.0, 0.0),
        vec(0.02 * s, -0.18 - 0.4 * swing, -1.0),
        vec(-s, rng.uniform(-0.1, 0.7), 0.0),
        curl=rng.uniform(0.15, 0.45),
    )


def gesture(f: Fit, rng: Rng, side: str) -> Arm:
    """A hand in front, as in talking."""
    s = signs(side)
    w = vec(s * rng.uniform(-0.25, 0.45), -rng.uniform(0.35, 0.75), rng.uniform(-0.55, 0.1))
    return Arm(
        w * f.arm * min(1.0, 0.93 / np.linalg.norm(w)),
        vec(0.5 * s, 0.5, -1.0),
        vec(-s * rng.uniform(-0.2, 0.7), -0.8, rng.uniform(-0.2, 0.9)),
        unit(vec(-s * rng.uniform(0.1, 1), rng.uniform(-0.3, 0.3), rng.uniform(-0.6, 0.9))),
        curl=rng.uniform(0.05, 0.35),
    )


def on_hip(f: Fit, rng: Rng, side: str) -> Arm:
    """Hand on the hip."""
    s, z = signs(side), f.hip + rng.uniform(0.06, 0.14)
    w = spot(f, side, vec(f.wide(z) + 0.05, 0.0 - rng.uniform(-0.05, 0.04), z))
    return Arm(w, vec(s, rng.uniform(0.1, 0.8), 0.0), vec(-0.5 * s, -0.8, -0.5), vec(-s, 0.0, 0.2), curl=0.3)


def behind(f: Fit, rng: Rng, side: str) -> Arm:
    """Hands behind the back."""
    s, z = signs(side), f.hip + rng.uniform(-0.02, 0.1)
    y = f.surface(z, True) + (0.05 if side == "L" else 0.10)
    w = spot(f, side, vec(rng.uniform(0.06, 0.1), y, z))
    return Arm(w, vec(s, 0.7, 0.0), vec(-0.8 * s, 0.0, -0.5), vec(0.0, 1.0, 0.2), curl=0.35)


def clasp(f: Fit, rng: Rng, side: str, z: float) -> Arm:
    """Hands clasped before the belly."""
    s = signs(side)
    y = f.surface(z) - (0.06 if side == "L" else 0.085)
    w = spot(f, side, vec(rng.uniform(0.07, 0.10), y, z))
    return Arm(w, vec(s, 0.4, -0.4), vec(-0.8 * s, -0.3, -0.4), vec(0.0, 0.9, -0.3), curl=0.4)


def crossed(f: Fit, rng: Rng, side: str) -> Arm:
    """Crossed before the chest; each wrist at the other elbow."""
    s, z = signs(side), f.shoulder[2] - rng.uniform(0.36, 0.42) * f.arm
    front = f.surface(z) - (0.07 if side == "L" else 0.135)
    w = spot(f, side, vec(-rng.uniform(0.09, 0.14), front, z + (0.03 if side == "L" else -0.03)))
    return Arm(w, vec(0.8 * s, -0.1, -0.8), vec(-s, 0.25, 0.1), vec(0.0, 1.0, 0.0), curl=0.25)


def to_head(f: Fit, rng: Rng, side: str) -> Arm:
    """A hand at the ear (telephone), the mouth (cup) or the hair."""
    s = signs(side)
    place, fingers, palm = [
        (vec(f.ear[0] + 0.06, f.ear[1] - 0.10, f.ear[2] - 0.12), vec(-0.2 * s, 0.45, 0.9), vec(-s, 0.2, 0.1)),
        (vec(0.08, f.surface(f.shoulder[2]) - 0.14, f.ear[2] - 0.13), vec(-0.6 * s, 0.2, 0.7), vec(-0.6 * s, 0.8, 0)),
        (vec(f.ear[0] + 0.05, f.ear[1] + 0.02, f.ear[2] + 0.10), vec(-0.8 * s, 0.2, 0.6), vec(-0.5 * s, 0, -0.8)),
    ][int(rng.integers(3))]
    return Arm(spot(f, side, place), vec(s, -0.2, -0.7), fingers, palm, curl=0.5)


def raised(f: Fit, rng: Rng, side: str) -> Arm:
    """Pointing, waving or stretched up."""
    s = signs(side)
    kind = rng.integers(3)
    if kind == 0:  # pointing
        w = vec(s * rng.uniform(-0.2, 0.95), -rng.uniform(0.3, 1.0), rng.uniform(-0.2, 0.5))
        return Arm(unit(w) * f.arm * 0.96, vec(s, 0.5, -0.8), w, vec(0.1 * s, 0.1, -1.0), curl=0.2)
    if kind == 1:  # waving
        w = vec(s * rng.uniform(0.3, 0.6), -rng.uniform(0.1, 0.4), rng.uniform(0.3, 0.6))
        return Arm(w * f.arm, vec(s, 0.2, -0.8), vec(0.2 * s, -0.1, 1.0), vec(0.0, -1.0, 0.1), curl=0.1)
    w = vec(s * rng.uniform(0.0, 0.5), -rng.uniform(-0.05, 0.3), 1.0)
    return Arm(unit(w) * f.arm * 0.95, vec(s, 0.4, 0.0), vec(-0.1 * s, -0.1, 1.0), vec(-s, -0.4, 0.0), curl=0.2)


def lift_of(f: Fit, arm: Arm) -> float:
    """How much a raised hand raises its shoulder."""
    return float(np.clip(0.45 * arm.wrist[2] / f.arm, 0.0, 0.42)) if arm.local else 0.0


# Whole body -------------------------------------------------------------------------------------------------------


def stance(f: Fit, rng: Rng, arms: dict[str, Arm], spread: float = 1.0) -> Pose:
    """Standing on both feet."""
    wide = rng.uniform(0.075, 0.16) * spread
    feet = {}
    for side in "LR":
        s = signs(side)
        xy = (s * wide, rng.uniform(-0.09, 0.07))
        feet[side] = Foot(xy, s * rng.uniform(0.0, 0.35))
    return Pose(
        vec(rng.uniform(-0.04, 0.04), 0.0, f.hip - rng.uniform(-0.004, 0.006)),
        rng.uniform(-0.12, 0.12),
        feet,
        arms,
        tilt=rng.uniform(-0.03, 0.07),
        roll=rng.uniform(-0.05, 0.05),
        spine=(rng.uniform(-0.04, 0.16), rng.uniform(-0.08, 0.08), rng.uniform(-0.2, 0.2)),
        head=(rng.uniform(-0.15, 0.4), rng.uniform(-0.12, 0.12), rng.uniform(-0.8, 0.8)),
        knee_out={"L": rng.uniform(0.05, 0.3), "R": rng.uniform(0.05, 0.3)},
    )


def standing(f: Fit, rng: Rng) -> Setup:
    """Relaxed: arms hanging, on the hips, behind or before the body."""
    kind = rng.choice(5, p=[0.4, 0.15, 0.15, 0.15, 0.15])
    arms = {s: hang(f, rng, s) for s in "LR"}
    if kind == 1:
        arms = {s: behind(f, rng, s) for s in "LR"}
    elif kind == 2:
        z = f.hip + rng.uniform(0.0, 0.15)
        arms = {s: clasp(f, rng, s, z) for s in "LR"}
    elif kind == 3:
        arms = {s: on_hip(f, rng, s) for s in "LR"}
    elif kind == 4:
        arms[str(rng.choice(["L", "R"]))] = on_hip(f, rng, str(rng.choice(["L"])))
        arms = {"L": on_hip(f, rng, "L"), "R": hang(f, rng, "R")}
        if rng.random() < 0.5:
            arms = {"L": hang(f, rng, "L"), "R": on_hip(f, rng, "R")}
    return Setup(stance(f, rng, arms), touch=0.07 if kind in (1, 2) else 0.045)


def talking(f: Fit, rng: Rng) -> Setup:
    """One or both hands gesture."""
    arms = {s: gesture(f, rng, s) for s in "LR"}
    if rng.random() < 0.5:
        side = str(rng.choice(["L", "R"]))
        arms[side] = hang(f, rng, side) if rng.random() < 0.6 else on_hip(f, rng, side)
    return Setup(stance(f, rng, arms))


def arms_crossed(f: Fit, rng: Rng) -> Setup:
    """Arms crossed."""
    pose = stance(f, rng, {s: crossed(f, rng, s) for s in "LR"})
    return Setup(pose, pull={"L": 0.2, "R": 0.25}, touch=0.075)


def at_head(f: Fit, rng: Rng) -> Setup:
    """Telephone, cup or hair; the other arm free."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    arms = {side: to_head(f, rng, side)}
    arms[other] = [hang, gesture, on_hip][int(rng.integers(3))](f, rng, other)
    pose = stance(f, rng, arms)
    pose.head = (rng.uniform(-0.05, 0.2), 0.0, rng.uniform(-0.1, 0.1))
    return Setup(pose, lift={side: 0.1}, pull={side: 0.15}, touch=0.075)


def arm_up(f: Fit, rng: Rng) -> Setup:
    """Points, waves or stretches."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    arms = {side: raised(f, rng, side)}
    arms[other] = raised(f, rng, other) if rng.random() < 0.3 else hang(f, rng, other)
    return Setup(stance(f, rng, arms), lift={s: lift_of(f, a) for s, a in arms.items()})


def walking(f: Fit, rng: Rng) -> Setup:
    """Some moment of a step."""
    stride = rng.uniform(0.35, 0.75) * f.leg
    u, lead = rng.random(), str(rng.choice(["L", "R"]))
    rear = "R" if lead == "L" else "L"
    wide = rng.uniform(0.05, 0.1)
    forth = Foot(
        (signs(lead) * wide, stride * (0.5 - u)),
        signs(lead) * 0.08,
        0.09 * np.sin(np.pi * u),
        np.radians(38 - 52 * u),
    )
    heel = np.radians(-13 * np.clip(1 - u / 0.2, 0, 1) + 26 * np.clip((u - 0.6) / 0.4, 0, 1))
    back = Foot((signs(rear) * wide, stride * (u - 0.5)), signs(rear) * 0.08, 0.0, heel)
    swing = rng.uniform(0.15, 0.45) * (u - 0.5) * 2
    arms = {lead: hang(f, rng, lead, -swing), rear: hang(f, rng, rear, swing)}
    if rng.random() < 0.2:
        arms[lead] = gesture(f, rng, lead)
    pose = stance(f, rng, arms)
    pose.feet = {lead: forth, rear: back}
    pose.pelvis = vec(0, 0, f.hip - 0.015)
    pose.tilt = rng.uniform(0.03, 0.12)
    pose.spine = (rng.uniform(0.0, 0.15), 0.0, signs(lead) * -0.12 * (u - 0.5) * 2)
    return Setup(pose)


def _seated(f: Fit, rng: Rng, height: float, feet_y: tuple[float, float]) -> Pose:
    """The lower body on a seat."""
    hip = min(height + 0.095, 0.66 * f.leg)
    wide = rng.uniform(0.09, 0.17)
    feet = {}
    for side in "LR":
        s = signs(side)
        feet[side] = Foot((s * wide * rng.uniform(0.8, 1.2), -rng.uniform(*feet_y) * f.leg), s * rng.uniform(0, 0.3))
    return Pose(
        vec(0, 0, hip),
        0.0,
        feet,
        {},
        tilt=rng.uniform(-0.28, 0.08),
        spine=(rng.uniform(0.02, 0.42), rng.uniform(-0.1, 0.1), rng.uniform(-0.25, 0.25)),
        head=(rng.uniform(-0.15, 0.35), rng.uniform(-0.1, 0.1), rng.uniform(-0.7, 0.7)),
        knee_out={"L": rng.uniform(0.1, 0.3), "R": rng.uniform(0.1, 0.3)},
    )


def _knee(f: Fit, pose: Pose, side: str) -> tuple[Array, Array]:
    """Hip joint and knee of a pose before it is solved."""
    b = f.body
    half = b.head_of("upperleg01.L")[0]
    hip = pose.pelvis + vec(signs(side) * half, 0, 0)
    _, ankle = place_foot(b, side, pose.feet[side])
    l1 = float(np.linalg.norm(b.head_of("lowerleg01.L") - b.head_of("upperleg01.L")))
    out = pose.knee_out.get(side, 0.12) * signs(side)
    return hip, two_bone(hip, ankle, l1, f.leg - l1, vec(out, -1.0, 0.0))


def lap(f: Fit, rng: Rng, pose: Pose, side: str) -> Arm:
    """A hand on the thigh."""
    s = signs(side)
    hip, knee = _knee(f, pose, side)
    t = rng.uniform(0.45, 0.75)
    w = hip + t * (knee - hip) + vec(-0.02 * s, 0.03, 0.125)
    along = unit(knee - hip) + vec(-0.3 * s, 0, 0)
    return Arm(w, vec(s, 0.8, 0.0), along, vec(0, 0, -1.0), local=False, curl=0.2, hand_pull=0.3)


def on_table(f: Fit, rng: Rng, side: str, edge: float, z: float) -> Arm:
    """A hand on a table whose near edge is at y = edge."""
    s = signs(side)
    w = vec(s * rng.uniform(0.05, 0.3), edge - rng.uniform(0.04, 0.22), z + 0.045 + rng.choice([0.0, 0.05, 0.12]))
    return Arm(
        w,
        vec(s, 0.5, -0.3),
        vec(-s * rng.uniform(0.0, 0.7), -1.0, rng.uniform(-0.1, 0.15)),
        vec(-0.4 * s * rng.random(), 0.0, -1.0),
        local=False,
        curl=rng.uniform(0.1, 0.4),
        hand_pull=0.4,
    )


def _seat_things(rng: Rng, soft: bool, more: Callable[[Fit], list[Prop]] | None = None) -> Maker:
    kid = int(rng.integers(1 << 30))

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        inner = np.random.default_rng(kid)
        b = f.body
        core = b.weight_of("upperleg", "root", "pelvis", "spine05", "spine04") > 0.5
        hips = 0.5 * (bone(f, pos, "upperleg01.L") + bone(f, pos, "upperleg01.R"))
        near = posed[core & (posed[:, 1] > hips[1] - 0.22)]
        seat = float(np.quantile(near[:, 2], 0.004)) - 0.004
        trunk = posed[b.weight_of("spine", "root", "pelvis", "clavicle", "shoulder") > 0.5]
        low = trunk[(trunk[:, 2] > seat) & (trunk[:, 2] < seat + 0.5)]
        y_back = float(low[:, 1].max()) + 0.03
        calf = posed[(b.weight_of("lowerleg") > 0.5)]
        calf = calf[calf[:, 2] < seat - 0.02]
        front = max(float(calf[:, 1].max()) + 0.03, -0.32) if soft else max(float(calf[:, 1].max()) + 0.02, -0.27)
        if soft:
            out = fu.sofa(inner, seat, y_back, front, inner.uniform(0.62, 1.7), inner.uniform(-0.1, 0.1))
        else:
            out = fu.chair(inner, seat, y_back, front)
        return out + (more(f) if more else [])

    return things


def sitting(f: Fit, rng: Rng) -> Setup:
    """On a chair or a sofa, hands in the lap, gesturing or at the head."""
    soft = rng.random() < 0.4
    pose = _seated(f, rng, rng.uniform(0.38, 0.44) if soft else rng.uniform(0.42, 0.48), (0.36, 0.62))
    for side in "LR":
        kind = rng.choice(3, p=[0.65, 0.28, 0.07])
        pose.arms[side] = lap(f, rng, pose, side) if kind == 0 else (gesture, to_head)[kind - 1](f, rng, side)
    return Setup(pose, things=_seat_things(rng, soft), touch=0.075)


def sitting_table(f: Fit, rng: Rng) -> Setup:
    """On a chair at a table, hands on it."""
    pose = _seated(f, rng, rng.uniform(0.42, 0.46), (0.34, 0.58))
    pose.tilt = rng.uniform(-0.05, 0.12)
    z = max(rng.uniform(0.70, 0.76), pose.pelvis[2] + 0.17)
    lean = 0.35 * (pose.tilt + 0.5 * pose.spine[0])
    edge = f.surface(f.hip + 0.15) - lean - rng.uniform(0.03, 0.1)
    for side in "LR":
        kind = rng.choice(3, p=[0.74, 0.18, 0.08])
        pose.arms[side] = on_table(f, rng, side, edge, z) if kind == 0 else (gesture, to_head)[kind - 1](f, rng, side)
    kid = int(rng.integers(1 << 30))

    def more(_: Fit) -> list[Prop]:
        inner = np.random.default_rng(kid)
        return fu.table(inner, edge, z, inner.uniform(0.9, 1.7), inner.uniform(0.6, 0.85), inner.uniform(-0.2, 0.2))

    return Setup(pose, things=_seat_things(rng, False, more), touch=0.075)


def at_table(f: Fit, rng: Rng) -> Setup:
    """Standing at a table or counter, working with both hands."""
    high = rng.random() < 0.5
    z = rng.uniform(0.88, 1.0) if high else rng.uniform(0.7, 0.78)
    z = min(z, f.shoulder[2] - 0.25)
    tilt, bend = (rng.uniform(0.0, 0.15), rng.uniform(0.1, 0.3)) if high else (rng.uniform(0.1, 0.4), 0.35)
    edge = f.surface(z) - rng.uniform(0.03, 0.1) - 0.3 * tilt
    arms = {s: on_table(f, rng, s, edge, z) for s in "LR"}
    pose = stance(f, rng, arms)
    pose.tilt, pose.spine = tilt, (bend, 0.0, rng.uniform(-0.1, 0.1))
    pose.pelvis = vec(0, 0.5 * tilt * 0.3, f.hip - 0.015)
    pose.head = (rng.uniform(0.0, 0.4), 0.0, rng.uniform(-0.3, 0.3))
    kid = int(rng.integers(1 << 30))

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        inner = np.random.default_rng(kid)
        return fu.table(inner, edge, z, inner.uniform(0.9, 1.8), inner.uniform(0.5, 0.8), inner.uniform(-0.2, 0.2))

    return Setup(pose, pull={"L": 0.1, "R": 0.1}, things=things)


def crouching(f: Fit, rng: Rng) -> Setup:
    """Squatting, hands on the knees or at something on the floor."""
    pelvis = vec(0, rng.uniform(0.12, 0.2), rng.uniform(0.34, 0.48) * f.leg)
    heel = rng.uniform(0.1, 0.6)
    feet = {s: Foot((signs(s) * rng.uniform(0.1, 0.2), rng.uniform(-0.08, 0.1)), signs(s) * 0.3, 0, heel) for s in "LR"}
    pose = Pose(
        pelvis,
        0.0,
        feet,
        {},
        tilt=rng.uniform(0.2, 0.55),
        spine=(rng.uniform(0.2, 0.6), rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)),
        head=(rng.uniform(-0.5, 0.1), 0.0, rng.uniform(-0.5, 0.5)),
        knee_out={"L": rng.uniform(0.2, 0.6), "R": rng.uniform(0.2, 0.6)},
    )
    reach = rng.random() < 0.6
    low = rng.uniform(0.16, 0.4)
    for side in "LR":
        s = signs(side)
        if reach:
            w = vec(s * rng.uniform(0.05, 0.15), -rng.uniform(0.5, 0.62) * f.leg, low)
            arm = Arm(w, vec(s, 0.4, -0.3), vec(-0.3 * s, -0.8, -0.5), vec(-s, 0, -0.3), local=False, curl=0.3)
        else:
            _, knee = _knee(f, pose, side)
            w = knee + vec(-0.03 * s, 0.02, 0.11)
            arm = Arm(w, vec(s, 0.4, -0.2), vec(-0.3 * s, -1, -0.2), vec(0, 0, -1), local=False, curl=0.3)
        pose.arms[side] = arm
    color = fu.bright(rng)

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        if not reach:
            return []
        g = 0.5 * (grip_of(f, pos, "L") + grip_of(f, pos, "R"))
        size = (0.2, 0.2, max(g[2] + 0.02, 0.06))
        return [fu.make("thing", (g[0], g[1] - 0.06, size[2] / 2), size, "paint", color, 0.2, True)]

    return Setup(pose, pull={"L": 0.15, "R": 0.15}, things=things, touch=0.09)


def kneeling(f: Fit, rng: Rng) -> Setup:
    """On one knee."""
    down = str(rng.choice(["L", "R"]))
    up = "R" if down == "L" else "L"
    thigh = float(np.linalg.norm(f.body.head_of("lowerleg01.L") - f.body.head_of("upperleg01.L")))
    feet = {
        up: Foot((signs(up) * 0.12, -0.5 * f.leg * rng.uniform(0.8, 1.05)), 0.0),
        down: Foot((signs(down) * 0.1, 0.56 * f.leg), 0.0, 0.0, np.radians(72)),
    }
    pose = Pose(
        vec(0, rng.uniform(-0.02, 0.05), thigh + 0.055),
        0.0,
        feet,
        {},
        tilt=rng.uniform(0.0, 0.2),
        spine=(rng.uniform(0.1, 0.5), 0.0, rng.uniform(-0.2, 0.2)),
        head=(rng.uniform(-0.1, 0.4), 0.0, rng.uniform(-0.5, 0.5)),
        knee_out={"L": 0.1, "R": 0.1},
    )
    pose.arms[up] = lap(f, rng, pose, up)
    pose.arms[down] = gesture(f, rng, down)
    return Setup(pose, touch=0.08)


def bending(f: Fit, rng: Rng) -> Setup:
    """Bends down to take something from the floor."""
    deep = rng.uniform(0.02, 0.22) * f.leg
    tilt, bend = rng.uniform(0.5, 0.95), rng.uniform(0.4, 0.85)
    feet = {s: Foot((signs(s) * rng.uniform(0.09, 0.16), rng.uniform(-0.1, 0.1)), signs(s) * 0.15) for s in "LR"}
    pose = Pose(
        vec(0, 0.14 + 0.4 * deep, f.hip - 0.02 - deep),
        0.0,
        feet,
        {},
        tilt=tilt,
        spine=(bend, 0.0, rng.uniform(-0.25, 0.25)),
        head=(rng.uniform(-0.6, 0.1), 0.0, rng.uniform(-0.3, 0.3)),
    )
    both = rng.random() < 0.55
    side = str(rng.choice(["L", "R"]))
    y, low = -rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.45)
    for s in "LR":
        k = signs(s)
        if both or s == side:
            w = vec(k * rng.uniform(0.04, 0.16), y, low)
            pose.arms[s] = Arm(w, vec(k, 0.5, 0.0), vec(-0.2 * k, -0.4, -1), vec(-k, 0.3, 0), local=False, curl=0.3)
        else:
            hip, knee = _knee(f, pose, s)
            w = hip + 0.75 * (knee - hip) + vec(0.02 * k, -0.10, 0.06)
            pose.arms[s] = Arm(w, vec(k, 0.3, 0.3), vec(-0.3 * k, -0.3, -1), vec(0, 1, -0.4), local=False, curl=0.3)
    color = fu.bright(rng)

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        g = 0.5 * (grip_of(f, pos, "L") + grip_of(f, pos, "R")) if both else grip_of(f, pos, side)
        wide = 0.12 if not both else max(0.12, abs(grip_of(f, pos, "L")[0] - grip_of(f, pos, "R")[0]) - 0.02)
        size = (wide, 0.18, max(g[2], 0.08))
        return [fu.make("thing", (g[0], g[1] - 0.05, size[2] / 2), size, "paint", color, 0.0, True)]

    return Setup(pose, pull={"L": 0.1, "R": 0.1}, things=things, touch=0.075)


def reaching_high(f: Fit, rng: Rng) -> Setup:
    """Takes something from a high board."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    s = signs(side)
    up = rng.uniform(0.1, 0.7) * f.arm
    out = max(np.sqrt((0.95 * f.arm) ** 2 - up**2) * rng.uniform(0.75, 1.0), 0.3)
    x = s * f.shoulder[0] * rng.uniform(0.3, 1.3)
    w = vec(x, -out, f.shoulder[2] + 0.03 + up)
    main = Arm(w, vec(s, 0.3, -0.8), vec(-0.1 * s, -1, 0.15), vec(-s, 0, -0.4), local=False, curl=0.35)
    arms = {side: main, other: hang(f, rng, other)}
    if rng.random() < 0.25:
        w2 = w * np.array([-1, 1, 1])
        arms[other] = Arm(w2, vec(-s, 0.3, -0.8), vec(0.1 * s, -1, 0.15), vec(s, 0, -0.4), local=False, curl=0.35)
    pose = stance(f, rng, arms)
    pose.head = (rng.uniform(-0.5, 0.0), 0.0, rng.uniform(-0.2, 0.2))
    kid, color = int(rng.integers(1 << 30)), fu.bright(rng)

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        inner = np.random.default_rng(kid)
        g = grip_of(f, pos, side)
        y = min(
            float(bone(f, pos, f"wrist.{side}")[1]) - 0.03, float(posed[posed[:, 2] < g[2] - 0.3][:, 1].min()) - 0.03
        )
        board = g[2] - inner.uniform(0.07, 0.11)
        boards = [board]
        while boards[-1] > 0.45:
            boards.append(boards[-1] - inner.uniform(0.3, 0.4))
        width = inner.uniform(0.7, 1.2)
        out = fu.shelf(inner, y, 0.32, width, boards, board + inner.uniform(0.36, 0.44), g[0])
        free = [(g[0] - 0.3, g[0] + 0.3)] + [(9.0, 9.0)] * (len(boards) - 1)
        for z, gap in zip(boards, free, strict=True):
            out += fu.books(inner, y, width, z, g[0], gap)
        size = (0.09, 0.12, 0.2)
        centre = (g[0], g[1] - 0.02, board + 0.1)
        return [*out, fu.make("thing", centre, size, "paint", color, 0.0, True)]

    return Setup(pose, {side: 0.15 + 0.25 * up / f.arm}, {side: 0.15}, things, "away")


def reaching_low(f: Fit, rng: Rng) -> Setup:
    """At a low drawer with bent knees and back."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    s = signs(side)
    deep = rng.uniform(0.1, 0.4) * f.leg
    feet = {k: Foot((signs(k) * rng.uniform(0.09, 0.17), rng.uniform(-0.08, 0.08)), signs(k) * 0.2) for k in "LR"}
    w = vec(s * rng.uniform(0.02, 0.2), -rng.uniform(0.5, 0.62), rng.uniform(0.32, 0.62))
    pose = Pose(
        vec(0, 0.12 + 0.35 * deep, f.hip - 0.02 - deep),
        0.0,
        feet,
        {},
        tilt=rng.uniform(0.35, 0.75),
        spine=(rng.uniform(0.3, 0.65), 0.0, -s * rng.uniform(0.0, 0.2)),
        head=(rng.uniform(-0.4, 0.1), 0.0, rng.uniform(-0.2, 0.2)),
    )
    main = Arm(w, vec(s, 0.4, -0.3), vec(-0.1 * s, -1, -0.35), vec(0, 0.2, -1), local=False, curl=0.5)
    hip, knee = _knee(f, pose, other)
    w2 = hip + 0.8 * (knee - hip) + vec(-0.02 * s, -0.06, 0.11)
    rest = Arm(w2, vec(-s, 0.3, 0.3), vec(0.3 * s, -0.6, -0.6), vec(0, 0.6, -1), local=False, curl=0.3)
    pose.arms = {side: main, other: rest}
    return Setup(pose, {}, {side: 0.2}, _drawer(rng, side), "away", touch=0.07)


def _drawer(rng: Rng, side: str) -> Maker:
    kid = int(rng.integers(1 << 30))

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        inner = np.random.default_rng(kid)
        g = grip_of(f, pos, side, 1.35)
        z = g[2] - 0.02
        y_front = float(g[1]) - 0.035
        pull = float(inner.uniform(0.02, 0.28))
        return fu.drawer_unit(inner, y_front, float(z), float(g[0]), pull, float(g[1]))

    return things


def opening_drawer(f: Fit, rng: Rng) -> Setup:
    """Pulls a drawer at waist height."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    s = signs(side)
    z = min(rng.uniform(0.75, 1.1), f.shoulder[2] - 0.15)
    w = vec(s * rng.uniform(0.02, 0.28), -rng.uniform(0.36, 0.5) * f.arm / 0.5, z)
    main = Arm(w, vec(s, 0.5, -0.5), vec(-0.15 * s, -1, -0.25), vec(0, 0.15, -1), local=False, curl=0.5)
    arms = {side: main, other: hang(f, rng, other) if rng.random() < 0.7 else gesture(f, rng, other)}
    pose = stance(f, rng, arms)
    pose.tilt, pose.spine = rng.uniform(0.02, 0.2), (rng.uniform(0.1, 0.35), 0.0, -s * rng.uniform(0, 0.2))
    pose.head = (rng.uniform(0.1, 0.4), 0.0, rng.uniform(-0.2, 0.2))
    return Setup(pose, {}, {side: 0.2}, _drawer(rng, side), "away")


def opening_door(f: Fit, rng: Rng) -> Setup:
    """Hand at the handle of a door in a wall."""
    side = str(rng.choice(["L", "R"]))
    other = "R" if side == "L" else "L"
    s = signs(side)
    w = vec(s * rng.uniform(0.08, 0.32), -rng.uniform(0.40, 0.58) * f.arm / 0.52, rng.uniform(0.98, 1.08))
    w[2] = min(w[2], f.shoulder[2] - 0.1)
    main = Arm(w, vec(s, 0.4, -0.6), vec(-0.25 * s, -1, -0.05), vec(0, 0.1, -1), local=False, curl=0.45)
    arms = {side: main, other: hang(f, rng, other)}
    pose = stance(f, rng, arms)
    pose.spine = (rng.uniform(0.03, 0.2), 0.0, -s * rng.uniform(0, 0.25))
    angle = rng.choice([0.0, rng.uniform(0.05, 0.8)])
    hinge = float(rng.choice([-1.0, 1.0]))
    kid = int(rng.integers(1 << 30))

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        return fu.door(np.random.default_rng(kid), grip_of(f, pos, side, 1.3) - vec(0, 0, 0.02), hinge, angle)

    return Setup(pose, {}, {side: 0.15}, things, "away")


def carrying(f: Fit, rng: Rng) -> Setup:
    """A box in both hands, standing or walking."""
    wide, deep, high = rng.uniform(0.22, 0.46), rng.uniform(0.18, 0.36), rng.uniform(0.12, 0.32)
    z = f.hip + rng.uniform(0.05, 0.30)
    near = min(f.surface(z), f.surface(z + 0.1)) - 0.05
    centre = vec(0, near - deep / 2, z)
    arms = {}
    for side in "LR":
        s = signs(side)
        w = vec(s * (wide / 2 + 0.028), centre[1] + 0.10, z - rng.uniform(0.0, 0.3) * high)
        arms[side] = Arm(w, vec(s, 0.8, -0.6), vec(-0.12 * s, -1, -0.05), vec(-s, 0, 0.25), local=False, curl=0.12)
    base = walking(f, rng) if rng.random() < 0.4 else Setup(stance(f, rng, arms))
    pose = base.pose
    pose.arms = arms
    pose.yaw = pose.roll = 0.0
    pose.pelvis[:2] = 0
    pose.tilt, pose.spine = rng.uniform(-0.05, 0.02), (rng.uniform(-0.03, 0.06), 0.0, 0.0)
    pose.head = (rng.uniform(-0.05, 0.3), 0.0, rng.uniform(-0.6, 0.6))
    color = (0.42, 0.28, 0.16) if rng.random() < 0.5 else fu.bright(rng)

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        left, right = grip_of(f, pos, "L"), grip_of(f, pos, "R")
        width = max(float(left[0] - right[0]) - 0.035, 0.12)
        c = (0.5 * float(left[0] + right[0]), centre[1], 0.5 * float(left[2] + right[2]) + 0.2 * high)
        return [fu.make("carried", c, (width, deep, high), "paint", color, 0.0, True)]

    return Setup(pose, pull={"L": 0.1, "R": 0.1}, things=things)


def reading(f: Fit, rng: Rng) -> Setup:
    """Looks at a telephone, tablet or paper in both hands or one."""
    z = f.shoulder[2] - rng.uniform(0.15, 0.4)
    y = f.surface(z) - rng.uniform(0.12, 0.24)
    size = rng.choice([0.07, 0.2, 0.3])
    arms = {}
    for side in "LR":
        s = signs(side)
        w = spot(f, side, vec(size / 2 + 0.04, y + 0.03, z - 0.07))
        arms[side] = Arm(w, vec(s, 0.2, -0.9), vec(-0.45 * s, -0.55, 0.7), vec(-0.75 * s, 0.25, 0.5), curl=0.35)
    if size < 0.1:
        side = str(rng.choice(["L", "R"]))
        arms[side] = hang(f, rng, side)
    pose = stance(f, rng, arms)
    pose.head = (rng.uniform(0.25, 0.55), 0.0, rng.uniform(-0.1, 0.1))
    color = fu.bright(rng, 0.02, 0.8)

    def things(f: Fit, rot: Array, pos: Array, posed: Array) -> list[Prop]:
        held = [s for s in "LR" if bone(f, pos, f"wrist.{s}")[2] > z - 0.2]
        if not held:
            return []
        g = np.mean([grip_of(f, pos, s, 1.3) for s in held], 0)
        slab = (max(size, 0.08), 0.012, 0.15 if size < 0.1 else 0.22)
        return [fu.make("slab", (g[0], g[1] - 0.01, g[2] + 0.03), slab, "paint", color, 0.0, True)]

    return Setup(pose, things=things, touch=0.06)


POSTURES: dict[str, Callable[[Fit, Rng], Setup]] = {
    "standing": standing,
    "talking": talking,
    "arms_crossed": arms_crossed,
    "walking": walking,
    "sitting": sitting,
    "sitting_table": sitting_table,
    "crouching": crouching,
    "bending": bending,
    "reaching_high": reaching_high,
    "reaching_low": reaching_low,
    "opening_drawer": opening_drawer,
    "opening_door": opening_door,
    "carrying": carrying,
    "at_table": at_table,
    "at_head": at_head,
    "arm_up": arm_up,
    "reading": reading,
    "kneeling": kneeling,
}


@dataclass
class Posed:
    """A solved posture in the person's own frame."""

    name: str
    rot: Array
    pos: Array
    skin: Array
    props: list[Prop]
    facing: str


def _settle(f: Fit, pose: Pose, rng: Rng) -> None:
    """Lower the hips until both feet can be reached."""
    b: Body = f.body
    half = b.head_of("upperleg01.L")[0]
    limit = f.leg * (0.9985 - 0.014 * rng.random() ** 2)
    for _ in range(40):
        far = 0.0
        for side in "LR":
            _, ankle = place_foot(b, side, pose.feet[side])
            c, s = np.cos(pose.yaw), np.sin(pose.yaw)
            k = signs(side) * half
            hip = pose.pelvis + vec(k * c, k * s, -k * np.sin(pose.roll))
            far = max(far, float(np.linalg.norm(ankle - hip)))
        if far <= limit:
            return
        pose.pelvis = pose.pelvis - vec(0, 0, 0.004)


def make_posture(f: Fit, name: str, rng: Rng, tries: int = 24) -> Posed | None:
    """A posture of that name whose limbs keep out of the body and of the things that belong to it."""
    for _ in range(tries):
        setup = POSTURES[name](f, rng)
        _settle(f, setup.pose, rng)
        rot, pos = solve_pose(f.body, setup.pose, setup.lift, setup.pull)
        if not np.isfinite(pos).all() or self_contact(f, pos) > setup.touch:
            continue
        posed = bare(f.body, rot, pos)
        if posed[:, 2].min() < -0.01:
            continue
        props = setup.things(f, rot, pos, posed) if setup.things else []
        body = posed[f.body.weight_of("finger", "metacarpal", "wrist") < 0.5]
        bad = 0
        for p in props:
            if p.centre is None:
                continue
            depth = p.inside(posed if not p.held else body)
            bad += int((depth > 0.025).sum())
        if bad <= 12:
            return Posed(name, rot, pos, posed, props, setup.facing)
    return None
