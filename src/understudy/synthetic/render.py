"""Depth images by splatting surface points and casting rays at boxes; in view coordinates (understudy.voxels)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.synthetic.scene import Boxes, Cameras

FAR: Final = 60.0
"""metres: nothing there"""
_TICKS = 4096.0  # per metre: depths are compared as integers, which carry the label of the point in their last bit
_NEAREST = 0.15  # metres: points nearer to the camera are left out
_NEAREST_BOX = 0.05  # metres, the same for boxes


def splat(
    points: Float[Tensor, "b n 3"], label: Bool[Tensor, "b n"], scale: Float[Tensor, " b"], size: int
) -> tuple[Float[Tensor, "b s s"], Bool[Tensor, "b s s"]]:
    """Nearest point of each pixel, every point covering 2 x 2 pixels; NaN points are left out.

    points: camera's frame, metres. scale: focal length in pixels; the optical axis meets the image's centre.
    Returns depths (metres; FAR where there is nothing), and the labels of what is seen.
    """
    key = (points[..., 2].nan_to_num(FAR) * _TICKS).int() * 2 + label.int()
    buffer = _least(points, key, int(FAR * _TICKS) * 2, scale, size)
    depth = torch.div(buffer, 2, rounding_mode="floor").float() / _TICKS
    return depth, buffer % 2 == 1


def splat_which(
    points: Float[Tensor, "b n 3"], scale: Float[Tensor, " b"], size: int
) -> tuple[Float[Tensor, "b s s"], Int[Tensor, "b s s"]]:
    """As `splat`, and the number of the point that each pixel sees; -1 for none."""
    n = points.shape[1]
    nothing = int(FAR * _TICKS) * n
    key = (points[..., 2].nan_to_num(FAR) * _TICKS).long() * n + torch.arange(n, device=points.device)
    buffer = _least(points, key, nothing, scale, size)
    depth = torch.div(buffer, n, rounding_mode="floor").float() / _TICKS
    return depth, torch.where(buffer < nothing, buffer % n, -1)


def _least(
    points: Float[Tensor, "b n 3"], key: Int[Tensor, "b n"], nothing: int, scale: Float[Tensor, " b"], size: int
) -> Int[Tensor, "b s s"]:
    """The least key of the points that cover each pixel (see `splat`); `nothing` where there is none."""
    b, z = len(points), points[..., 2]
    ok = z > _NEAREST  # False for NaN
    uv = points[..., :2] / z.clamp_min(_NEAREST)[..., None] * scale[:, None, None] + size / 2 - 1.0
    corner = uv.nan_to_num(-9.0).clamp(-9, size + 9).floor().int()
    buffer = torch.full((b, size * size), nothing, dtype=key.dtype, device=points.device)
    for dy in (0, 1):
        for dx in (0, 1):
            u, v = corner[..., 0] + dx, corner[..., 1] + dy
            inside = ok & (u >= 0) & (u < size) & (v >= 0) & (v < size)
            index = torch.where(inside, v * size + u, 0)
            buffer.scatter_reduce_(1, index.long(), torch.where(inside, key, nothing), "amin")
    return buffer.reshape(b, size, size)


def pixel_rays(scale: Float[Tensor, " b"], size: int) -> Float[Tensor, "b s s 3"]:
    """Directions (z = 1) of the pixels' centres."""
    offset = torch.arange(size, device=scale.device, dtype=torch.float32) + 0.5 - size / 2
    v, u = torch.meshgrid(offset, offset, indexing="ij")
    uv = torch.stack([u, v], -1) / scale[:, None, None, None]
    return torch.cat([uv, torch.ones_like(uv[..., :1])], -1)


def cast(boxes: Boxes, origin: Float[Tensor, "b 3"], rays: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
    """Distance along each ray (world frame, in lengths of the ray) to the nearest box; FAR where there is none.

    A box that holds the origin is not hit.
    """
    nearest = torch.full(rays.shape[:2], FAR, device=rays.device)
    for distance in _each_box(boxes, origin, rays):
        torch.minimum(nearest, distance, out=nearest)
    return nearest


def cast_which(
    boxes: Boxes, origin: Float[Tensor, "b 3"], rays: Float[Tensor, "b n 3"]
) -> tuple[Float[Tensor, "b n"], Int[Tensor, "b n"]]:
    """As `cast`, and the number of the box that is hit; -1 for none."""
    nearest = torch.full(rays.shape[:2], FAR, device=rays.device)
    which = torch.full(rays.shape[:2], -1, device=rays.device)
    for k, distance in enumerate(_each_box(boxes, origin, rays)):
        which[distance < nearest] = k
        torch.minimum(nearest, distance, out=nearest)
    return nearest, which


def _each_box(boxes: Boxes, origin: Tensor, rays: Tensor) -> Iterator[Float[Tensor, "b n"]]:
    """Distances to one box after the other; box by box, temporaries stay in the cache."""
    x, y, z = rays.unbind(-1)
    start = boxes.local(origin[:, None])[:, :, 0]
    inverse_z = 1 / torch.where(z.abs() < 1e-6, 1e-6, z)
    cos, sin = boxes.yaw.cos()[..., None], boxes.yaw.sin()[..., None]
    for k in range(boxes.half.shape[1]):
        c, s = cos[:, k], sin[:, k]
        enter = leave = None
        for axis in range(3):
            if axis == 2:
                inverse = inverse_z
            else:
                direction = c * x + s * y if axis == 0 else c * y - s * x
                inverse = 1 / torch.where(direction.abs() < 1e-6, 1e-6, direction)
            a = (-boxes.half[:, k, axis, None] - start[:, k, axis, None]) * inverse
            b = (boxes.half[:, k, axis, None] - start[:, k, axis, None]) * inverse
            first, last = torch.minimum(a, b), torch.maximum(a, b)
            enter = first if enter is None else torch.maximum(enter, first, out=first)
            leave = last if leave is None else torch.minimum(leave, last, out=last)
        assert enter is not None and leave is not None
        yield torch.where((enter < leave) & (enter > _NEAREST_BOX), enter, FAR)


def to_world(cameras: Cameras, R_view_cam: Float[Tensor, "b 3 3"], rays: Float[Tensor, "b n 3"]) -> Tensor:
    """Directions of the view -> world."""
    return rays @ (R_view_cam @ cameras.R_cam_world)
