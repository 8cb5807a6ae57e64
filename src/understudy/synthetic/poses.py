"""Random human postures: who does what is drawn from `pose_activities`, and solved here for the whole batch at once.

A posture is a few dozen uniform numbers (`Draws`) scaled to the ranges of an activity: legs and trunk by angles or by
where the feet stand, hands by where the wrists are. Several candidates of the legs and of each arm are computed, and
the one that respects the joints' limits and stays clear of the rest of the body is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from understudy.errors import UnderstudyError, one_of
from understudy.synthetic import kinematics as kin
from understudy.synthetic.kinematics import along, axes, cross, interpolate, rot, turn, unit, within_limits
from understudy.synthetic.pose_activities import (
    ACTIVITIES,
    ACTIVITY_TABLE,
    FRAMES,
    HANDS,
    LEG_FIELDS,
    LOWER,
    LOWER_DEFAULT,
    PELVIS_FIELDS,
    TRUNK_DEFAULT,
    TRUNK_FIELDS,
)
from understudy.synthetic.segments import SEGMENT

__all__ = ["ACTIVITIES", "PoseBatch", "interpolate", "sample_poses", "sequence", "within_limits"]

NAMES: Final = tuple(ACTIVITIES)
LEGS_TRIED: Final = 4
TARGETS_TRIED: Final = 4
SWIVELS_TRIED: Final = 5
TRIED: Final = TARGETS_TRIED * SWIVELS_TRIED
BAD_CLASH: Final = 0.08
_DEG: Final = math.pi / 180
_IN_DEGREES: Final = {"tilt", "roll", "yaw", "flex", "abd", "rot", "knee", "fyaw", "fpitch", "out"}
_CHOICES: Final = ("lower", "hands", "mirror", "phase", "look", "lay")


@dataclass(frozen=True)
class PoseBatch:
    """Postures and what they are.

    Attributes:
        rotations: absolute rotation of each segment, `R_body_segment` (see `segments.py`); the pelvis faces about -y.
        activity: index into `NAMES`.
        clash: metres by which limbs are inside the body or each other (sum over the checked points); 0 = free.
    """

    rotations: Float[Tensor, "n 21 3 3"]
    activity: Int[Tensor, "n"]
    clash: Float[Tensor, "n"]

    @property
    def names(self) -> list[str]:
        """Each posture's activity in words."""
        return [NAMES[i] for i in self.activity.tolist()]


@dataclass(frozen=True)
class _Tables:
    """The activities' tables as tensors on one device; angles in radians."""

    lower_choice: Tensor  # [A, S] cumulative weights
    hands_choice: Tensor  # [A, P] cumulative weights
    hands: Tensor  # [A, P, 3]: style of hand a, of hand b, b mirrors a
    trunk: Tensor  # [A, T, 2]
    pelvis: Tensor  # [S, F, 2]
    legs: Tensor  # [S, leg a or b, F, 2]
    box: Tensor  # [H, 3, 2]
    palm: Tensor  # [H, 3]
    elbow: Tensor  # [H, 3]
    hand: Tensor  # [H, (frame, fk, ball, palm is free, swing, wrist), curl low, curl high]


def _cumulative(weights: list[list[float]]) -> Tensor:
    width = max(len(w) for w in weights)
    table = torch.tensor([w + [0.0] * (width - len(w)) for w in weights], dtype=torch.float64)
    return (table / table.sum(1, keepdim=True)).cumsum(1).float()


@lru_cache(maxsize=4)
def _tables(device: str) -> _Tables:
    styles, lowers = list(HANDS), list(LOWER)
    pairs: list[list[list[float]]] = []
    for row in ACTIVITY_TABLE.values():
        entries = row["hands"]
        pairs.append(
            [[styles.index(a), styles.index(b.rstrip("+")), float(b.endswith("+")), w] for a, b, w in entries]  # type: ignore[attr-defined]
        )
    width = max(len(p) for p in pairs)
    hands = torch.tensor([[e[:3] for e in p] + [[0.0, 0.0, 0.0]] * (width - len(p)) for p in pairs]).long()

    def span(row: dict[str, object], name: str, side: str = "") -> list[float]:
        value = row.get(f"{name}_{side}", row.get(name, LOWER_DEFAULT.get(name)))
        scale = _DEG if name in _IN_DEGREES else 1.0
        return [float(v) * scale for v in value]  # type: ignore[union-attr]

    def trunk(row: dict[str, object], name: str) -> list[float]:
        value = row.get(name, TRUNK_DEFAULT[name])
        if name == "look":
            return [float(value), 0.0]  # type: ignore[arg-type]
        return [v * _DEG for v in value]  # type: ignore[attr-defined]

    box, palm, elbow, numbers = [], [], [], []
    for row in HANDS.values():
        place = row.get("ball", row.get("box", ((0, 0),) * 3))
        scale = (_DEG, _DEG, 1.0) if "ball" in row else (1.0, 1.0, 1.0)
        box.append([[v * s for v in r] for r, s in zip(place, scale, strict=True)])  # type: ignore[call-overload]
        palm.append(list(row.get("palm") or (0, 0, -1)))  # type: ignore[call-overload]
        elbow.append(list(row.get("elbow", (0.35, -0.7, -0.6))))  # type: ignore[call-overload]
        low, high = row.get("curl", (0, 90))  # type: ignore[misc]
        numbers.append(
            [FRAMES.index(str(row.get("at", "level"))), float("fk" in row), float("ball" in row), float(row.get("palm") is None),
             float("swing" in row), float(row.get("wrist", 20)) * _DEG, low * _DEG, high * _DEG]  # type: ignore[arg-type]
        )  # fmt: skip
    tables = _Tables(
        lower_choice=_cumulative([[float(row["lower"].get(s, 0)) for s in lowers] for row in ACTIVITY_TABLE.values()]),  # type: ignore[attr-defined]
        hands_choice=_cumulative([[e[3] for e in p] for p in pairs]),
        hands=hands,
        trunk=torch.tensor([[trunk(row, f) for f in TRUNK_FIELDS] for row in ACTIVITY_TABLE.values()]),
        pelvis=torch.tensor([[span(row, f) for f in PELVIS_FIELDS] for row in LOWER.values()]),  # type: ignore[arg-type]
        legs=torch.tensor([[[span(row, f, s) for f in LEG_FIELDS] for s in "ab"] for row in LOWER.values()]),  # type: ignore[arg-type]
        box=torch.tensor(box, dtype=torch.float32),
        palm=torch.tensor(palm, dtype=torch.float32),
        elbow=torch.tensor(elbow, dtype=torch.float32),
        hand=torch.tensor(numbers, dtype=torch.float32),
    )
    return _Tables(**{f.name: getattr(tables, f.name).to(device) for f in fields(_Tables)})


@lru_cache(maxsize=4)
def _gait(device: str) -> Tensor:
    """[walk or run, 100 phases, (thigh forward, knee, toes down)] radians; phase 0 = the heel strikes."""
    knots = {  # degrees at 0, 10, ... 90 % of the cycle
        0: ((28, 24, 16, 6, -4, -12, -2, 18, 30, 32), (5, 17, 15, 8, 6, 20, 48, 60, 38, 10), (-18, 0, 0, 0, 4, 22, 58, 46, 12, -12)),
        1: ((38, 28, 8, -12, -24, -10, 18, 42, 56, 50), (22, 42, 36, 24, 30, 66, 100, 108, 80, 40), (-8, 0, 4, 24, 60, 80, 75, 55, 20, -5)),
    }  # fmt: skip
    phase = torch.arange(100) / 100
    order = torch.arange(10)
    basis = torch.exp(-(((phase[:, None] - order / 10 + 0.5) % 1 - 0.5) ** 2) / (2 * 0.055**2))
    basis = basis / basis.sum(1, keepdim=True)
    curves = torch.stack([torch.stack([basis @ torch.tensor(c, dtype=torch.float32) for c in knots[k]], -1) for k in (0, 1)])
    return (curves * _DEG).to(device)


@dataclass(frozen=True)
class Draws:
    """All that is random about postures: uniform numbers in [0, 1)."""

    activity: Tensor  # [n] indices
    choices: Tensor  # [n, len(_CHOICES)]
    trunk: Tensor  # [n, T]
    pelvis: Tensor  # [n, tried, F]
    legs: Tensor  # [n, tried, 2, F]
    hands: Tensor  # [n, 2, tried, 12]

    def take(self, rows: Tensor) -> Draws:
        """Some rows only."""
        return Draws(*(getattr(self, f.name)[rows] for f in fields(self)))


_SHAPES: Final = (
    (len(_CHOICES),), (len(TRUNK_FIELDS),), (LEGS_TRIED, len(PELVIS_FIELDS)), (LEGS_TRIED, 2, len(LEG_FIELDS)), (2, TRIED, 12),
)  # fmt: skip


def draw(activity: Tensor, generator: torch.Generator, device: str) -> Draws:
    """Uniform numbers for the given activities; the same generator state gives the same postures on every device."""
    sizes = [math.prod(s) for s in _SHAPES]
    u = torch.rand(len(activity), sum(sizes), generator=generator, device=generator.device).to(device)
    parts = [p.unflatten(1, s) for p, s in zip(u.split(sizes, 1), _SHAPES, strict=True)]
    return Draws(activity.to(device), *parts)


# -- legs ----------------------------------------------------------------------------------------------------------


def _point_segment(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Distances [..., P, S] of points [..., P, 3] from line segments [..., S, 3]."""
    d = end - start
    length2 = (d * d).sum(-1).clamp_min(1e-8)
    pd = points @ d.mT - (start * d).sum(-1)[..., None, :]
    share = (pd / length2[..., None, :]).clamp(0, 1)
    pa2 = (points * points).sum(-1)[..., None] - 2 * points @ start.mT + (start * start).sum(-1)[..., None, :]
    return (pa2 - 2 * share * pd + share * share * length2[..., None, :]).clamp_min(0).sqrt()


@dataclass(frozen=True)
class _Legs:
    """Legs in right-hand coordinates: axis `side` is (right, left with x mirrored)."""

    pelvis: Tensor  # [..., 3, 3]
    thigh: Tensor  # [..., 2, 3, 3]
    shin: Tensor
    foot: Tensor
    height: Tensor  # [...] hips above the floor
    cost: Tensor
    clash: Tensor


def _solve_legs(table: _Tables, lower: Tensor, draws: Draws, fold: Tensor, gait: Tensor) -> _Legs:
    """All candidates' legs; leading shape [n, tried]."""
    device = lower.device
    span = table.pelvis[lower][:, None]
    tilt, roll, yaw, sx, sy, drop, gait_kind, kneel, amp, _, seat = (
        span[..., 0] + (span[..., 1] - span[..., 0]) * draws.pelvis
    ).unbind(-1)
    tilt = (tilt + fold[:, None]).clamp(max=1.25)
    pelvis = rot(2, yaw) @ rot(0, tilt) @ rot(1, roll)
    span = table.legs[lower][:, None]
    fk, flex, abd, turn_out, knee, o, f, lift, fyaw, fpitch, frel, out = (
        span[..., 0] + (span[..., 1] - span[..., 0]) * draws.legs
    ).unbind(-1)
    sign = torch.tensor([1.0, -1.0], device=device)
    lies = (table.pelvis[lower, PELVIS_FIELDS.index("lay"), 0] > 0.5)[:, None, None]
    quarter = torch.floor(draws.choices[:, _CHOICES.index("lay")] * 4)[:, None, None]
    flex = torch.where(lies & (quarter == 2), 0.1 * flex, flex)  # on the belly
    abd = torch.where(lies & (quarter % 2 == 1), 0.2 * abd, abd)  # on a side
    phase = (gait[:, None] + torch.tensor([0.0, 0.5], device=device))[:, None].expand(fk.shape)
    index = (phase % 1) * 100
    first = index.long().clamp(0, 99)
    curves = _gait(str(device))
    kind = (gait_kind[..., None] > 1.5).long().expand_as(first)
    part = (index - first)[..., None]
    cycle = curves[kind, first] * (1 - part) + curves[kind, (first + 1) % 100] * part
    walks = gait_kind[..., None] > 0.5
    wide = amp[..., None]
    flex = torch.where(walks, cycle[..., 0] * wide + 0.05 * (1 - wide), flex)
    knee = torch.where(walks, cycle[..., 1] * (0.35 + 0.65 * wide), knee)
    fpitch = torch.where(walks, cycle[..., 2] * wide, fpitch)
    # by angles
    thigh_fk = rot(0, -flex) @ rot(1, abd) @ rot(2, -turn_out)
    knee = torch.where(kneel[..., None] * fk > 0.5, knee + flex, knee)  # shins on the floor
    shin_fk = thigh_fk @ rot(0, knee)
    low = -kin.THIGH * thigh_fk[..., 2, 2]  # z of the knee under the hip
    ankle_low = low - kin.SHIN * shin_fk[..., 2, 2]
    height_fk = torch.where(
        kneel > 0.5,
        -torch.where(fk > 0.5, low, torch.zeros_like(low)).amin(-1) + 0.055,
        -ankle_low.amin(-1).clamp(max=-0.05) + kin.ANKLE_HEIGHT,
    )
    # by the foot's place: mirrored coordinates, x of the left side is turned over
    hip = torch.stack((-kin.HIP_HALF * pelvis[..., 0, 0], -kin.HIP_HALF * pelvis[..., 1, 0], -kin.HIP_HALF * pelvis[..., 2, 0]), -1)
    hip = torch.stack((hip, torch.stack((hip[..., 0], -hip[..., 1], -hip[..., 2]), -1)), -2)
    back = sy + 0.17 * fold.clamp(0, 1.2)[:, None].sin()
    raised = torch.where(
        fpitch > 0, 0.12 * fpitch.sin() + kin.ANKLE_HEIGHT * fpitch.cos(), 0.05 * fpitch.abs().sin() + kin.ANKLE_HEIGHT * fpitch.cos()
    )
    place_x, place_y = -o - sign * sx[..., None], -f - back[..., None]
    flat2 = (place_x - hip[..., 0]) ** 2 + (place_y - hip[..., 1]) ** 2
    longest = kin.THIGH + kin.SHIN - 0.003
    stretched = hip[..., 2] + (longest**2 - flat2).clamp_min(0.01).sqrt() + raised + lift
    stretched = torch.where(fk > 0.5, torch.full_like(stretched, 9.0), stretched).amin(-1)
    planted = (fk.amin(-1) < 0.5) & (kneel < 0.5)
    height = torch.where(seat > 0, seat, torch.where(planted, stretched - drop, height_fk))
    goal = torch.stack((place_x, place_y, raised + lift - height[..., None]), -1)
    knee_yaw = fyaw + out
    pole = torch.stack((-knee_yaw.sin(), -knee_yaw.cos(), torch.full_like(knee_yaw, 0.15)), -1)
    shortest = 0.16
    thigh_ik, shin_ik = kin.leg_frames(*kin.two_bone(hip, goal, pole, kin.THIGH, kin.SHIN, shortest))
    by_angle = (fk > 0.5)[..., None, None]
    thigh, shin = torch.where(by_angle, thigh_fk, thigh_ik), torch.where(by_angle, shin_fk, shin_ik)
    # feet: level, heading with the knee's axis; or relative to the shin
    across = shin[..., 0]
    level_yaw = torch.where(fk > 0.5, torch.atan2(across[..., 1], across[..., 0]), torch.zeros_like(fyaw)) - fyaw
    pitch = rot(0, fpitch)
    foot = torch.where((frel > 0.5)[..., None, None], shin @ pitch, rot(2, level_yaw) @ pitch)
    # costs: legs in each other, joints out of range
    knees = hip - kin.THIGH * thigh[..., 2]
    ankles = knees - kin.SHIN * shin[..., 2]
    toes = ankles + along(foot, (0.0, -0.16, -0.05))
    flip = torch.tensor([-1.0, 1.0, 1.0], device=device)
    own = torch.stack((hip, knees, ankles, toes), -2)
    right, left = own[..., 0, :, :], own[..., 1, :, :] * flip
    points = torch.cat((right[..., 1:, :], 0.5 * (right[..., 1:, :] + right[..., :-1, :])), -2)
    gap = _point_segment(points, left[..., :-1, :], left[..., 1:, :])
    points = torch.cat((left[..., 1:, :], 0.5 * (left[..., 1:, :] + left[..., :-1, :])), -2)
    gap2 = _point_segment(points, right[..., :-1, :], right[..., 1:, :])
    clash = (0.10 - gap.amin((-2, -1))).clamp_min(0) + (0.10 - gap2.amin((-2, -1))).clamp_min(0)
    local = pelvis_local(pelvis, thigh)
    hip_flex = torch.atan2(-local[..., 1], -local[..., 2])
    excess = (hip_flex - 2.6).clamp_min(0) * (hip_flex < 2.8) + (-0.8 - hip_flex).clamp_min(0) * (hip_flex > -2.5)
    excess = excess + (local[..., 0] - 0.65).clamp_min(0)
    ankle = kin._angle(shin.mT @ foot)
    below = (-height[..., None] + 0.03 - torch.minimum(ankles[..., 2], toes[..., 2])).clamp_min(0)
    cost = 20 * clash + (3 * excess + 3 * (ankle - 1.2).clamp_min(0) + 2 * below).sum(-1) + 0.02 * draws.pelvis[..., -1]
    return _Legs(pelvis, thigh, shin, foot, height, cost, clash)


def pelvis_local(pelvis: Tensor, thigh: Tensor) -> Tensor:
    """Thighs' directions [..., 2, 3] in the pelvis' frame, x mirrored for the left one."""
    flip = torch.tensor([-1.0, 1.0, 1.0], device=pelvis.device)
    mirrored = torch.stack((pelvis, pelvis * (flip[:, None] * flip)), -3)
    return -turn(mirrored.mT, thigh[..., 2])


# -- arms ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Arm:
    """One arm in right-hand coordinates."""

    clavicle: Tensor  # [n, 3, 3] ...
    upper: Tensor
    fore: Tensor
    hand: Tensor
    fingers: Tensor
    elbow: Tensor  # [n, 3] ...
    wrist: Tensor
    clash: Tensor  # [n]
    chosen: Tensor  # [n]


@dataclass(frozen=True)
class _Body:
    """What the arms need to know of the rest, in right-hand coordinates (x mirrored for the left arm)."""

    pelvis: Tensor
    chest: Tensor
    head: Tensor
    neck_base: Tensor  # origins [n, 3]
    chest_at: Tensor
    head_at: Tensor
    knee: Tensor
    thigh: Tensor
    height: Tensor
    up: Tensor  # [n, 3] out of the floor, which is `under` below the hips
    under: Tensor
    starts: Tensor  # capsules [n, C, 3]
    ends: Tensor
    radii: Tensor  # [C]

    def mirrored(self) -> _Body:
        """For the left arm; knees and capsules are the caller's to set."""
        flip = torch.tensor([-1.0, 1.0, 1.0], device=self.pelvis.device)
        both = flip[:, None] * flip
        return replace(
            self, pelvis=self.pelvis * both, chest=self.chest * both, head=self.head * both, neck_base=self.neck_base * flip,
            thigh=self.thigh * both, up=self.up * flip, chest_at=self.chest_at * flip, head_at=self.head_at * flip, knee=self.knee * flip, starts=self.starts * flip,
            ends=self.ends * flip,
        )  # fmt: skip


def _solve_arm(table: _Tables, style: Tensor, u: Tensor, body: _Body, phase: Tensor, amp: Tensor, chosen: Tensor | None) -> _Arm:
    """Try targets and swivels of the right arm; keep the best (or the `chosen` one).

    Args:
        style: [n] hand style.
        u: [n, tried, 12] uniform numbers.
        body: the rest of the body, in right-hand coordinates.
        phase: [n] phase of the opposite leg, for swinging arms.
        amp: [n] how wide the swing is.
        chosen: [n] candidates to take, or None.
    """
    n = len(style)
    device = style.device
    frame_i, fk, ball, free, swing, wrist_spread, curl_low, curl_high = table.hand[style].unbind(-1)
    frame_i = frame_i.long()
    eye = torch.eye(3, device=device).expand(n, 3, 3)
    clavicle_at = body.chest_at + along(body.chest, (-0.02, 0.0, 0.22))
    shoulder = clavicle_at + along(body.chest, (-kin.SHOULDER[0], 0.0, 0.0))
    ground = torch.stack((torch.zeros_like(body.height), torch.zeros_like(body.height), -body.height), -1)
    places = torch.stack((shoulder, shoulder, torch.zeros_like(shoulder), clavicle_at + along(body.chest, (0.02, 0.0, 0.0)),
                          body.head_at + along(body.head, (0.0, 0.0, 0.08)), body.knee, ground), 1)  # fmt: skip
    frames = torch.stack((body.chest, eye, body.pelvis, body.chest, body.head, body.thigh, eye), 1)
    rows = torch.arange(n, device=device)
    place, frame = places[rows, frame_i], frames[rows, frame_i]
    # the wrist's target: one for every group of swivels
    span = table.box[style][:, None]
    target_u = u[:, ::SWIVELS_TRIED, :3].repeat_interleave(SWIVELS_TRIED, 1)
    spot = span[..., 0] + (span[..., 1] - span[..., 0]) * target_u
    azimuth, elevation, distance = spot.unbind(-1)
    level = distance * elevation.cos()
    round_spot = torch.stack((level * azimuth.sin(), level * azimuth.cos(), distance * elevation.sin()), -1)
    spot = torch.where((ball > 0.5)[:, None, None], round_spot, spot)
    wave = (swing * amp * (2 * math.pi * phase).cos())[:, None]  # in front when the other leg is
    shift = torch.stack((torch.zeros_like(wave), 0.2 * wave, 0.04 * wave.abs()), -1)
    spot = spot + shift
    spot = spot * torch.tensor([-1.0, -1.0, 1.0], device=device)
    target = place[:, None] + (frame[:, None] @ spot[..., None])[..., 0]
    # free arms: any direction
    z = 2 * u[..., 0] - 1
    around = 2 * math.pi * u[..., 1]
    ring = (1 - z * z).clamp_min(0).sqrt()
    chest = body.chest[:, None]
    free_dir = turn(chest, torch.stack((ring * around.cos(), ring * around.sin(), z), -1))
    # collar bone: up and forward with the arm
    is_fk = (fk > 0.5)[:, None]
    heading = torch.where(is_fk[..., None], free_dir, (target - shoulder[:, None]) / 0.5)
    heading = turn(chest.mT, heading)
    lift = (0.12 + 0.5 * heading[..., 2].clamp(-0.6, 1)) * 0.75
    ahead = -0.28 * heading[..., 1].clamp(-0.7, 1.0)
    clavicle = chest @ rot(2, ahead) @ rot(1, lift)
    shoulder = clavicle_at[:, None] + along(clavicle, (-kin.SHOULDER[0], 0.0, 0.0))
    # by target: swivel the elbow around the line from shoulder to wrist
    line = unit(target - shoulder)
    liking = table.elbow[style] * torch.tensor([-1.0, -1.0, 1.0], device=device)
    liking = unit(turn(body.chest, liking))[:, None]
    base = unit(cross(line, liking.expand_as(line) + 1e-3))
    other = cross(base, line)  # towards where the elbow likes to be
    steps = torch.arange(SWIVELS_TRIED, device=device).repeat(TARGETS_TRIED)
    swivel = ((steps + u[..., 3]) / SWIVELS_TRIED - 0.5) * (2 * math.pi)
    swivel = swivel * (0.35 + 0.65 * (swivel / math.pi) ** 2)  # denser about the liked side
    pole = other * swivel.cos()[..., None] + base * swivel.sin()[..., None]
    first, second, hinge = kin.two_bone(shoulder, target, pole, kin.UPPER_ARM, kin.FOREARM, 0.15)
    upper_ik, fore_ik = kin.arm_frames(first, second, hinge)
    # by angles
    rest = chest * torch.tensor([1.0, 1.0, 1.0], device=device)
    swung = _shortest_turn(-rest[..., 0], free_dir) @ rest @ rot(0, (2 * u[..., 2] - 1) * 1.6)
    bend = (150 * _DEG) * u[..., 3] ** 1.2
    upper = torch.where(is_fk[..., None, None], swung, upper_ik)
    fore = torch.where(is_fk[..., None, None], swung @ rot(2, bend), fore_ik)
    elbow = shoulder - kin.UPPER_ARM * upper[..., 0]
    wrist = elbow - kin.FOREARM * fore[..., 0]
    # what it costs
    points = torch.stack((elbow, elbow + (wrist - elbow) * 0.35, elbow + (wrist - elbow) * 0.7, wrist,
                          wrist - 0.06 * fore[..., 0], wrist - 0.12 * fore[..., 0]), 2)  # fmt: skip
    own = torch.tensor([0.03, 0.04, 0.035, 0.03, 0.03, 0.02], device=device)
    gap = _point_segment(points.flatten(1, 2), body.starts, body.ends).unflatten(1, points.shape[1:3])
    inside = (own[:, None] + body.radii - gap).clamp_min(0)
    clash = inside.amax(-1).sum(-1)
    relative = chest.mT @ upper
    twist = kin.twist_x(relative)
    limits = kin.shoulder_excess(-relative[..., 0], twist)
    comfort = torch.where(is_fk, torch.zeros_like(twist), 0.25 * (1 - (pole * liking).sum(-1)) + 0.08 * twist**2)
    ends = torch.stack((elbow, wrist, wrist - 0.1 * fore[..., 0]), -2)
    floor = (0.03 - body.under[:, None, None] - (ends * body.up[:, None, None]).sum(-1)).clamp_min(0).sum(-1)
    short = (wrist - target).norm(dim=-1) * ~is_fk
    total = 25 * clash + 12 * limits + comfort + 5 * floor + 1.0 * short + 0.25 * u[..., 4]
    best = total.argmin(1) if chosen is None else chosen
    clavicle, upper, fore, elbow, wrist, line = (v[rows, best] for v in (clavicle, upper, fore, elbow, wrist, fore[..., 0]))
    noise = u[rows, best]
    # forearm and hand: the palm as the style wants it
    wish = unit(table.palm[style] + 0.8 * (noise[:, 5:8] - 0.5)) * torch.tensor([-1.0, -1.0, 1.0], device=device)
    wish = turn(fore.mT, turn(frame, wish))
    free_palm = free > 0.5
    pronation = torch.where(
        free_palm, (noise[:, 8] * 2 - 1) * 1.4, torch.atan2(wish[:, 1], -wish[:, 2]).clamp(-1.4, 1.4) + 0.4 * (noise[:, 8] - 0.5)
    )
    rolled = turn(rot(0, -pronation), wish)
    flexion = torch.atan2(rolled[:, 0], -rolled[:, 2]).clamp(-1.15, 1.2) * 0.75
    spread = wrist_spread * (noise[:, 9] * 2 - 1)
    flexion = torch.where(free_palm, spread, (flexion + spread).clamp(-1.2, 1.3))
    deviation = (noise[:, 10] * 2 - 1) * 0.45 * wrist_spread.clamp(max=0.8)
    hand = fore @ rot(0, pronation) @ rot(1, -flexion) @ rot(2, deviation)
    fingers = hand @ rot(1, -(curl_low + (curl_high - curl_low) * noise[:, 11]))
    fore = fore @ rot(0, 0.5 * pronation)
    return _Arm(clavicle, upper, fore, hand, fingers, elbow, wrist, clash[rows, best], best)


def _shortest_turn(a: Tensor, b: Tensor) -> Tensor:
    """The smallest rotation that takes unit vectors `a` to `b` ([..., 3] each, not opposite)."""
    v = torch.broadcast_tensors(cross(a.expand_as(b), b), b)[0]
    c = (a * b).sum(-1)[..., None, None]
    zero = torch.zeros_like(v[..., 0])
    x, y, w = v.unbind(-1)
    k = torch.stack((zero, -w, y, w, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, device=v.device)
    return eye + k + k @ k / (1 + c).clamp_min(1e-4)


# -- everything ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solved:
    """Postures and which candidates were kept (to keep them along a sequence)."""

    rotations: Tensor  # [n, 21, 3, 3]
    clash: Tensor  # [n]
    legs: Tensor  # [n] ...
    right: Tensor
    left: Tensor


def _pick(cumulative: Tensor, u: Tensor) -> Tensor:
    return (u[:, None] >= cumulative).sum(1).clamp(max=cumulative.shape[1] - 1)


def solve(draws: Draws, keep: Solved | None = None) -> Solved:
    """From uniform numbers to postures; `keep` fixes which candidates are taken."""
    device = draws.trunk.device
    table = _tables(str(device))
    activity, n = draws.activity, len(draws.activity)
    rows = torch.arange(n, device=device)
    pick_lower, pick_hands, pick_mirror, phase, pick_look, pick_lay = draws.choices.unbind(1)
    lower = _pick(table.lower_choice[activity], pick_lower)
    hand_a, hand_b, tied = table.hands[activity, _pick(table.hands_choice[activity], pick_hands)].unbind(-1)
    span = table.trunk[activity]
    fold, bend, lean, twist, nod, tip, head_turn, _ = (span[..., 0] + (span[..., 1] - span[..., 0]) * draws.trunk).unbind(1)
    look = pick_look < span[:, -1, 0]

    tried = _solve_legs(table, lower, draws, fold, phase)
    legs_kept = tried.cost.argmin(1) if keep is None else keep.legs
    legs = _Legs(*(getattr(tried, f.name)[rows, legs_kept] for f in fields(_Legs)))
    amp_span = table.pelvis[lower, PELVIS_FIELDS.index("amp")]
    amp = amp_span[:, 0] + (amp_span[:, 1] - amp_span[:, 0]) * draws.pelvis[rows, legs_kept, PELVIS_FIELDS.index("amp")]

    room = 1.9 - torch.asin(-legs.pelvis[:, 1, 2].clamp(-1, 1))  # nobody folds beyond the knees
    bend = torch.minimum(bend, room)
    abdomen = legs.pelvis @ rot(2, 0.4 * twist) @ rot(0, 0.45 * bend) @ rot(1, 0.45 * lean)
    chest = legs.pelvis @ rot(2, twist) @ rot(0, bend) @ rot(1, lean)
    chest_at = along(legs.pelvis, (0.0, 0.0, 0.10)) + along(abdomen, (0.0, 0.0, 0.16))
    neck_at = chest_at + along(chest, (0.0, 0.0, 0.26))
    stoop = torch.atan2(-chest[:, 1, 2], chest[:, 2, 2].clamp_min(0.2)).clamp(-0.3, 1.2)
    nod = nod - 0.45 * stoop
    neck, head = _head(chest, nod, tip, head_turn)
    head_at = neck_at + along(neck, (0.0, 0.0, 0.09))

    flip = torch.tensor([-1.0, 1.0, 1.0], device=device)
    both = flip[:, None] * flip
    side = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]], device=device)
    hips = -kin.HIP_HALF * legs.pelvis[:, :, 0]
    hips = torch.stack((hips, -hips), 1)
    knees = hips - kin.THIGH * legs.thigh[..., 2] * side
    ankles = knees - kin.SHIN * legs.shin[..., 2] * side
    waist = [along(legs.pelvis, (x, 0.0, z)) for x in (-0.07, 0.07) for z in (-0.04, 0.08)]
    ribs = [chest_at + along(chest, (x, 0.0, z)) for x in (-0.08, 0.08) for z in (0.0, 0.2)]
    starts = [waist[0], waist[2], waist[1], waist[3], ribs[0], ribs[2], head_at + along(head, (0.0, -0.02, 0.02))]
    ends = [waist[1], waist[3], ribs[0], ribs[2], ribs[1], ribs[3], head_at + along(head, (0.0, -0.02, 0.13))]
    starts = torch.cat((torch.stack(starts, 1), hips, knees), 1)
    ends = torch.cat((torch.stack(ends, 1), knees, ankles), 1)
    radii = torch.tensor([0.11, 0.11, 0.105, 0.105, 0.105, 0.105, 0.10, 0.075, 0.075, 0.05, 0.05], device=device)
    lies = table.pelvis[lower, PELVIS_FIELDS.index("lay"), 0] > 0.5
    quarter = torch.floor(pick_lay * 4) * (math.pi / 2)  # on the back, a side, the belly, the other side
    down = rot(0, torch.full_like(quarter, -math.pi / 2)) @ rot(2, quarter + 0.5 * (phase - 0.5))
    down = torch.where(lies[:, None, None], down, torch.eye(3, device=device))
    upward, under = down[:, 2], torch.where(lies, 0.16 + 0.05 * (quarter.sin() != 0), legs.height)
    body = _Body(legs.pelvis, chest, head, neck_at, chest_at, head_at, knees[:, 0], legs.thigh[:, 0], legs.height, upward, under, starts, ends, radii)
    right = _solve_arm(table, hand_a, draws.hands[:, 0], body, phase + 0.5, amp, None if keep is None else keep.right)
    clavicle_end = chest_at + along(chest, (-0.02, 0.0, 0.22)) + along(right.clavicle, (-kin.SHOULDER[0], 0.0, 0.0))
    other = replace(
        body,
        knee=knees[:, 1],
        thigh=legs.thigh[:, 1] * both,
        starts=torch.cat((starts, clavicle_end[:, None], right.elbow[:, None], right.wrist[:, None]), 1),
        ends=torch.cat((ends, right.elbow[:, None], right.wrist[:, None], (right.wrist - 0.1 * right.hand[..., 0])[:, None]), 1),
        radii=torch.cat((radii, torch.tensor([0.045, 0.035, 0.02], device=device))),
    ).mirrored()
    same = draws.hands[rows, 0, right.chosen][:, None].expand(-1, TRIED, -1)
    mine = draws.hands[:, 1]
    mixed = torch.cat((same[..., :3] + 0.15 * (mine[..., :3] - same[..., :3]), mine[..., 3:]), -1)
    u_left = torch.where((tied > 0)[:, None, None], mixed, mine)
    left = _solve_arm(table, hand_b, u_left, other, phase, amp, None if keep is None else keep.left)

    gaze = turn(chest.mT, unit(right.wrist - head_at))
    to_turn = torch.atan2(gaze[:, 0], -gaze[:, 1].clamp(max=-0.05)).clamp(-1.2, 1.2)
    to_nod = -torch.asin(gaze[:, 2].clamp(-1, 1)).clamp(-0.95, 1.0)
    looks = look & (table.hand[hand_a, 0] != FRAMES.index("head")) & (table.hand[hand_b, 0] != FRAMES.index("head"))
    neck_l, head_l = _head(chest, to_nod.clamp(-0.8, 0.95), 0.5 * tip, to_turn)
    neck, head = (torch.where(looks[:, None, None], a, b) for a, b in ((neck_l, neck), (head_l, head)))

    rights = (right.clavicle, right.upper, right.fore, right.hand, right.fingers)
    lefts = tuple(r * both for r in (left.clavicle, left.upper, left.fore, left.hand, left.fingers))
    leg_parts = torch.stack((legs.thigh, legs.shin, legs.foot), 2)
    out = torch.stack((legs.pelvis, abdomen, chest, neck, head, *rights, *lefts), 1)
    out = torch.cat((out, leg_parts[:, 0], leg_parts[:, 1] * both), 1)
    out = down[:, None] @ out
    out = torch.where((pick_mirror < 0.5)[:, None, None, None], kin.mirror(out), out)
    return Solved(out, legs.clash + right.clash + left.clash, legs_kept, right.chosen, left.chosen)


def _head(chest: Tensor, nod: Tensor, tip: Tensor, head_turn: Tensor) -> tuple[Tensor, Tensor]:
    neck = chest @ rot(2, 0.4 * head_turn) @ rot(0, 0.45 * nod) @ rot(1, 0.45 * tip)
    return neck, chest @ rot(2, head_turn) @ rot(0, nod) @ rot(1, tip)


def _activities(n: int, generator: torch.Generator, mix: dict[str, float] | None) -> Tensor:
    shares = dict(ACTIVITIES) if mix is None else mix
    unknown = sorted(set(shares) - set(ACTIVITIES))
    if unknown:
        raise UnderstudyError(f"activity {unknown[0]!r}: must be {one_of(ACTIVITIES)}")
    weights = torch.tensor([float(shares.get(name, 0.0)) for name in NAMES])
    if not bool((weights >= 0).all()) or not float(weights.sum()) > 0 or not math.isfinite(float(weights.sum())):
        raise UnderstudyError("mix: shares must not be negative, and one must be above 0")
    u = torch.rand(n, generator=generator, device=generator.device).to("cpu")
    return _pick((weights / weights.sum()).cumsum(0).expand(n, -1), u)


def sample_poses(
    n: int, generator: torch.Generator, device: str = "cpu", mix: dict[str, float] | None = None
) -> PoseBatch:
    """Random postures.

    Args:
        n: how many.
        generator: source of randomness; its state alone decides the result.
        device: where the tensors shall be.
        mix: activity -> weight; activities left out do not occur. None: the default shares in `ACTIVITIES`.
    """
    activity = _activities(n, generator, mix)
    draws = draw(activity, generator, device)
    solved = solve(draws)
    rotations, clash = solved.rotations, solved.clash
    bad = (~within_limits(rotations) | (clash > BAD_CLASH)).nonzero()[:, 0]
    if len(bad):  # a second try for the few that came out wrong
        again = solve(draw(draws.activity[bad], generator, device))
        better = ~within_limits(rotations[bad]) | (again.clash < clash[bad])
        better &= within_limits(again.rotations)
        rotations[bad[better]] = again.rotations[better]
        clash[bad[better]] = again.clash[better]
    return PoseBatch(rotations, draws.activity, clash)


def _ease(t: Tensor) -> Tensor:
    return t**3 * (10 - 15 * t + 6 * t * t)


def sequence(
    n_frames: int, generator: torch.Generator, activity: str | None = None, fps: float = 30.0, device: str = "cpu"
) -> Float[Tensor, "n 21 3 3"]:
    """A smooth motion of one activity: through a few key postures, or a gait cycle where the legs walk or run.

    Args:
        n_frames: length.
        generator: source of randomness.
        activity: one of `ACTIVITIES`; None draws one.
        fps: frames per second of the result.
        device: where the tensors shall be.
    """
    if n_frames < 1 or not fps > 0:
        raise UnderstudyError(f"sequence: n_frames {n_frames} and fps {fps} must be above 0")
    what = _activities(1, generator, None if activity is None else {activity: 1.0})
    table = _tables(device)
    seconds = n_frames / fps
    n_keys = max(2, math.ceil(seconds / 0.9) + 1)
    draws = draw(what.expand(n_keys), generator, device)
    # the same legs, side and kind of trunk; the hands change now and then
    choices = draws.choices[:1].repeat(n_keys, 1)
    first = draws.take(torch.zeros(n_keys, dtype=torch.long))
    new_hands = draws.choices[:, 4] < 0.4
    choices[:, 1] = torch.where(new_hands, draws.choices[:, 1], choices[:, 1])
    near = 0.25
    keys = replace(
        draws,
        choices=choices,
        trunk=first.trunk + 0.5 * (draws.trunk - first.trunk),
        pelvis=first.pelvis + near * (draws.pelvis - first.pelvis),
        legs=first.legs + near * (draws.legs - first.legs),
    )
    lower = _pick(table.lower_choice[keys.activity[:1]], choices[:1, 0])
    gait = float(table.pelvis[lower, PELVIS_FIELDS.index("gait"), 0])
    times = torch.arange(n_frames, device=device) / fps
    if gait > 0:
        start = solve(keys.take(torch.zeros(1, dtype=torch.long, device=device)))
        rows = torch.zeros(n_frames, dtype=torch.long, device=device)
        cycle = keys.take(rows)
        rate = (0.8 + 0.3 * float(draws.choices[1, 3])) * (1.45 if gait > 1 else 1.0)
        choices = cycle.choices.clone()
        choices[:, 3] = (choices[:, 3] + rate * times) % 1
        kept = Solved(*(getattr(start, f.name)[rows] for f in fields(Solved)))
        return solve(replace(cycle, choices=choices), kept).rotations
    solved = solve(keys).rotations
    at = times / max(seconds, 1e-6) * (n_keys - 1)
    index = at.long().clamp(max=n_keys - 2)
    return interpolate(solved[index], solved[index + 1], _ease((at - index).clamp(0, 1)))
