"""The static scene (what stays where it is while person and moving part do not), and its map for a robot's base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial import cKDTree

from understudy.demonstration.demonstration import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from understudy.geometry import inverse, transform_points
from understudy.skeleton import BONES
from understudy.types import RegisteredDepth
from understudy.voxels import cloud

VOXEL: Final = 0.04
"""metres"""
RESOLUTION: Final = 0.03
"""metres: edge of a cell of the map; doorways are but a hand's breadth wider than a robot"""
HEIGHTS: Final = (0.10, 1.60)
"""metres above the floor: what a base (and what stands on it) can bump into"""

_POINTS = 40_000  # of a frame
_BODY = 0.25  # metres around the bones that belong to the person (clothes, and the error of joints)
_BEHIND = 0.10  # metres: measured so much farther away means that nothing was there
_FARTHEST = 6.0  # metres from the camera: beyond, depth is not worth a map
_NOTHING = np.float32(1e3)  # metres
_WIDEST = 4  # pixels of a gap, to either side
_STAYS = 0.75  # least share of the looks at a place that found something
_COMPANY = 2  # neighbours that a voxel needs
_PART = 0.06  # metres around the moving part
_RAYS, _LOW = 3000, 0.5  # rays of a frame that clear the way; below this height, metres
_STEP = 0.05  # metres along a ray, at the farthest
_WALKED = 0.20  # metres around where the person walked


@dataclass(frozen=True, eq=False)
class View:
    """What the camera measured at one moment, and the people it saw."""

    depth: RegisteredDepth
    joints: Float[np.ndarray, "k 18 3"]
    """of k people, colour camera's frame, metres; NaN rows are allowed"""


@dataclass(frozen=True, eq=False)
class Sweep:
    """The room that the moving part takes: a box, and points, in some of its poses."""

    T_world_part: Float[np.ndarray, "n 4 4"]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    """corners of the box in the part's frame"""
    points: Float[np.ndarray, "m 3"] | None = None
    """what sticks out of the box (a handle), in the part's frame"""

    def holds(self, points: Float[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, " n"]:
        """Which points (world) are in the box, or so near to it or to a point, in any pose."""
        inside = np.zeros(len(points), bool)
        tree = None if self.points is None or not len(self.points) else cKDTree(self.points)
        for T in self.T_world_part:
            own = transform_points(inverse(T), points)
            inside |= ((own > self.low - margin) & (own < self.high + margin)).all(axis=1)
            if tree is not None:
                rest = np.flatnonzero(~inside)
                inside[rest] = tree.query(own[rest], distance_upper_bound=margin)[0] < margin
        return inside


@dataclass(frozen=True, eq=False)
class Votes:
    """What k looks say about n voxels of a frame: a look in which something nearer hid a voxel says nothing."""

    center: Float[np.ndarray, "n 3"]
    """middles of what was measured in them, metres"""
    hit: Bool[np.ndarray, "n k"]
    """the look found a surface there"""
    through: Bool[np.ndarray, "n k"]
    """the look went through its middle, to something farther away"""

    @property
    def stays(self) -> Bool[np.ndarray, " n"]:
        """Where most looks found a surface."""
        return stays(self.hit, self.through)


def stays(hit: Bool[np.ndarray, "n k"], through: Bool[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
    """Where enough of the looks that say something found a surface; of several, more than one."""
    hits = hit.sum(axis=1)
    return np.asarray((hits >= min(2, max(hit.shape[1] - 1, 1))) & (hits >= _STAYS * (hits + through.sum(axis=1))))


def votes(views: Sequence[View], T_frame_cam: Float[np.ndarray, "k 4 4"]) -> Votes:
    """Of looks from cameras whose poses in the frame are given; people are left out."""
    clouds = [
        transform_points(T, _without_people(view).astype(np.float64))
        for view, T in zip(views, T_frame_cam, strict=True)
    ]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    look = np.repeat(np.arange(len(views)), [len(c) for c in clouds])
    if not len(points):
        none = np.zeros((0, len(views)), bool)
        return Votes(points, none, none)
    cell = np.floor(points / VOXEL).astype(np.int64)
    cell -= cell.min(axis=0)
    _, which, count = np.unique(
        np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)), return_inverse=True, return_counts=True
    )
    center = np.column_stack([np.bincount(which, axis) for axis in points.T]) / count[:, None]
    hit = np.zeros((len(center), len(views)), bool)
    hit[which, look] = True
    through = [
        seen_through(view.depth, transform_points(inverse(T), center))
        for view, T in zip(views, T_frame_cam, strict=True)
    ]
    return Votes(center, hit, np.stack(through, axis=1))


def static_scene(
    views: Sequence[View], T_world_cam: Float[np.ndarray, "4 4"], sweep: Sweep | None = None
) -> Float32[np.ndarray, "n 3"]:
    """Points (world, one for each voxel) of what stayed in its place.

    A place counts when most looks at it found a surface: looks in which something nearer hid it say nothing; looks that
    went through it speak against it. sweep: of the moving part; what is there is left out.
    """
    seen = votes(views, np.broadcast_to(T_world_cam, (len(views), 4, 4)))
    points = without_specks(seen.center[seen.stays])
    if sweep is not None:
        points = points[~sweep.holds(points, _PART)]
    return points.astype(np.float32)


def without_specks(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Without voxels that (almost) stand alone in the air: noise, or what is left of a person."""
    if not len(points):
        return points
    tree = cKDTree(points)
    neighbours = tree.query_ball_point(points, 1.8 * VOXEL, return_length=True) - 1
    kept: Float[np.ndarray, "m 3"] = points[np.asarray(neighbours) >= _COMPANY]
    return kept


def occupancy(
    scene: Float32[np.ndarray, "n 3"],
    views: Sequence[View],
    T_world_cam: Float[np.ndarray, "4 4"],
    walked: Float[np.ndarray, "_ 2"] | None = None,
) -> OccupancyMap:
    """The map of a scene: occupied where it has points at HEIGHTS; free where the floor was seen, where low rays
    passed, and around where the person walked (world, metres); unknown elsewhere.
    """
    solid = scene[(scene[:, 2] > HEIGHTS[0]) & (scene[:, 2] < HEIGHTS[1])]
    open_floor = scene[np.abs(scene[:, 2]) < HEIGHTS[0]]
    rays = [_low_points(view, T_world_cam) for view in views]
    ways = np.zeros((0, 2)) if walked is None else walked[np.isfinite(walked).all(axis=1)]
    everything = np.concatenate([scene[:, :2], *(r[:, :2] for r in rays), ways])
    if not len(everything):
        return OccupancyMap(np.zeros((1, 1), np.uint8), np.zeros(2), RESOLUTION)
    low = np.floor(everything.min(axis=0) / RESOLUTION) - 2
    size = np.ceil(everything.max(axis=0) / RESOLUTION) + 3 - low
    state = np.full((int(size[1]), int(size[0])), UNKNOWN, np.uint8)
    square = np.stack(np.meshgrid(*[(-VOXEL / 2, 0.0, VOXEL / 2)] * 2), axis=-1).reshape(-1, 2)
    for points in (open_floor, *rays):  # each stands for a voxel; what is occupied is known better
        _mark(state, (points[:, None, :2] + square).reshape(-1, 2), low, FREE)
    disc = _disc(_WALKED)
    _mark(state, (ways[:, None] + disc).reshape(-1, 2), low, FREE)
    taken = np.zeros_like(state)
    _mark(taken, solid[:, :2], low, 1)
    # voxels are larger than cells: what is between neighbours is closed, the outline stays
    state[cv2.morphologyEx(taken, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0] = OCCUPIED
    return OccupancyMap(state, low * RESOLUTION, RESOLUTION)


def _without_people(view: View) -> Float32[np.ndarray, "n 3"]:
    """Points of the depth image that do not lie on or near a person; colour camera's frame."""
    points = cloud(view.depth, _POINTS)
    points = points[points[:, 2] < _FARTHEST]
    ends = view.joints[:, np.array(BONES)].reshape(-1, 2, 3)
    ends = ends[np.isfinite(ends).all(axis=(1, 2))].astype(np.float32)
    if not len(ends):
        return points
    near = np.flatnonzero(
        ((points > ends.min(axis=(0, 1)) - _BODY) & (points < ends.max(axis=(0, 1)) + _BODY)).all(axis=1)
    )
    keep = np.ones(len(points), bool)
    keep[near] = _distance_to_bones(points[near], ends) > _BODY
    return points[keep]


def _distance_to_bones(points: Float32[np.ndarray, "n 3"], ends: Float32[np.ndarray, "k 2 3"]) -> np.ndarray:
    """Metres from each point to the nearest of k straight bones."""
    best = np.full(len(points), np.inf, np.float32)
    for a, b in ends:
        along = b - a
        share = np.clip((points - a) @ along / max(float(along @ along), 1e-9), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - share[:, None] * along, axis=1))
    return best


def seen_through(depth: RegisteredDepth, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points (camera's frame) lie clearly in front of what was measured in their pixel."""
    z = points[:, 2]
    uv = depth.camera.project(points)
    inside = depth.camera.contains(uv) & (z > 0.1)
    column, row = np.rint(uv[inside]).astype(int).T
    measured = _without_gaps(depth)[row, column]
    out = np.zeros(len(points), bool)
    out[inside] = measured > z[inside] + _BEHIND
    return out


def _without_gaps(depth: RegisteredDepth) -> Float32[np.ndarray, "h w"]:
    """Depth in which a pixel that nothing was measured in has the least of those that are nearest to it, as far away as
    a voxel is wide in the image: registered depth is a net with gaps, and some of them are there in every frame.
    """
    z = np.where(depth.z > 0, depth.z, _NOTHING)
    for _ in range(int(np.clip(round(depth.camera.fx * VOXEL / 2 / _FARTHEST), 1, _WIDEST))):
        z = np.where(z < _NOTHING, z, cv2.erode(z, np.ones((3, 3), np.uint8)))
    return np.where(z < _NOTHING, z, np.float32(0))


def _low_points(view: View, T_world_cam: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Places in the air that rays passed at a height of less than _LOW; world."""
    points = _without_people(view)
    points = points[:: max(1, len(points) // _RAYS)].astype(np.float64)
    end, start = transform_points(T_world_cam, points), T_world_cam[:3, 3]
    steps = max(2, int(np.ceil(_FARTHEST / _STEP)))
    share = (np.arange(steps) + 0.5) / steps * 0.98  # not into what the ray met
    drop = start[2] - end[:, 2]
    from_share = np.where(drop > 1e-6, (start[2] - _LOW) / np.maximum(drop, 1e-6), 2.0)  # where the ray gets so low
    ray, step = np.nonzero(share > np.maximum(from_share, 0)[:, None])
    passed: np.ndarray = start + share[step, None] * (end[ray] - start)
    return passed[passed[:, 2] > 0.02]


def _disc(radius: float) -> Float[np.ndarray, "n 2"]:
    n = int(np.ceil(radius / RESOLUTION))
    grid = np.stack(np.meshgrid(*[np.arange(-n, n + 1) * RESOLUTION] * 2), axis=-1).reshape(-1, 2)
    return grid[np.linalg.norm(grid, axis=1) <= radius]


def _mark(state: UInt8[np.ndarray, "r c"], xy: Float[np.ndarray, "n 2"], low: np.ndarray, value: int) -> None:
    cell = np.rint(xy / RESOLUTION - low).astype(int)
    inside = ((cell >= 0) & (cell < (state.shape[1], state.shape[0]))).all(axis=1)
    state[cell[inside, 1], cell[inside, 0]] = value
