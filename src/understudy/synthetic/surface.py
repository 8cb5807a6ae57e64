"""What both kinds of bodies share: surface samples of a mesh, directions of limbs, where the scalp begins."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.bodies import REGION
from understudy.synthetic.segments import SEGMENT, SEGMENTS

SIDES = (("right", -1.0), ("left", 1.0))
"""Name and sign of x."""


def vertex_normals(vertices: Float[Tensor, "n v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "n v 3"]:
    """Unit normals, weighted by area; faces are counter-clockwise seen from outside."""
    a, b, c = (vertices[:, faces[:, k]] for k in range(3))
    face = torch.linalg.cross(b - a, c - a)
    out = torch.zeros_like(vertices)
    for k in range(3):
        out.index_add_(1, faces[:, k], face)
    return torch.nn.functional.normalize(out, dim=2)


def even_samples(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    weight: Float[Tensor, " f"],
    n: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, " p"], Float[Tensor, "p 3"]]:
    """n evenly spaced surface samples: face and barycentric coordinates.

    weight: per face, 0 leaves it out. Many random candidates are drawn by area, and of these each next one is taken
    that is farthest from all taken ones.
    """
    a, b, c = (vertices[faces[:, k]].float() for k in range(3))
    area = torch.linalg.cross(b - a, c - a).norm(dim=1) * weight
    picked = torch.multinomial(area.float(), 5 * n, replacement=True, generator=generator)
    r = torch.rand(5 * n, 2, generator=generator)
    root = r[:, :1].sqrt()
    bary = torch.cat([1 - root, root * (1 - r[:, 1:]), root * r[:, 1:]], 1)
    spots = (torch.stack([a, b, c], 1)[picked] * bary[..., None]).sum(1).numpy()
    keep = torch.from_numpy(farthest(spots, n))
    return picked[keep], bary[keep]


def farthest(spots: np.ndarray, n: int) -> np.ndarray:
    """Indices of n points, each the farthest from the ones before."""
    x, y, z = (np.ascontiguousarray(spots[:, k]) for k in range(3))
    chosen = np.zeros(n, dtype=np.int64)
    nearest = np.full(len(spots), np.inf, dtype=np.float32)
    d = np.empty_like(nearest)
    for i in range(1, n):
        k = chosen[i - 1]
        np.square(x - x[k], out=d)
        d += np.square(y - y[k])
        d += np.square(z - z[k])
        np.minimum(nearest, d, out=nearest)
        chosen[i] = nearest.argmax()
    return chosen


def minimal_rotation(start: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """The smallest rotations that take one unit vector to the other (not opposite) one."""
    v = torch.linalg.cross(start, end)
    zero = torch.zeros_like(v[:, 0])
    x, y, z = v.unbind(1)
    k = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    c = (start * end).sum(1)[:, None, None]
    return torch.eye(3).to(k) + k + k @ k / (1 + c)


def frames(along: Float[Tensor, "n 3"], side: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Axes as columns: `along`, the part of `side` square to it, and their cross product."""
    a = torch.nn.functional.normalize(along, dim=1)
    s = torch.nn.functional.normalize(side - a * (a * side).sum(1, keepdim=True), dim=1)
    return torch.stack([a, s, torch.linalg.cross(a, s)], 2)


def alignment(
    origins: Float[Tensor, "n s 3"],
    palms: Float[Tensor, "n 2 3"],
    tips: Float[Tensor, "n 2 3"],
    toes: Float[Tensor, "n 2 3"],
) -> Float[Tensor, "n s 3 3"]:
    """Rotations from rest to the canonical posture.

    palms: out of the right and left palm. tips: mean position of the finger tips. toes: direction heel to toes.
    """
    n = len(origins)
    out = torch.eye(3).to(origins).expand(n, len(SEGMENTS), 3, 3).clone()
    for i, (side, sign) in enumerate(SIDES):

        def at(part: str, side: str = side) -> Tensor:
            return origins[:, SEGMENT[f"{side}_{part}"]]

        outward = torch.tensor([sign, 0.0, 0.0]).to(origins).expand(n, 3)
        down = torch.tensor([0.0, 0.0, -1.0]).to(origins).expand(n, 3)
        front = torch.tensor([0.0, -1.0, 0.0]).to(origins).expand(n, 3)
        for part, child, goal in (
            ("upper_arm", "forearm", outward),
            ("forearm", "hand", outward),
            ("thigh", "shin", down),
            ("shin", "foot", down),
        ):
            rest = torch.nn.functional.normalize(at(child) - at(part), dim=1)
            out[:, SEGMENT[f"{side}_{part}"]] = minimal_rotation(rest, goal)
        goal_frame = frames(outward, down)
        for part, rest in (("hand", at("fingers") - at("hand")), ("fingers", tips[:, i] - at("fingers"))):
            out[:, SEGMENT[f"{side}_{part}"]] = goal_frame @ frames(rest, palms[:, i]).mT
        level = toes[:, i] * toes.new_tensor([1.0, 1.0, 0.0])
        out[:, SEGMENT[f"{side}_foot"]] = minimal_rotation(torch.nn.functional.normalize(level, dim=1), front)
    return out


def scalp(points: Float[Tensor, "p 3"], eye: Float[Tensor, " 3"], ear: Float[Tensor, " 3"]) -> Bool[Tensor, " p"]:
    """Which points of a head bear hair. eye, ear: midpoints of both eyes and ears."""
    azimuth = torch.rad2deg(torch.atan2(points[:, 0], -(points[:, 1] - ear[1])).abs())
    at = [0, 28, 50, 66, 76, 90, 108, 122, 150, 180]
    line = [0.060, 0.060, 0.050, 0.030, 0.012, 0.030, 0.022, -0.030, -0.055, -0.060]
    limit = torch.from_numpy(np.interp(azimuth.numpy(), at, line)).to(points)
    return points[:, 2] > eye[2] + limit


def regions(
    points: Float[Tensor, "p 3"],
    weights: Float[Tensor, "p s"],
    origins: Float[Tensor, "s 3"],
    joints: Float[Tensor, "18 3"],
) -> tuple[Int[Tensor, " p"], Float[Tensor, " p"]]:
    """Region codes and coordinates along the regions, of one body at rest (see `BodyBank`)."""
    main = weights.argmax(1)
    region = torch.zeros(len(points), dtype=torch.int64)
    along = torch.zeros(len(points))

    def fill(name: str, mask: Tensor, t: Tensor) -> None:
        region[mask] = REGION[name]
        along[mask] = t[mask].clamp(0, 1)

    def of(*segments: str) -> Tensor:
        return torch.isin(main, torch.tensor([SEGMENT[s] for s in segments]))

    def between(start: Tensor, end: Tensor) -> Tensor:
        axis = end - start
        return (points - start) @ axis / (axis @ axis)

    def spread(t: Tensor, mask: Tensor) -> Tensor:
        return (t - t[mask].min()) / (t[mask].max() - t[mask].min())

    z = points[:, 2]
    chest, neck = origins[SEGMENT["chest"]], origins[SEGMENT["neck"]]
    lower = of("pelvis", "abdomen")
    fill("trunk_lower", lower, (z - z[lower].min()) / (chest[2] - z[lower].min()))
    fill("trunk_upper", of("chest", "right_clavicle", "left_clavicle"), (z - chest[2]) / (neck[2] - chest[2]))
    fill("neck", of("neck"), between(neck, origins[SEGMENT["head"]]))
    head = of("head")
    fill("head_skin", head, spread(z, head))
    eye = joints[[JOINT["right_eye"], JOINT["left_eye"]]].mean(0)
    ear = joints[[JOINT["right_ear"], JOINT["left_ear"]]].mean(0)
    region[head & scalp(points, eye, ear)] = REGION["scalp"]
    for side, _ in SIDES:
        at = {
            p: origins[SEGMENT[f"{side}_{p}"]]
            for p in ("upper_arm", "forearm", "hand", "fingers", "thigh", "shin", "foot")
        }
        for part, child in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot")):
            fill(part, of(f"{side}_{part}"), between(at[part], at[child]))
        hand = of(f"{side}_hand", f"{side}_fingers")
        t = between(at["hand"], at["fingers"])
        fill("hand", hand, t / t[hand].max())
        foot = of(f"{side}_foot")
        fill("foot", foot, spread(-points[:, 1], foot))
    return region, along


def drape(
    points: Float[Tensor, "n p 3"], normals: Float[Tensor, "n p 3"], region: Int[Tensor, " p"]
) -> Float[Tensor, "n p"]:
    """Distance along the normal from the trunk's surface to its horizontal convex hull, at most 6 cm; elsewhere 0.

    Cloth hangs over hollows (between the breasts, along the spine) and does not follow them.
    """
    trunk = ((region == REGION["trunk_upper"]) | (region == REGION["trunk_lower"])).nonzero()[:, 0]
    p, flat = points[:, trunk], torch.nn.functional.normalize(normals[:, trunk, :2], dim=2)
    angles = torch.arange(32) * (2 * torch.pi / 32)
    directions = torch.stack([angles.cos(), angles.sin()])
    height = p[..., 2].mean(0)
    slices = ((height - height.min()) / 0.035).long()
    count = int(slices.max()) + 1
    ahead = p[..., :2] @ directions  # (N, T, 32)
    hull = torch.stack([ahead[:, (slices - k).abs() <= 1].amax(1) for k in range(count)], 1)  # slices overlap
    room = (hull[:, slices] - ahead) / (flat @ directions).clamp_min(1e-3)
    upright = (1.4 - 2 * normals[:, trunk, 2].abs()).clamp(0, 1)  # not on the shoulders and below the crotch
    out = torch.zeros(points.shape[:2])
    out[:, trunk] = room.amin(2).clamp(0, 0.06) * upright
    return out
