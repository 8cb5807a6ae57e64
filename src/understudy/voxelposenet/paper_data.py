"""The paper's input and target from our simulated batches, made on the fly (torch, any device).

A `Batch` holds depth as two layers of 64 x 64 columns of a view that looks at the person, not a point cloud in the
colour camera's frame. What is made of it differs from the real input (`paper_grid.network_input`) in this:

- The grid's axes are those of the view, turned so that z goes through the person. For a person in the middle of the
  image they are the camera's; at the image's rim up to some 40 degrees lie between them.
- Occupancy comes from the nearest and the farthest depth of each column (4 cm at the person), each as a patch of
  2 x 2 points, instead of from all of the sensor's points. Cells between those two are not seen.
- What lies more than 1.32 m before or behind the view's centre is not in the grid. A root on an occluder that is
  nearer than that stands 1.4 m before the view's centre: too near, as in the paper, but not by as much.
- "The 3 nearest valid depths" at a root are those of columns, not of pixels.
- Who has no root by the paper's rules has a grid about the view's centre; training leaves such people out.
- The box is always the one of test time (1.2 times the paper's); the paper varies it in training.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.lifting import SEEN_SCORE
from understudy.synthetic.samples import Batch
from understudy.voxelposenet.paper_grid import ROOTS, SCORE_WIDTH, SIZE, PaperGrid, PaperRoot
from understudy.voxels import CELL, CELLS, EMPTY, HALF

_BOXES: Final = [PaperGrid.around(PaperRoot(joint, np.zeros(3))) for joint in ROOTS]
_LOW: Final = torch.tensor(np.stack([box.origin for box in _BOXES]), dtype=torch.float32)
_EDGE: Final = _BOXES[0].cell * SIZE  # metres
_REACH: Final = 0.036  # radians: how far from a root's keypoint its depth may be (`lifting.RADIUS` of a Kinect v2)
_NEAREST_Z: Final = 0.1  # metres


class PaperBatch(NamedTuple):
    """Input of the paper's network, and its truth. Grid axes x, y, z are those of the view; s cells along each."""

    input: Float[Tensor, "b 19 s s s"]
    """occupancy, then score maps of the joints"""
    cells: Float[Tensor, "b 18 3"]
    """the true joints in cells (integers are centres); NaN for people without a root"""
    origin: Float[Tensor, "b 3"]
    """the grid's corner of least x, y, z: metres, view's frame (its camera is the origin)"""
    rooted: Bool[Tensor, " b"]


def cell_size(size: int = SIZE) -> float:
    """Metres: edge of a cell of a grid with `size` cells along its edge."""
    return _EDGE / size


def paper_batch(batch: Batch, size: int = SIZE) -> PaperBatch:
    """See the module's text."""
    cell = cell_size(size)
    root, low, rooted = _roots(batch)
    origin = root + low
    grid = torch.cat([_occupancy(batch, origin, size)[:, None], _score_maps(batch, root, origin, size)], 1)
    cells = (to_metres(batch.joints, batch.root_z) - origin[:, None]) / cell - 0.5
    return PaperBatch(grid, torch.where(rooted[:, None, None], cells, torch.nan), origin, rooted)


def to_metres(view: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b 1"]) -> Float[Tensor, "b n 3"]:
    """View coordinates (`understudy.voxels`) -> the view's frame, metres."""
    z = (view[..., 2:] + root_z[:, None]).clamp_min(_NEAREST_Z)
    return torch.cat([view[..., :2] * z / root_z[:, None], z], -1)


def to_view(metres: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b 1"]) -> Float[Tensor, "b n 3"]:
    """The view's frame, metres -> view coordinates."""
    z = metres[..., 2:].clamp_min(_NEAREST_Z)
    return torch.cat([metres[..., :2] / z * root_z[:, None], z - root_z[:, None]], -1)


def peaks(
    volumes: Float[Tensor, "b 18 s s s"], origin: Float[Tensor, "b 3"]
) -> tuple[Float[Tensor, "b 18 3"], Float[Tensor, "b 18"]]:
    """The largest cell of each score volume: its centre (metres, view's frame) and its value, the 3D score."""
    size = volumes.shape[-1]
    score, best = volumes.flatten(2).max(-1)
    place = torch.stack([best // size**2, best // size % size, best % size], -1)
    return origin[:, None] + (place + 0.5) * cell_size(size), score


def assembled(metres: Float[Tensor, "b 18 3"], score: Float[Tensor, "b 18"], batch: Batch) -> Float[Tensor, "b 18 3"]:
    """The paper's result in view coordinates: where the 2D score exceeds the 3D score, the 2D keypoint at the network's
    depth, else the network's position. metres, score: of `peaks`.
    """
    view = to_view(metres, batch.root_z)
    ray = torch.cat([batch.keypoints[..., :2], view[..., 2:]], -1)
    return torch.where((batch.keypoints[..., 2] > score)[..., None], ray, view)


def _roots(batch: Batch) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"], Bool[Tensor, " b"]]:
    """Roots (metres, view's frame), the corners of their boxes from there, and who has one."""
    xy, score = batch.keypoints[:, list(ROOTS), :2], batch.keypoints[:, list(ROOTS), 2]
    near = batch.depth[:, :1].flatten(2)  # (b, 1, 4096)
    at = (torch.arange(CELLS, device=xy.device) + 0.5) * CELL - HALF
    row, column = torch.meshgrid(at, at, indexing="ij")
    away = (xy[..., :1] - column.flatten()) ** 2 + (xy[..., 1:] - row.flatten()) ** 2
    away = torch.where(near < 0.5 * (EMPTY + HALF), away, torch.inf)
    away3, which = away.topk(3, largest=False, sorted=True)
    z = near.expand_as(away).gather(2, which).median(-1).values + batch.root_z  # (b, 3)
    reach = (_REACH * batch.root_z).clamp_min(2 * CELL)
    visible = (score > SEEN_SCORE) & (away3[..., 2] < reach**2) & (z > _NEAREST_Z)
    rooted = visible.any(1)
    first = torch.where(rooted, visible.float().argmax(1), 1)  # without a root: a hip's box
    b = torch.arange(len(first), device=first.device)
    point = torch.cat([xy[b, first] * z[b, first, None] / batch.root_z, z[b, first, None]], 1)
    center = torch.cat([torch.zeros_like(xy[:, 0]), batch.root_z], 1)
    return torch.where(rooted[:, None], point, center), _LOW.to(xy.device)[first], rooted


def _occupancy(batch: Batch, origin: Float[Tensor, "b 3"], size: int) -> Float[Tensor, "b s s s"]:
    """1 where at least one depth lies in the cell."""
    b, device = len(origin), origin.device
    at = (torch.arange(2 * CELLS, device=device) + 0.5) * (CELL / 2) - HALF  # two points along a column's edge
    y, x = torch.meshgrid(at, at, indexing="ij")
    depth = batch.depth.repeat_interleave(2, 2).repeat_interleave(2, 3).flatten(2)  # (b, 2, 16384)
    x, y = (t.flatten().expand_as(depth) for t in (x, y))
    points = to_metres(torch.stack([x, y, depth], -1).flatten(1, 2), batch.root_z)
    place = ((points - origin[:, None]) / cell_size(size)).floor().long()
    inside = (depth.abs() < HALF).flatten(1) & ((place >= 0) & (place < size)).all(-1)
    flat = (place[..., 0] * size + place[..., 1]) * size + place[..., 2]
    grid = torch.zeros(b, size**3 + 1, device=device)  # the last one is for all points outside
    grid.scatter_(1, torch.where(inside, flat, size**3), 1.0)
    return grid[:, :-1].reshape(b, size, size, size)


def _score_maps(
    batch: Batch, root: Float[Tensor, "b 3"], origin: Float[Tensor, "b 3"], size: int
) -> Float[Tensor, "b 18 s s s"]:
    """exp(-d^2 / 3^2) about the cell of each 2D keypoint at the root's depth, the same for every z."""
    xy, score = batch.keypoints[..., :2], batch.keypoints[..., 2]
    metres = xy * (root[:, 2:] / batch.root_z)[:, None]
    at = ((metres - origin[:, None, :2]) / cell_size(size) - 0.5).round()
    shown = (score > SEEN_SCORE) & ((at > 0) & (at < size - 1)).all(-1)
    cells = torch.arange(size, device=xy.device)
    line = torch.exp(-(((cells - torch.where(shown[..., None], at, 0.0)[..., None]) / SCORE_WIDTH) ** 2))
    maps = line[:, :, 0, :, None] * line[:, :, 1, None, :] * shown[..., None, None]
    return maps[..., None].expand(-1, -1, -1, -1, size)
