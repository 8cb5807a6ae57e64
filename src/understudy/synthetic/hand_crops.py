"""Crops of simulated hands: where they look, what a sensor measures of them, and the network's depth crop (torch).

The counterpart of `understudy.hands.crop` for batches. Coordinates are those of the crop view, origin in a camera;
metres.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.hands.crop import CELL, CELLS, EMPTY, LIMIT, SHORT
from understudy.synthetic.draw import Draw


def crop_rotation(center: Float[Tensor, "b 3"], up: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """R_view_cam: z through the centre, y as near as possible along `up` (from the hand to the elbow)."""
    z = torch.nn.functional.normalize(center, dim=1)
    y = up - z * (up * z).sum(1, keepdim=True)
    upright = torch.tensor([0.0, 1.0, 0.0]) - z * z[:, 1:2]
    short = y.norm(dim=1, keepdim=True) < SHORT  # the forearm points at the camera: the image's own upright
    y = torch.nn.functional.normalize(torch.where(short, upright, y), dim=1)
    return torch.stack([torch.linalg.cross(y, z), y, z], 1)


def depth_crop(
    cloud: Float[Tensor, "b n 3"], ok: Bool[Tensor, "b n"], distance: Float[Tensor, " b"]
) -> Float[Tensor, "b 2 48 48"]:
    """Nearest depth of each cell of perspective columns around the view's axis, and the mask."""
    b = len(cloud)
    z = cloud[..., 2]
    cell = cloud[..., :2] * (distance[:, None] / CELL / z.clamp_min(0.1))[..., None] + CELLS / 2
    depth = z - distance[:, None]
    ok = ok & (z > 0.1) & (cell >= 0).all(-1) & (cell < CELLS).all(-1) & (depth > -LIMIT)
    index = torch.where(ok, cell[..., 1].int() * CELLS + cell[..., 0].int(), 0).long()
    near = torch.full((b, CELLS * CELLS), EMPTY)
    near.scatter_reduce_(1, index, torch.where(ok, depth.clamp_max(LIMIT), EMPTY), "amin")
    return torch.stack([near, (near < EMPTY).float()], 1).reshape(b, 2, CELLS, CELLS)


def visible_share(
    skin: Float[Tensor, "b n 3"], facing: Bool[Tensor, "b n"], exact: Float[Tensor, "b s s"], scale: Float[Tensor, " b"]
) -> Float[Tensor, " b"]:
    """Share of the skin that faces the camera (its place in the depth camera's view) which nothing hides."""
    b, s = len(skin), exact.shape[-1]
    uv = (skin[..., :2] / skin[..., 2:].clamp_min(0.1) * scale[:, None, None] + s / 2).nan_to_num(-1).floor().long()
    inside = ((uv >= 0) & (uv < s)).all(-1) & facing
    index = torch.where(inside, uv[..., 1] * s + uv[..., 0], 0)
    surface = exact.reshape(b, -1).gather(1, index)
    free = inside & (skin[..., 2].nan_to_num(99.0) < surface + 0.012)
    return free.float().sum(1) / facing.float().sum(1).clamp_min(1)


def sampled(
    draw: Draw, z: Float[Tensor, "b s s"], pitch: Float[Tensor, " b"], scale: Float[Tensor, " b"]
) -> tuple[Float[Tensor, "b m 3"], Bool[Tensor, "b m"]]:
    """The points that a sensor measures whose pixels are `pitch` pixels of the raster apart and lie askew to them.

    In its camera's view, metres; and which of them are measurements.
    """
    b, s = len(z), z.shape[-1]
    reach = math.ceil(s / 2**0.5)
    steps = torch.arange(-reach, reach + 1, dtype=torch.float32)
    v, u = (g.flatten() for g in torch.meshgrid(steps, steps, indexing="ij"))
    u, v = (g + start for g, start in zip((u, v), draw.uniform(0, 1, 2, b, 1), strict=True))
    angle, step = draw.uniform(0, 2 * math.pi, b, 1), pitch.clamp_min(1.0)[:, None]
    at = (
        torch.stack([angle.cos() * u - angle.sin() * v, angle.sin() * u + angle.cos() * v], -1) * step[..., None]
        + s / 2
    )
    inside = ((at >= 0) & (at < s)).all(-1)
    pixel = at.long().clamp(0, s - 1)
    measured = z.reshape(b, -1).gather(1, pixel[..., 1] * s + pixel[..., 0])
    ray = torch.cat([(pixel + 0.5 - s / 2) / scale[:, None, None], torch.ones_like(at[..., :1])], -1)
    return ray * measured[..., None], inside & (measured > 0)
