"""The proportions of bodies made of lofts: which parts people have, how large, and where their joints are."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.ansur import bones, draw_lengths
from understudy.synthetic.capsule_loft import Part
from understudy.synthetic.segments import JOINT_SEGMENT, SEGMENTS
from understudy.synthetic.surface import SIDES

ARM_DOWN, LEG_OUT = 0.8, 0.09
"""Rest posture: arms below the horizontal, legs off the vertical (radians)."""

SHOULDER_BELOW = 0.042
"""The shoulder's centre lies this much lower than the acromion (metres)."""

_COCO_HIP = 1.24
"""Distance of a hip from the middle, against that of the thigh's axis."""


def _frame(depth: Float[Tensor, " 3"], axis: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Right-handed columns (width, depth, axis), with depth made square to the axis."""
    axis = torch.nn.functional.normalize(axis, dim=0)
    depth = torch.nn.functional.normalize(depth - axis * (axis @ depth), dim=0)
    return torch.stack([torch.linalg.cross(depth, axis), depth, axis], 1)


def arm_axes(sign: float) -> Float[Tensor, "3 3"]:
    """Rest axes of an arm as columns: outward along it, upward across it, to the back."""
    c, s = math.cos(ARM_DOWN), math.sin(ARM_DOWN)
    return torch.tensor([[sign * c, sign * s, 0.0], [0.0, 0.0, 1.0], [-s, c, 0.0]])


def people(
    female: Tensor, stature: Tensor, generator: torch.Generator
) -> tuple[Float[Tensor, "n s 3"], list[Part], Float[Tensor, "n 18 3"], Float[Tensor, "n 2 3"]]:
    """Rotation centres, parts, joints and finger tips of random people, pelvis at zero."""
    n = len(stature)
    long = draw_lengths(female, stature, generator)
    bone = bones(long)

    def vary(sd: float) -> Tensor:
        return 1 + sd * torch.randn(n, generator=generator).clamp(-2.5, 2.5)

    def sexed(man: float, woman: float) -> Tensor:
        return torch.where(female, woman, man)

    size = (stature / sexed(1.756, 1.629)) ** 0.6
    build_ = 0.16 * torch.randn(n, generator=generator).clamp(-1.8, 2.6)  # log of the girth of the trunk
    trunk, deep, limb = (build_ * 0.75).exp() * size, (build_ * 1.25).exp() * size, (build_ * 0.55).exp() * size

    hip_z = long["trochanter_height"]
    ankle_z = long["ankle_height"]
    thigh, shin = bone["thigh"], bone["shin"]
    acromion = (long["acromial_height"] - hip_z).clamp(0.42, 0.72)
    top = stature - hip_z
    shoulder_x = bone["shoulders"] / 2
    hip_x = sexed(0.092, 0.090) * size * vary(0.05)
    upper, fore, palm, finger = bone["upper_arm"], bone["forearm"], bone["palm"], 0.46 * long["hand"]

    def at(x: Tensor | float, y: Tensor | float, z: Tensor | float) -> Tensor:
        return torch.stack([torch.as_tensor(v, dtype=torch.float32).expand(n) for v in (x, y, z)], 1)

    def knots(*rows: Tensor) -> Tensor:
        return torch.stack([r.expand(n) for r in rows], 1)

    origin = {
        "pelvis": at(0, 0, 0),
        "abdomen": at(0, 0.025, 0.17 * acromion),
        "chest": at(0, 0.02, 0.42 * acromion),
        "neck": at(0, 0.02, acromion + 0.015),
        "head": at(0, 0.005, top - 0.16 * size),
    }
    parts: list[Part] = []
    upright = torch.eye(3).expand(n, 3, 3)

    # trunk: from the crotch to the root of the neck
    low, high = -0.085 * size, acromion + 0.055
    hip, waist, chest = (
        sexed(0.172, 0.174) * trunk * vary(0.03),
        sexed(0.150, 0.132) * (build_ * 1.1).exp() * size * vary(0.04),
        sexed(0.160, 0.140) * trunk * vary(0.03),
    )
    breast = sexed(0.0, 0.02) * (build_ * 1.5).exp() * vary(0.3)
    belly = 0.06 * build_.clamp_min(-0.15) + 0.01 * (vary(1.0) - 1)
    shoulder = shoulder_x + 0.005
    parts.append(
        Part(
            "chest",
            at(0, 0, low),
            upright,
            high - low,
            (0.0, 0.12, 0.27, 0.43, 0.65, 0.78, 0.86, 0.92, 0.96, 1.0),
            knots(
                hip * 0.72,
                hip,
                hip * 0.93,
                waist,
                chest,
                torch.maximum(chest, shoulder),
                shoulder * 1.06,
                shoulder * 0.86,
                shoulder * 0.52,
                0.062 * size,
            ),
            knots(
                *(d * deep for d in (0.088, 0.118, 0.120, 0.108)),
                0.116 * deep + breast / 2,
                0.104 * deep + breast / 4,
                0.090 * (deep * size) ** 0.5,
                0.074 * size,
                0.064 * size,
                0.057 * size,
            ),
            knots(
                0.012 * size,
                0.012 * size,
                -belly / 2,
                -belly,
                -breast / 2,
                *(v * size for v in (0.008, 0.010, 0.014, 0.017, 0.018)),
            ),
            caps=(0.45, 0.35),
            power=2.4,
        )
    )
    chin = top - 0.222 * size
    neck_r = sexed(0.060, 0.052) * (build_ * 0.5).exp() * size
    parts.append(
        Part(
            "neck",
            at(0, 0.02, acromion - 0.03),
            upright,
            chin + 0.06 - (acromion - 0.03),
            (0.0, 0.45, 1.0),
            knots(neck_r * 1.25, neck_r, neck_r),
            knots(neck_r * 1.15, neck_r, neck_r),
            knots(neck_r * 0, neck_r * 0, neck_r * 0 - 0.01),
            caps=(0.1, 0.1),
        )
    )
    head = sexed(1.0, 0.965) * vary(0.025)
    parts.append(
        Part(
            "head",
            at(0, 0, chin + 0.012),
            upright,
            0.222 * size - 0.012 - 0.075 * head,
            (0.0, 0.25, 0.6, 1.0),
            knots(*(w * head for w in (0.040, 0.060, 0.074, 0.076))),
            knots(*(w * head for w in (0.046, 0.078, 0.096, 0.098))),
            knots(*(w * head for w in (-0.052, -0.026, -0.006, 0.002))),
            caps=(0.28, 0.86),
        )
    )

    tips = []
    for side, sign in SIDES:
        arm = arm_axes(sign)
        out, up, back = arm.unbind(1)
        s = at(sign * shoulder_x, 0.012, acromion - SHOULDER_BELOW)
        e, w = s + upper[:, None] * out, s + (upper + fore)[:, None] * out
        k = w + palm[:, None] * out
        tips.append(k + finger[:, None] * out)
        origin |= {
            f"{side}_clavicle": at(sign * 0.025, -0.03, acromion - 0.015),
            f"{side}_upper_arm": s,
            f"{side}_forearm": e,
            f"{side}_hand": w,
            f"{side}_fingers": k,
        }
        frame = _frame(up, out).expand(n, 3, 3)
        r = limb * sexed(1.0, 0.9) * vary(0.04)
        zero = knots(*[torch.zeros(n)] * 3)
        arm_r = knots(0.056 * r, 0.052 * r, 0.041 * r)
        parts.append(Part(f"{side}_upper_arm", s, frame, upper, (0.0, 0.45, 1.0), arm_r, arm_r * 1.04, zero))
        wide, thin = (knots(*(v * r for v in row)) for row in ((0.042, 0.047, 0.029), (0.042, 0.043, 0.022)))
        parts.append(Part(f"{side}_forearm", e, frame, fore, (0.0, 0.25, 1.0), wide, thin, zero, (1.0, 0.4)))
        h = long["hand"] / 0.193 * vary(0.03)
        wide, thin = (knots(*(v * h for v in row)) for row in ((0.029, 0.040, 0.044), (0.020, 0.017, 0.014)))
        parts.append(Part(f"{side}_hand", w, frame, palm, (0.0, 0.4, 1.0), wide, thin, zero, (0.3, 0.3), 2.8))
        wide, thin = (knots(*(v * h for v in row)) for row in ((0.043, 0.040, 0.026), (0.012, 0.010, 0.007)))
        parts.append(
            Part(f"{side}_fingers", k, frame, finger * 0.95, (0.0, 0.5, 1.0), wide, thin, zero, (0.3, 0.5), 3.0)
        )
        thumb = _frame(up, out * 0.75 - back * 0.6 - up * 0.25)
        root = w + (0.02 * h)[:, None] * out - (0.022 * h)[:, None] * back
        ball = knots(0.016 * h, 0.013 * h, 0.010 * h)
        parts.append(
            Part(f"{side}_hand", root, thumb.expand(n, 3, 3), 0.085 * h, (0.0, 0.5, 1.0), ball, ball, zero, (0.5, 1.0))
        )

        c, d = math.cos(LEG_OUT), math.sin(LEG_OUT)
        down = torch.tensor([sign * d, 0.0, -c])
        hip_o = at(sign * hip_x, 0, 0)
        knee, ankle = hip_o + thigh[:, None] * down, hip_o + (thigh + shin)[:, None] * down
        # The joint is where annotators of COCO put hips, outside of the thigh's axis: the same place as in anny.
        origin |= {f"{side}_thigh": hip_o * _COCO_HIP, f"{side}_shin": knee, f"{side}_foot": ankle}
        leg = _frame(torch.tensor([0.0, 1.0, 0.0]), down)
        r = limb * sexed(1.0, 1.02) * vary(0.04)
        wide = knots(*(v * r for v in (0.088, 0.086, 0.064, 0.056)))
        back_of = knots(*(v * r for v in (0.010, 0.004, 0.0, 0.0)))
        parts.append(
            Part(f"{side}_thigh", hip_o, leg.expand(n, 3, 3), thigh, (0.0, 0.3, 0.8, 1.0), wide, wide * 1.02, back_of)
        )
        r = limb * sexed(1.0, 0.97) * vary(0.04)
        wide = knots(*(v * r for v in (0.054, 0.058, 0.050, 0.035, 0.034)))
        calf = knots(*(v * r for v in (0.0, 0.016, 0.014, 0.004, 0.004)))
        parts.append(
            Part(
                f"{side}_shin",
                knee,
                leg.expand(n, 3, 3),
                shin,
                (0.0, 0.28, 0.5, 0.85, 1.0),
                wide,
                wide * 1.03,
                calf,
                (1.0, 0.7),
            )
        )
        f = sexed(0.271, 0.246) * size * vary(0.02)
        tall = knots(0.040 * size, 0.045 * size, 0.024 * size, 0.014 * size)
        parts.append(
            Part(
                f"{side}_foot",
                ankle + at(0, 0.17 * f, -ankle_z),
                _frame(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, -1.0, 0.0])).expand(n, 3, 3),
                0.88 * f,
                (0.0, 0.25, 0.72, 1.0),
                knots(0.028 * size, 0.034 * size, 0.048 * size, 0.036 * size),
                tall,
                tall,  # flat below
                (0.5, 0.9),
                2.6,
            )
        )

    origins = torch.stack([origin[name] for name in SEGMENTS], 1)
    joints = origins[:, list(JOINT_SEGMENT)].clone()
    joints[:, JOINT["nose"]] = at(0, -0.112 * head, top - 0.148 * size)
    for side, sign in SIDES:
        joints[:, JOINT[f"{side}_eye"]] = at(sign * 0.032 * head, -0.088 * head, top - 0.115 * size)
        joints[:, JOINT[f"{side}_ear"]] = at(sign * 0.070 * head, 0.008 * head, top - 0.132 * size)
    joints[:, JOINT["neck"]] = joints[:, [JOINT["right_shoulder"], JOINT["left_shoulder"]]].mean(1)
    return origins, parts, joints, torch.stack(tips, 1)
