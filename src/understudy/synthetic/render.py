"""Depth images by splatting surface points and casting rays at boxes; in view coordinates (understudy.voxels)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.synthetic.scene import Boxes, Cameras

_FAR = 60.0  # metres: nothing there
_TICKS = 4096.0  # per metre: depths are compared as integers, which carry the label of the point in their last bit


def splat(
    points: Float[Tensor, "b n 3"], label: Bool[Tensor, "b n"], scale: Float[Tensor, "b"], size: int
) -> tuple[Float[Tensor, "b s s"], Bool[Tensor, "b s s"]]:
    """Nearest point of each pixel, every point covering 2 x 2 pixels; NaN points are left out.

    points: camera's frame, metres. scale: focal length in pixels; the optical axis meets the image's centre.
    Returns depths (metres; _FAR where there is nothing), and the labels of what is seen.
    """
    b = len(points)
    z = points[..., 2]
    ok = z > 0.15  # False for NaN
    uv = points[..., :2] / z.clamp_min(0.15)[..., None] * scale[:, None, None] + size / 2 - 1.0
    corner = uv.nan_to_num(-9.0).clamp(-9, size + 9).floor().int()
    key = (z.nan_to_num(_FAR) * _TICKS).int() * 2 + label.int()
    buffer = torch.full((b, size * size), int(_FAR * _TICKS) * 2, dtype=torch.int32, device=points.device)
    for dy in (0, 1):
        for dx in (0, 1):
            u, v = corner[..., 0] + dx, corner[..., 1] + dy
            inside = ok & (u >= 0) & (u < size) & (v >= 0) & (v < size)
            index = torch.where(inside, v * size + u, 0)
            value = torch.where(inside, key, int(_FAR * _TICKS) * 2)
            buffer.scatter_reduce_(1, index.long(), value, "amin")
    depth = torch.div(buffer, 2, rounding_mode="floor").float() / _TICKS
    return depth.reshape(b, size, size), (buffer % 2 == 1).reshape(b, size, size)


def pixel_rays(scale: Float[Tensor, "b"], size: int) -> Float[Tensor, "b s s 3"]:
    """Directions (z = 1) of the pixels' centres."""
    offset = torch.arange(size, device=scale.device, dtype=torch.float32) + 0.5 - size / 2
    v, u = torch.meshgrid(offset, offset, indexing="ij")
    uv = torch.stack([u, v], -1) / scale[:, None, None, None]
    return torch.cat([uv, torch.ones_like(uv[..., :1])], -1)


def cast(boxes: Boxes, origin: Float[Tensor, "b 3"], rays: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
    """Distance along each ray (world frame, in lengths of the ray) to the nearest box; _FAR where there is none."""
    start = boxes.local(origin[:, None])
    direction = boxes.local(rays, vectors=True)
    inverse = 1 / torch.where(direction.abs() < 1e-6, 1e-6, direction)
    a = (-boxes.half[:, :, None] - start) * inverse
    c = (boxes.half[:, :, None] - start) * inverse
    enter = torch.minimum(a, c).amax(-1)
    leave = torch.maximum(a, c).amin(-1)
    hit = (enter < leave) & (enter > 0.05)
    return torch.where(hit, enter, _FAR).amin(1)


def to_world(cameras: Cameras, R_view_cam: Float[Tensor, "b 3 3"], rays: Float[Tensor, "b n 3"]) -> Tensor:
    """Directions of the view -> world."""
    return rays @ (R_view_cam @ cameras.R_cam_world)
