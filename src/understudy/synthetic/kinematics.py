"""Geometry of the simulated skeleton: rotations, a mean stick figure, inverse kinematics, limits, interpolation.

All in the body frame of `segments.py` (x to the person's left, y to the back, z up). Batches have any leading shape.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.synthetic.segments import PARENTS, SEGMENT, SEGMENTS

UPPER_ARM: Final = 0.30
FOREARM: Final = 0.25
THIGH: Final = 0.42
SHIN: Final = 0.41
ANKLE_HEIGHT: Final = 0.08
HIP_HALF: Final = 0.09
SHOULDER: Final = (0.16, 0.0, 0.0)  # from the left clavicle's origin, along the clavicle
HAND: Final = 0.17  # wrist to finger tips

_SIDED = {
    "clavicle": ("chest", (0.02, 0.0, 0.22)), "upper_arm": ("clavicle", SHOULDER),
    "forearm": ("upper_arm", (UPPER_ARM, 0, 0)),
    "hand": ("forearm", (FOREARM, 0, 0)), "fingers": ("hand", (0.09, 0, 0)), "thigh": ("pelvis", (HIP_HALF, 0, 0)),
    "shin": ("thigh", (0, 0, -THIGH)), "foot": ("shin", (0, 0, -SHIN)),
}  # fmt: skip
_OFFSET = {
    "pelvis": (0.0, 0.0, 0.0), "abdomen": (0.0, 0.0, 0.10), "chest": (0.0, 0.0, 0.16),
    "neck": (0.0, 0.0, 0.26), "head": (0.0, 0.0, 0.09),
}  # fmt: skip
for _part, (_, (_x, _y, _z)) in _SIDED.items():
    _OFFSET[f"left_{_part}"], _OFFSET[f"right_{_part}"] = (_x, _y, _z), (-_x, _y, _z)

OFFSETS: Final = torch.tensor([_OFFSET[name] for name in SEGMENTS])
"""(21, 3): origin of each segment in its parent's frame, metres, mean adult; the pelvis' is zero."""

MIRROR_SEGMENTS: Final = [
    SEGMENT[name.replace("left", "LR").replace("right", "left").replace("LR", "right")] for name in SEGMENTS
]
"""`rotations[:, MIRROR_SEGMENTS]` exchanges left and right segments (see `mirror`)."""


def rot(axis: int, angle: Tensor) -> Tensor:
    """[...] radians -> [..., 3, 3]: rotation about x (0), y (1) or z (2)."""
    c, s, one, zero = angle.cos(), angle.sin(), torch.ones_like(angle), torch.zeros_like(angle)
    rows = ((one, zero, zero, zero, c, -s, zero, s, c), (c, zero, s, zero, one, zero, -s, zero, c),
            (c, -s, zero, s, c, zero, zero, zero, one))[axis]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def unit(v: Tensor) -> Tensor:
    """[..., 3] scaled to length one."""
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over the last axis."""
    return torch.linalg.cross(a, b)


def along(rotation: Tensor, vector: tuple[float, float, float]) -> Tensor:
    """[..., 3, 3] and a constant vector -> the turned vector [..., 3]."""
    parts = [rotation[..., i] * v for i, v in enumerate(vector) if v != 0.0]
    return sum(parts[1:], parts[0])


def turn(rotation: Tensor, v: Tensor) -> Tensor:
    """[..., 3, 3] times [..., 3]."""
    return (rotation @ v[..., None])[..., 0]


def axes(x: Tensor, z: Tensor) -> Tensor:
    """Rotation whose x column is `x`, whose z column is the part of `z` square to it. Both [..., 3], not parallel."""
    x = unit(x)
    z = unit(z - x * (x * z).sum(-1, keepdim=True))
    return torch.stack((x, cross(z, x), z), -1)


def mirror(rotations: Float[Tensor, "*b 21 3 3"]) -> Float[Tensor, "*b 21 3 3"]:
    """The same posture with left and right exchanged."""
    sign = torch.tensor([-1.0, 1.0, 1.0], device=rotations.device)
    return rotations[..., MIRROR_SEGMENTS, :, :] * (sign[:, None] * sign)


def forward(rotations: Float[Tensor, "*b 21 3 3"]) -> Float[Tensor, "*b 21 3"]:
    """Origin of every segment of the mean stick figure, metres, relative to the midpoint of the hips."""
    offsets = OFFSETS.to(rotations.device)
    steps = (rotations[..., list(PARENTS), :, :] @ offsets[:, :, None])[..., 0]  # the pelvis' own step is zero
    out: list[Tensor] = []
    for i, parent in enumerate(PARENTS):
        out.append(steps[..., i, :] if parent < 0 else out[parent] + steps[..., i, :])
    return torch.stack(out, -2)


def lowest(rotations: Float[Tensor, "*b 21 3 3"], origins: Float[Tensor, "*b 21 3"]) -> Float[Tensor, "*b"]:
    """Height of the sole's (or knee's, or seat's) lowest point relative to the hips: about where the floor is."""
    points = [origins[..., 0, 2] - 0.11]
    for side in ("right", "left"):
        foot, shin = SEGMENT[f"{side}_foot"], SEGMENT[f"{side}_shin"]
        points.append(origins[..., shin, 2] - 0.055)
        for corner in ((0.0, -0.17, -ANKLE_HEIGHT), (0.0, 0.05, -ANKLE_HEIGHT)):
            points.append(origins[..., foot, 2] + along(rotations[..., foot, :, :], corner)[..., 2])
    return torch.stack(points, -1).amin(-1)


# -- two-bone inverse kinematics ---------------------------------------------------------------------------------


def two_bone(
    start: Tensor, goal: Tensor, pole: Tensor, upper: float, lower: float, shortest: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Directions of both bones of a chain from `start` to `goal`, bent towards `pole`, and the hinge's axis.

    All arguments and results are [..., 3]; a goal out of reach is approached along the straight line. The hinge is
    the unit vector `pole x line`: the lower bone is the upper one turned about it by the bend.
    """
    line = goal - start
    span = line.norm(dim=-1, keepdim=True)
    line = line / span.clamp_min(1e-6)
    span = span.clamp(max(shortest, abs(upper - lower) + 1e-4), 0.9995 * (upper + lower))
    pole = unit(pole - line * (pole * line).sum(-1, keepdim=True))
    a = (upper**2 - lower**2 + span**2) / (2 * span)
    h = (upper**2 - a**2).clamp_min(0).sqrt()
    first = (line * a + pole * h) / upper
    second = (line * (span - a) - pole * h) / lower
    return first, second, cross(pole, line)


def arm_frames(first: Tensor, second: Tensor, hinge: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations of the RIGHT upper arm and forearm (before pronation) from `two_bone`'s result."""
    return axes(-first, hinge), axes(-second, hinge)


def leg_frames(first: Tensor, second: Tensor, hinge: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations of a thigh and its shin from `two_bone`'s result."""
    return axes(hinge, -first), axes(hinge, -second)


def twist_x(rotation: Tensor) -> Tensor:
    """[..., 3, 3] -> radians: the turn about x left when the shortest swing of the x axis is taken out."""
    trace = rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2]
    return 2 * torch.atan2(rotation[..., 2, 1] - rotation[..., 1, 2], (1 + trace).clamp_min(1e-6))


# -- limits --------------------------------------------------------------------------------------------------------


def shoulder_excess(direction: Tensor, twist: Tensor) -> Tensor:
    """How far a RIGHT upper arm is out of its range; 0 inside.

    Args:
        direction: [..., 3] of the upper arm, in the chest's frame.
        twist: [...] radians, from the T posture, positive inwards.
    """
    outward, front, up = -direction[..., 0], -direction[..., 1], direction[..., 2]
    across = (-outward - 0.12 - 0.75 * front.clamp(0, 0.8)).clamp_min(0)  # in front of the chest, or a little behind
    behind = (-front - (0.78 - 0.45 * (up + 0.5).clamp(0, 1))).clamp_min(0)
    over = ((-outward - 0.35) * (up > 0.5)).clamp_min(0)
    return across + behind + over + (twist - 1.9).clamp_min(0) + (-1.95 - 0.35 * up.clamp(0, 1) - twist).clamp_min(0)


def _bend_about_x(rotation: Tensor) -> Tensor:
    """Angle of a hinge-like rotation about x, from how it turns z, in (-pi, pi]."""
    return torch.atan2(-rotation[..., 1, 2], rotation[..., 2, 2])


def _turn_about_z(rotation: Tensor) -> Tensor:
    return torch.atan2(rotation[..., 1, 0] - rotation[..., 0, 1], rotation[..., 0, 0] + rotation[..., 1, 1])


def _relative(rotations: Tensor, child: str, parent: str) -> Tensor:
    return rotations[..., SEGMENT[parent], :, :].mT @ rotations[..., SEGMENT[child], :, :]


def angle_of(rotation: Tensor) -> Tensor:
    """[..., 3, 3] -> how far it turns, radians."""
    trace = rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2]
    return ((trace - 1) / 2).clamp(-1, 1).acos()


def limit_excess(rotations: Float[Tensor, "*b 21 3 3"]) -> dict[str, Tensor]:
    """How far each joint is out of its range (about radians, [...]; 0 inside)."""
    deg = math.pi / 180

    def beyond(value: Tensor, low: float, high: float) -> Tensor:
        return (value - high * deg).clamp_min(0) + (low * deg - value).clamp_min(0)

    trunk, head = _relative(rotations, "chest", "pelvis"), _relative(rotations, "head", "chest")
    out = {
        "trunk_bend": beyond(_bend_about_x(trunk), -40, 95),
        "trunk_lean": beyond(torch.asin(trunk[..., 0, 2].clamp(-1, 1)), -50, 50),
        "trunk_twist": beyond(_turn_about_z(trunk), -60, 60),
        "head": beyond(angle_of(head), 0, 95),
        "head_nod": beyond(_bend_about_x(head), -75, 75),
        "head_turn": beyond(_turn_about_z(head), -85, 85),
    }
    pose = torch.stack((rotations, mirror(rotations)))  # everything below is written for the right side
    sided: dict[str, Tensor] = {}
    upper = _relative(pose, "right_upper_arm", "chest")
    sided["shoulder"] = shoulder_excess(-upper[..., 0], twist_x(upper))
    fore = _relative(pose, "right_forearm", "right_upper_arm")
    # forearm along -x: in front (-y) when bent; it must stay in the hinge's plane, whatever its pronation
    bend = torch.atan2(fore[..., 1, 0], fore[..., 0, 0])
    sided["elbow"] = beyond(bend, -12, 155) + beyond(torch.asin(fore[..., 2, 0].clamp(-1, 1)), -20, 20)
    thigh = _relative(pose, "right_thigh", "pelvis")
    down = -thigh[..., 2]
    flex = torch.atan2(-down[..., 1], -down[..., 2])
    flex = torch.where(flex < -2.5, flex + 2 * math.pi, flex)
    aside = torch.asin(-down[..., 0].clamp(-1, 1))
    sided["hip"] = beyond(flex, -50, 160) * (down[..., 0].abs() < 0.95) + beyond(aside, -45, 85)
    knee = _relative(pose, "right_shin", "right_thigh")
    sided["knee"] = beyond(_bend_about_x(knee), -8, 160) + beyond(torch.asin(knee[..., 0, 2].clamp(-1, 1)), -20, 20)
    sided["ankle"] = beyond(angle_of(_relative(pose, "right_foot", "right_shin")), 0, 75)
    sided["wrist"] = beyond(angle_of(_relative(pose, "right_hand", "right_forearm")), 0, 105)
    sided["clavicle"] = beyond(angle_of(_relative(pose, "right_clavicle", "chest")), 0, 50)
    for joint, value in sided.items():
        out[f"right_{joint}"], out[f"left_{joint}"] = value.unbind(0)
    return out


def within_limits(rotations: Float[Tensor, "*b 21 3 3"]) -> Bool[Tensor, "*b"]:
    """Which postures a human can take: elbows and knees, trunk, shoulders, hips, head, wrists and ankles."""
    return torch.stack(list(limit_excess(rotations).values()), -1).amax(-1) < 0.02


# -- interpolation -------------------------------------------------------------------------------------------------


def to_quaternion(rotation: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 4] unit quaternions w, x, y, z with w >= 0."""
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack((1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz), -1)
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    ww, x2, y2, z2 = squares.unbind(-1)
    rows = torch.stack((ww, wx, wy, wz, wx, x2, xy, xz, wy, xy, y2, yz, wz, xz, yz, z2), -1).unflatten(
        -1, (4, 4)
    )  # each row is 4 q_i q; take the best conditioned one
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = rows.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def from_quaternion(q: Tensor) -> Tensor:
    """[..., 4] unit quaternions w, x, y, z -> [..., 3, 3]."""
    w, x, y, z = q.unbind(-1)
    rows = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def slerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """The rotation a share `t` of the shortest way from `a` to `b`; [..., 3, 3] each, t broadcasts over [...]."""
    q = to_quaternion(a.mT @ b)
    half = torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0])
    axis = unit(q[..., 1:])
    part = torch.cat(((half * t).cos()[..., None], axis * (half * t).sin()[..., None]), -1)
    return a @ from_quaternion(part)


_RELATIVE = [SEGMENT[n] for n in SEGMENTS if n != "pelvis" and not n.endswith(("thigh", "shin", "foot"))]
_ABSOLUTE = [i for i in range(len(SEGMENTS)) if i not in _RELATIVE]


def interpolate(
    a: Float[Tensor, "*b 21 3 3"], b: Float[Tensor, "*b 21 3 3"], t: float | Tensor
) -> Float[Tensor, "*b 21 3 3"]:
    """Between two postures by spherical interpolation; `t` in [0, 1] is a number or has the batch's shape.

    Trunk, head and arms turn relative to their parents (elbows stay hinges), pelvis and legs absolutely (feet that
    are flat in both stay flat).
    """
    share = torch.as_tensor(t, dtype=a.dtype, device=a.device)[..., None]
    parents = list(PARENTS)
    a_rel, b_rel = a.clone(), b.clone()
    a_rel[..., _RELATIVE, :, :] = a[..., [parents[i] for i in _RELATIVE], :, :].mT @ a[..., _RELATIVE, :, :]
    b_rel[..., _RELATIVE, :, :] = b[..., [parents[i] for i in _RELATIVE], :, :].mT @ b[..., _RELATIVE, :, :]
    mid = slerp(a_rel, b_rel, share)
    for i in _RELATIVE:  # parents come first
        mid[..., i, :, :] = mid[..., parents[i], :, :] @ mid[..., i, :, :].clone()
    return mid
