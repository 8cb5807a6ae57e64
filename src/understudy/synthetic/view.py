"""The person's view (understudy.voxels) for batches, in torch: the same numbers as `PersonView` gives."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.skeleton import TORSO
from understudy.synthetic.draw import Draw
from understudy.voxels import CELL, CELLS, EMPTY, HALF, LIMIT

_SIZE_SIGMA = 0.12  # relative error of a distance that is judged by a person's size, see understudy.apparent_size
_NO_FLOOR = 0.3  # share of people under whom no floor was found
_FLOOR_TILT, _FLOOR_HEIGHT = 0.006, 0.01  # radians, metres: one sigma of most floors; of a tenth it is four times that
_NOT_IT, _WRONG = (-0.6, 0.3), 0.03  # metres: errors of a few heights (a table; somebody on a step); their share
_NEAREST_Z = 0.1  # metres: nothing nearer to the camera is measured


def rotation_to(direction: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """R_view_cam: as understudy.voxels.rotation_to, for a batch; directions need not be unit vectors."""
    x, y, z = torch.nn.functional.normalize(direction, dim=-1).unbind(-1)
    k = 1 / (1 + z)
    rows = [1 - k * x * x, -k * x * y, -x, -k * x * y, 1 - k * y * y, -y, x, y, z]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def columns(p: Float[Tensor, "b n 3"], root_z: Float[Tensor, " b"]) -> Float[Tensor, "b n 3"]:
    """View's frame -> view coordinates, metres."""
    z = p[..., 2:].clamp_min(_NEAREST_Z)
    return torch.cat([p[..., :2] / z * root_z[:, None, None], z - root_z[:, None, None]], -1)


def depth_grid(
    cloud: Float[Tensor, "b n 3"], ok: Bool[Tensor, "b n"], root_z: Float[Tensor, " b"]
) -> Float[Tensor, "b 2 64 64"]:
    """As `PersonView.depth_grid`, for a batch of clouds in the view's frame. ok: which points count."""
    b = len(cloud)
    z = cloud[..., 2]
    cell = cloud[..., :2] * (root_z[:, None] / CELL / z.clamp_min(_NEAREST_Z))[..., None] + CELLS // 2
    ok = ok & (z > _NEAREST_Z) & (cell >= 0).all(-1) & (cell < CELLS).all(-1)
    index = torch.where(ok, cell[..., 1].int() * CELLS + cell[..., 0].int(), 0).long()
    depth = z - root_z[:, None]
    near = torch.full((b, CELLS * CELLS), EMPTY, device=cloud.device)
    near.scatter_reduce_(1, index, torch.where(ok, depth.clamp(-LIMIT, LIMIT), EMPTY), "amin")
    within = ok & (depth.abs() < HALF)
    far = torch.full_like(near, -EMPTY)
    far.scatter_reduce_(1, index, torch.where(within, depth, -EMPTY), "amax")
    far = torch.where(far > -EMPTY, far, EMPTY)
    return torch.stack([near, far], 1).reshape(b, 2, CELLS, CELLS)


def draw_root(
    draw: Draw, joints: Float[Tensor, "b 18 3"], in_view: Bool[Tensor, "b 18"], measured: Bool[Tensor, "b 18"]
) -> tuple[Tensor, Tensor]:
    """(B, 3) a point on the view's axis and (B,) the root's depth, metres, with the errors that they have in practice.

    joints: colour camera's frame. measured: which of them lie in the depth camera's image; where no joint of the trunk
    does, the depth is known from the person's apparent size only.
    """
    b = len(joints)
    neck, hips = joints[:, 1], (joints[:, 8] + joints[:, 11]) / 2
    no_hips = ~(in_view[:, 8] | in_view[:, 11]) | draw.chance(0.08, b)
    no_neck = ~in_view[:, 1] | draw.chance(0.03, b)
    down = torch.tensor([0.0, 1.0, 0.0], device=joints.device)
    low = torch.where(no_hips[:, None], neck + 0.5 * down, hips)
    high = torch.where((no_neck & ~no_hips)[:, None], hips - 0.5 * down, neck)
    center = (low + high) / 2
    sigma = torch.where(draw.chance(0.15, b), 0.15, 0.03)[:, None]
    center = center + sigma * draw.normal(b, 3)
    z_sigma = torch.where(draw.chance(0.12, b), 0.2, 0.05)
    distance = center.norm(dim=-1)
    z_sigma = torch.where(measured[:, TORSO].any(-1), z_sigma, _SIZE_SIGMA * distance)
    root_z = distance - 0.08 + z_sigma * draw.normal(b)
    return center, root_z.clamp_min(0.4)


def draw_floor(draw: Draw, R_view_world: Float[Tensor, "b 3 3"], center: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4"]:
    """The floor as it would be measured: planes as of `PersonView.floor_plane`, zeros where there is none.

    center: the camera in the world, where the floor is z = 0 and the person at the origin; metres.
    """
    b = len(center)
    worse = torch.where(draw.chance(0.1, b), 4.0, 1.0)
    tilt = _FLOOR_TILT * worse[:, None] * draw.normal(b, 2)
    up = torch.cat([tilt, torch.ones_like(tilt[:, :1])], 1)
    up = torch.nn.functional.normalize(up, dim=-1)
    off = _FLOOR_HEIGHT * worse * draw.normal(b)
    # what was seen of the floor lies before or behind the person: there, the plane is right but for its height
    middle = center * torch.stack([draw.uniform(-0.7, 0.7, b), draw.uniform(-0.5, 0.7, b), torch.zeros_like(off)], 1)
    off = torch.where(draw.chance(_WRONG, b), draw.uniform(*_NOT_IT, b), off)
    height = ((center - middle) * up).sum(-1) + off
    plane = torch.cat([(R_view_world @ up[..., None])[..., 0], height[:, None]], 1)
    return torch.where(draw.chance(_NO_FLOOR, b)[:, None], 0.0, plane)
