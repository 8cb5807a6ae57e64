"""Bodies of tapered tubes, ellipsoids and rounded boxes with the proportions of ANSUR II; need no body model.

Every part is a *loft*: rings of superellipses along a straight axis with rounded ends. Parts overlap at the joints.
Surface that lies inside trunk, neck or head of the average body gets no points; the rounded ends of the limbs inside
their neighbours keep theirs (they are hidden, and come out at the outside of a bent elbow or knee).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.ansur import bones, draw_lengths, draw_sex, draw_stature
from understudy.synthetic.bodies import BodyBank
from understudy.synthetic.segments import JOINT_SEGMENT, SEGMENT, SEGMENTS
from understudy.synthetic.surface import SIDES, alignment, drape, even_samples, regions, vertex_normals

COLUMNS = 28
"""Vertices around a ring."""

CAP = np.linspace(0, np.pi / 2, 6)
"""Angles of the rings of a rounded end."""

ROWS = 18
"""Rings between the ends."""

ARM_DOWN, LEG_OUT = 0.8, 0.09
"""Rest posture: arms below the horizontal, legs off the vertical (radians)."""

SHOULDER_BELOW = 0.042
"""The shoulder's centre lies this much lower than the acromion (metres)."""

_COCO_HIP = 1.24
"""Distance of a hip from the middle, against that of the thigh's axis."""


@dataclass(frozen=True)
class Part:
    """A loft of N bodies. Its own frame: columns (width, depth, axis) in the body frame."""

    segment: str
    start: Float[Tensor, "n 3"]
    frame: Float[Tensor, "n 3 3"]
    length: Float[Tensor, " n"]
    at: tuple[float, ...]
    """knots along the axis, 0..1"""
    width: Float[Tensor, "n k"]
    """half, at the knots, metres"""
    depth: Float[Tensor, "n k"]
    shift: Float[Tensor, "n k"]
    """of the ring's centre in the direction of depth"""
    caps: tuple[float, float] = (1.0, 1.0)
    """length of the rounded ends, as a share of the rings' mean half axis there"""
    power: float = 2.0
    """2: ellipse, larger: towards a box"""

    def rings(self, values: Tensor) -> Tensor:
        """(N, ROWS) values at the rings, from those at the knots."""
        t = np.linspace(0, 1, ROWS)
        matrix = np.stack([np.interp(t, self.at, row) for row in np.eye(len(self.at))], 1)
        soft = np.eye(ROWS)
        inner = np.arange(1, ROWS - 1)
        for shift, share in ((-1, 0.25), (0, 0.5), (1, 0.25)):
            soft[inner, inner + shift] = share
        return values @ torch.from_numpy(soft @ soft @ matrix).to(values).T

    def axis_positions(self) -> Float[Tensor, "n r"]:
        """Positions of all rings along the axis, in shares of the length; outside 0..1 in the rounded ends."""
        w, d = self.width, self.depth
        first, last = (
            (w[:, k] + d[:, k])[:, None] / 2 * c / self.length[:, None] for k, c in zip((0, -1), self.caps, strict=True)
        )
        inner = torch.linspace(0, 1, ROWS).expand(len(w), ROWS)
        cos = torch.from_numpy(np.cos(CAP[:-1])).to(w)
        return torch.cat([-first * cos, inner, 1 + last * cos.flip(0)], 1)

    def vertices(self) -> Float[Tensor, "n v 3"]:
        """Ring by ring."""
        sin = torch.from_numpy(np.sin(CAP[:-1])).to(self.width)

        def all_rings(values: Tensor, taper: bool) -> Tensor:
            mid = self.rings(values)
            k = sin if taper else torch.ones_like(sin)
            return torch.cat([mid[:, :1] * k, mid, mid[:, -1:] * k.flip(0)], 1)

        a, b = all_rings(self.width, True), all_rings(self.depth, True)
        phi = torch.linspace(0, 2 * torch.pi, COLUMNS + 1)[:-1]
        c, s = phi.cos(), phi.sin()
        c, s = (v.sign() * v.abs() ** (2 / self.power) for v in (c, s))
        local = torch.stack(
            [
                a[..., None] * c,
                b[..., None] * s + all_rings(self.shift, False)[..., None],
                (self.axis_positions() * self.length[:, None])[..., None].expand(-1, -1, COLUMNS),
            ],
            3,
        ).flatten(1, 2)
        return self.start[:, None] + local @ self.frame.mT

    def contains(self, points: Float[Tensor, "m 3"], margin: float) -> Tensor:
        """(M,) whether points lie inside the mean body's part, deeper than about `margin` metres."""
        frame = self.frame.mean(0)
        local = (points - self.start.mean(0)) @ frame
        t = (local[:, 2] / self.length.mean()).numpy()
        where = np.linspace(0, 1, ROWS)
        a, b, c = (
            torch.from_numpy(np.interp(t, where, self.rings(v).mean(0).numpy())).to(points)
            for v in (self.width, self.depth, self.shift)
        )
        u = (local[:, 0] / (a - margin).clamp_min(1e-3)).abs() ** self.power
        v = ((local[:, 1] - c) / (b - margin).clamp_min(1e-3)).abs() ** self.power
        return (u + v < 1) & torch.from_numpy((t > 0) & (t < 1))


def loft_faces() -> np.ndarray:
    """(F, 3) triangles of a loft, counter-clockwise seen from outside."""
    rows = ROWS + 2 * (len(CAP) - 1)
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(COLUMNS), indexing="ij")
    a, b = r * COLUMNS + c, r * COLUMNS + (c + 1) % COLUMNS
    quads = np.stack([a, b, b + COLUMNS, a + COLUMNS], -1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def build(n: int, seed: int, points: int) -> BodyBank:
    """n bodies with `points` surface points each. Deterministic for a given seed."""
    generator = torch.Generator().manual_seed(seed)
    female = draw_sex(n, generator)
    stature = draw_stature(female, generator)
    origins, parts, joints, tips = people(female, stature, generator)
    vertices = [p.vertices() for p in parts]
    count = vertices[0].shape[1]
    one = torch.from_numpy(loft_faces())
    faces = torch.cat([one + k * count for k in range(len(parts))])
    mean = [v.mean(0) for v in vertices]
    weights = torch.cat([_weights(p, m, origins.mean(0)) for p, m in zip(parts, mean, strict=True)])

    keep = []
    for part, spots in zip(parts, mean, strict=True):
        centre = spots[one].mean(1)
        others = [q for q in parts if q is not part and q.segment in ("chest", "neck", "head")]
        inside = torch.stack([q.contains(centre, 0.012) for q in others]).any(0)
        if part.segment == "chest":  # the trunk's edge inside the ball of the shoulder
            balls = origins.mean(0)[[SEGMENT["right_upper_arm"], SEGMENT["left_upper_arm"]]]
            inside |= torch.cdist(centre, balls).amin(1) < 0.047
        keep.append(~inside)
    face, bary = even_samples(torch.cat(mean), faces, torch.cat(keep).float(), points, generator)
    corner = faces[face]
    every = torch.cat(vertices, 1)
    normal = vertex_normals(every, faces)
    spots = (every[:, corner] * bary[..., None]).sum(2)
    weights = (weights[corner] * bary[..., None]).sum(1)
    region, along = regions(spots.mean(0), weights, origins.mean(0), joints.mean(0))
    normals = torch.nn.functional.normalize((normal[:, corner] * bary[..., None]).sum(2), dim=2)
    tilt = torch.stack([_arm(s)[:, 1] for _, s in SIDES])  # the palms look down when the arms are level
    return BodyBank(
        points=spots,
        normals=normals,
        weights=weights,
        origins=origins,
        align=alignment(origins, -tilt.expand(n, 2, 3), tips, torch.tensor([0.0, -1.0, 0.0]).expand(n, 2, 3)),
        joints=joints,
        region=region,
        along=along,
        drape=drape(spots, normals, region),
        stature=stature,
        female=female,
    )


def _frame(depth: Float[Tensor, " 3"], axis: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Right-handed columns (width, depth, axis), with depth made square to the axis."""
    axis = torch.nn.functional.normalize(axis, dim=0)
    depth = torch.nn.functional.normalize(depth - axis * (axis @ depth), dim=0)
    return torch.stack([torch.linalg.cross(depth, axis), depth, axis], 1)


def _arm(sign: float) -> Float[Tensor, "3 3"]:
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
        arm = _arm(sign)
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


def _smooth(t: Tensor) -> Tensor:
    """0 below 0, 1 above 1, smooth between."""
    t = t.clamp(0, 1)
    return t * t * (3 - 2 * t)


_NEIGHBOURS = {
    # part: (segment before, half width of the blend, segment after, half width of the blend), in shares of the length
    "upper_arm": ("clavicle", 0.22, "forearm", 0.14),
    "forearm": ("upper_arm", 0.16, "hand", 0.12),
    "hand": ("forearm", 0.25, "fingers", 0.15),
    "fingers": ("hand", 0.15, None, 0.1),
    "thigh": ("pelvis", 0.18, "shin", 0.11),
    "shin": ("thigh", 0.11, "foot", 0.07),
}


def _weights(part: Part, vertices: Float[Tensor, "v 3"], origins: Float[Tensor, "s 3"]) -> Float[Tensor, "v s"]:
    """Skinning weights of a part's vertices, from the mean body; at a joint both segments have one half."""
    out = torch.zeros(len(vertices), len(SEGMENTS))
    x, z = vertices[:, 0], vertices[:, 2]

    def place(name: str) -> Tensor:
        return origins[SEGMENT[name]]

    if part.segment == "chest":
        to_abdomen = _smooth((z - place("abdomen")[2]) / 0.14 + 0.5)
        to_chest = _smooth((z - place("chest")[2]) / 0.14 + 0.5)
        to_neck = 0.5 * _smooth((z - place("neck")[2] + 0.03) / 0.05)
        shoulder = place("left_upper_arm")
        girdle = _smooth((x.abs() - 0.04) / (shoulder[0] - 0.05)) * _smooth((z - shoulder[2]) / 0.10 + 0.9)
        hip = place("left_thigh")
        leg = 0.5 * _smooth((x.abs() - 0.02) / (hip[0] - 0.02)) * _smooth(0.6 - z / 0.12)
        out[:, SEGMENT["pelvis"]] = (1 - to_abdomen) * (1 - leg)
        out[:, SEGMENT["abdomen"]] = to_abdomen * (1 - to_chest)
        out[:, SEGMENT["chest"]] = to_chest * (1 - girdle) * (1 - to_neck)
        out[:, SEGMENT["neck"]] = to_chest * (1 - girdle) * to_neck
        for side, sign in SIDES:
            own = x * sign > 0
            out[own, SEGMENT[f"{side}_clavicle"]] = (to_chest * girdle)[own]
            out[own, SEGMENT[f"{side}_thigh"]] = ((1 - to_abdomen) * leg)[own]
    elif part.segment == "neck":
        to_neck = _smooth((z - place("neck")[2]) / 0.06 + 0.5)
        to_head = _smooth((z - place("head")[2]) / 0.07 + 0.8)
        out[:, SEGMENT["chest"]] = 1 - to_neck
        out[:, SEGMENT["neck"]] = to_neck * (1 - to_head)
        out[:, SEGMENT["head"]] = to_neck * to_head
    elif part.segment == "head" or part.segment.endswith("_foot"):
        out[:, SEGMENT[part.segment]] = 1.0
    else:
        side, _, kind = part.segment.partition("_")
        before, h0, after, h1 = _NEIGHBOURS[kind]
        start, axis = place(part.segment), part.frame[0, :, 2]
        if kind == "hand":  # palm and thumb: along the palm
            axis = torch.nn.functional.normalize(place(f"{side}_fingers") - start, dim=0)
        length = (place(f"{side}_{after}") - start).norm() if after else part.length.mean()
        t = (vertices - start) @ axis / length
        from_before = _smooth((t + h0) / (2 * h0))
        to_after = _smooth((t - 1 + h1) / (2 * h1)) if after else torch.zeros_like(t)
        thumb = kind == "hand" and (part.frame[0, :, 2] - axis).norm() > 0.1
        if thumb:
            from_before, to_after = torch.ones_like(t), torch.zeros_like(t)
        out[:, SEGMENT[before if before == "pelvis" else f"{side}_{before}"]] = 1 - from_before
        out[:, SEGMENT[part.segment]] = from_before * (1 - to_after)
        if after:
            out[:, SEGMENT[f"{side}_{after}"]] = from_before * to_after
    return out
