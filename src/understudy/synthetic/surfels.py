"""Full-resolution images of people: every surface point is drawn as a small disc that lies in the surface.

Discs overlap; where several ones that belong to one surface meet a pixel they are blended, so that the surface is
smooth and has no holes at any distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from understudy.camera import Camera
from understudy.synthetic.render import FAR

_BLEND: Final = 0.015
"""metres: discs whose depths differ by less belong to one surface"""
_NEAREST: Final = 0.15
"""metres: discs nearer to the camera are left out"""
_WINDOWS: Final = (1, 2, 3, 4, 6, 8, 11, 15, 20, 28, 40)
"""half sizes, pixels, of the squares that discs are drawn in"""
_AT_ONCE: Final = 2_000_000
"""pixels tried at a time (bounds the memory)"""
_COVER: Final = 1.25
"""radius of a disc over the distance to its neighbours"""
_RADII: Final = (0.006, 0.06)
"""metres"""


@dataclass(frozen=True)
class Surfels:
    """Discs in one frame, metres."""

    points: Float[Tensor, "n 3"]
    """centres; NaN: not there"""
    normals: Float[Tensor, "n 3"]
    """unit, outward; discs that look away are not drawn"""
    radius: Float[Tensor, " n"]
    values: Float[Tensor, "n c"]
    """whatever is to be blended: colours, darkness, ..."""

    def moved(self, R: Float[Tensor, "3 3"], t: Float[Tensor, " 3"]) -> Surfels:
        """In another frame: p' = R p + t."""
        return Surfels(self.points @ R.T + t, self.normals @ R.T, self.radius, self.values)


def neighbours(points: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"], count: int = 6) -> Int[Tensor, "p {count}"]:
    """The nearest points of each point whose normals point roughly the same way."""
    out = []
    for rows in torch.arange(len(points), device=points.device).split(1024):
        distance = torch.cdist(points[rows], points)
        distance[(normals[rows] @ normals.T < 0.3) | (rows[:, None] == torch.arange(len(points)).to(rows))] = 9.0
        out.append(distance.topk(count, largest=False).indices)
    return torch.cat(out)


def radii(
    points: Float[Tensor, "p 3"], near: Int[Tensor, "p k"], most: Float[Tensor, " p"] | None = None
) -> Float[Tensor, " p"]:
    """Radii (metres) of discs that cover the surface, from how far the neighbours are now. most: upper limits."""
    distance = (points[near] - points[:, None]).norm(dim=-1)
    radius = (_COVER * distance.mean(1)).clamp(*_RADII)
    return radius if most is None else torch.minimum(radius, most)


def draw(surfels: Surfels, camera: Camera) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w c3"]]:
    """Depth (metres along z; FAR where nothing is), and the blended values followed by the normal; camera's frame.

    camera: without distortion.
    """
    pixels = camera.height * camera.width
    device = surfels.points.device
    hits = _hits(surfels, camera)
    pixel, z, weight, number = (torch.cat(parts) for parts in zip(*hits, strict=True)) if hits else _nothing(device)
    first = torch.full((pixels,), FAR, device=device)
    first.scatter_reduce_(0, pixel, z, "amin")
    same = z < first[pixel] + _BLEND
    pixel, z, weight, number = pixel[same], z[same], weight[same], number[same]
    what = torch.cat([surfels.values, surfels.normals, torch.ones_like(surfels.radius)[:, None]], 1)
    total = torch.zeros(pixels, what.shape[1] + 1, device=device)
    total.index_add_(0, pixel, torch.cat([what[number], z[:, None]], 1) * weight[:, None])
    mean = total / total[:, -2:-1].clamp_min(1e-12)
    depth = torch.where(total[:, -2] > 0, mean[:, -1], FAR)
    size = (camera.height, camera.width)
    return depth.reshape(size), mean[:, :-2].reshape(*size, -1)


def _nothing(device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    none = torch.zeros(0, device=device)
    return none.long(), none, none, none.long()


def _hits(surfels: Surfels, camera: Camera) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Pixel, depth, weight and number of the disc, wherever a disc meets a pixel's ray."""
    p, n = surfels.points, surfels.normals
    f, center = p.new_tensor([camera.fx, camera.fy]), p.new_tensor([camera.cx, camera.cy])
    z = p[:, 2].nan_to_num(0.0)
    uv = p[:, :2] / z.clamp_min(_NEAREST)[:, None] * f + center
    reach = surfels.radius * f.amax() / z.clamp_min(_NEAREST)
    size = p.new_tensor([camera.width, camera.height])
    near = ((uv > -reach[:, None] - 1) & (uv < size + reach[:, None])).all(1)  # False for NaN
    there = near & (z > _NEAREST) & ((n * p).sum(1) < 0)
    rows = there.nonzero()[:, 0]
    bucket = torch.bucketize(reach[rows] + 0.5, p.new_tensor(_WINDOWS[:-1]))
    out = []
    for k, half in enumerate(_WINDOWS):
        chosen = rows[bucket == k]
        span = torch.arange(-half, half + 1, device=p.device)
        v, u = torch.meshgrid(span, span, indexing="ij")
        step = torch.stack([u.flatten(), v.flatten()], 1)
        for part in chosen.split(max(1, _AT_ONCE // len(step))):
            out.append(_meet(surfels, part, uv[part].round().long()[:, None] + step, f, center, camera))
    return out


def _meet(
    surfels: Surfels, rows: Tensor, at: Int[Tensor, "m s 2"], f: Tensor, center: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rays of pixels against the planes of discs; a disc seen from its edge covers at least the pixel of its centre."""
    p, n, r = surfels.points[rows], surfels.normals[rows], surfels.radius[rows]
    xy = (at - center) / f
    across = n[:, None, 0] * xy[..., 0] + n[:, None, 1] * xy[..., 1] + n[:, None, 2]
    z = (n * p).sum(1)[:, None] / torch.where(across.abs() < 1e-4, 1e-4, across)
    away = (xy * z[..., None] - p[:, None, :2]).square().sum(-1) + (z - p[:, None, 2]).square()
    weight = (1 - away / r[:, None].square()).clamp_min(0).square()
    middle = (xy - p[:, None, :2] / p[:, None, 2:]).abs().mul(f).amax(-1) <= 0.5
    z = torch.where((weight > 0) | ~middle, z, p[:, None, 2])
    weight = torch.where(middle, weight.clamp_min(0.01), weight)
    inside = (at >= 0).all(-1) & (at[..., 0] < camera.width) & (at[..., 1] < camera.height)
    hit = inside & (weight > 0) & (z > _NEAREST)
    pixel = at[..., 1] * camera.width + at[..., 0]
    return pixel[hit], z[hit], weight[hit], rows[:, None].expand(hit.shape)[hit]
