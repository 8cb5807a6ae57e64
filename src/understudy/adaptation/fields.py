"""Distances to obstacles: interpolated fields for the optimiser, and the exact test of a footprint against a map."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from understudy.demonstration.demonstration import OCCUPIED, UNKNOWN, OccupancyMap

_PAD_M: Final = 1.5  # of space around what was mapped: distances go on growing there
_CHUNK: Final = 4096  # poses at a time in the exact test
_LARGEST: Final = 1e3  # metres: nothing is near


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance to the nearest obstacle on a grid of k = 2 or 3 dimensions, interpolated linearly per axis."""

    values: Float[np.ndarray, "..."]
    """metres, at the cells' centres; axes in the order x, y(, z); negative inside obstacles"""
    origin: Float[np.ndarray, " k"]
    """centre of the first cell"""
    cell_m: float

    def at(self, points: Float[np.ndarray, "n k"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """Distances (metres) and their gradients at points; beyond the grid, those of its edge."""
        place = (points - self.origin) / self.cell_m
        low = np.clip(np.floor(place), 0, np.array(self.values.shape) - 2)
        share = place - low
        inside = (share >= 0) & (share <= 1)
        share = np.clip(share, 0, 1)
        strides = np.array(self.values.strides) // self.values.itemsize
        flat, first = self.values.reshape(-1), (low @ strides).astype(np.int64)
        # one axis after the other: the values at the corners, and their derivatives over the axes that are done
        corners = {c: flat[first + int(np.dot(c, strides))] for c in product((0, 1), repeat=points.shape[1])}
        slopes: list[dict[tuple[int, ...], np.ndarray]] = []
        for axis in range(points.shape[1]):
            f = share[:, axis]
            rest = [c[1:] for c in corners if c[0] == 0]
            slopes = [{c: s[0, *c] + f * (s[1, *c] - s[0, *c]) for c in rest} for s in slopes]
            slopes.append({c: corners[1, *c] - corners[0, *c] for c in rest})
            corners = {c: corners[0, *c] + f * slopes[-1][c] for c in rest}
        gradient = np.stack([s[()] for s in slopes], axis=1)
        return corners[()], np.where(inside, gradient, 0.0) / self.cell_m

    def values_at(self, points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Distances alone, in a third of the time."""
        place = (points - self.origin) / self.cell_m
        low = np.clip(np.floor(place), 0, np.array(self.values.shape) - 2)
        share = np.clip(place - low, 0, 1)
        strides = np.array(self.values.strides) // self.values.itemsize
        flat, first = self.values.reshape(-1), (low @ strides).astype(np.int64)
        corners = {c: flat[first + int(np.dot(c, strides))] for c in product((0, 1), repeat=points.shape[1])}
        for axis in range(points.shape[1]):
            f = share[:, axis]
            rest = [c[1:] for c in corners if c[0] == 0]
            corners = {c: corners[0, *c] + f * (corners[1, *c] - corners[0, *c]) for c in rest}
        return corners[()]


def signed_distance(
    blocked: Bool[np.ndarray, "..."], origin: Float[np.ndarray, " k"], cell_m: float, pad_m: float = _PAD_M
) -> DistanceField:
    """The field of blocked cells (axes x, y(, z)). Distances count from the cells' edges: half a cell less.

    pad_m: free space that is added around, in which distances go on growing.
    """
    pad = int(np.ceil(pad_m / cell_m))
    blocked = np.pad(blocked, pad)
    if not blocked.any():
        values = np.full(blocked.shape, _LARGEST)
    else:
        outside = distance_transform_edt(~blocked) - 0.5
        values = cell_m * np.where(blocked, 0.5 - distance_transform_edt(blocked), outside)
    return DistanceField(np.ascontiguousarray(values), np.asarray(origin, np.float64) - pad * cell_m, cell_m)


def obstacle_field(map: OccupancyMap) -> DistanceField:
    """Distance to occupied cells. Unknown cells are not obstacles here (see `unknown_field`)."""
    return signed_distance((map.state == OCCUPIED).T, map.origin_xy, map.resolution_m)


def unknown_field(map: OccupancyMap) -> DistanceField:
    """Distance to cells that nothing is known about, within the map's bounds."""
    return signed_distance((map.state == UNKNOWN).T, map.origin_xy, map.resolution_m)


def point_field(points: Float[np.ndarray, "n 3"], low: np.ndarray, high: np.ndarray, cell_m: float) -> DistanceField:
    """Distance to 3D points within the box from low to high (metres, world)."""
    shape = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1) + 1
    cells = np.rint((points - low) / cell_m).astype(int)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    blocked = np.zeros(shape, bool)
    blocked[tuple(cells.T)] = True
    return signed_distance(blocked, low, cell_m, pad_m=0.0)


def outline(polygon: Float[np.ndarray, "k 2"], spacing_m: float) -> Float[np.ndarray, "m 2"]:
    """Points along a polygon's edges, its corners among them."""
    points = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing_m)))
        points.append(a + (b - a) * (np.arange(n) / n)[:, None])
    return np.concatenate(points)


def half_planes(polygon: Float[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """Outward unit normals n and offsets c of a convex, counter-clockwise polygon: inside where n x <= c."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    normals = np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=1, keepdims=True)
    return normals, np.sum(normals * polygon, axis=1)


def polygon_distance(
    polygon: Float[np.ndarray, "k 2"], points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Signed distances (negative inside) of points to a convex polygon, and gradients over the points."""
    normals, offsets = half_planes(polygon)
    x, y = points.T
    height, squared = np.full(len(x), -np.inf), np.full(len(x), np.inf)
    inward, away = np.zeros((len(x), 2)), np.zeros((len(x), 2))
    for a, b, n, c in zip(polygon, np.roll(polygon, -1, axis=0), normals, offsets, strict=True):
        h = n[0] * x + n[1] * y - c
        higher = h > height
        height[higher], inward[higher] = h[higher], n
        dx, dy = _from_edge(x, y, a, b)
        d = dx**2 + dy**2
        nearer = d < squared
        squared[nearer] = d[nearer]
        away[nearer, 0], away[nearer, 1] = dx[nearer], dy[nearer]
    length, inside = np.sqrt(squared), height <= 0
    gradient = np.where(inside[:, None], inward, away / np.maximum(length, 1e-12)[:, None])
    return np.where(inside, height, length), gradient


def _from_edge(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """From the nearest point of the edge a to b to each point."""
    dx, dy, edge = x - a[0], y - a[1], b - a
    share = np.clip((edge[0] * dx + edge[1] * dy) / (edge @ edge), 0, 1)
    return dx - share * edge[0], dy - share * edge[1]


def polygon_values(
    polygon: Float[np.ndarray, "k 2"], x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The values of `polygon_distance` alone, many times faster."""
    normals, offsets = half_planes(polygon)
    height, squared = np.full(len(x), -np.inf), np.full(len(x), np.inf)
    for a, b, n, c in zip(polygon, np.roll(polygon, -1, axis=0), normals, offsets, strict=True):
        np.maximum(height, n[0] * x + n[1] * y - c, out=height)
        dx, dy = _from_edge(x, y, a, b)
        np.minimum(squared, dx**2 + dy**2, out=squared)
    return np.where(height <= 0, height, np.sqrt(squared))


def collision_free(
    map: OccupancyMap, polygon: Float[np.ndarray, "k 2"], base: Float[np.ndarray, "t 3"]
) -> Bool[np.ndarray, " t"]:
    """Whether the convex footprint at each base pose (x, y, yaw) overlaps no occupied cell: exact (separating axes)."""
    free = np.ones(len(base), bool)
    for start in range(0, len(base), _CHUNK):
        part = slice(start, start + _CHUNK)
        pose, row, column = cells_near(map, base[part], float(np.linalg.norm(polygon, axis=1).max()))
        hit = _overlaps(map, polygon, base[part][pose], row, column)
        free[start + pose[hit]] = False
    return free


def cells_near(
    map: OccupancyMap, base: Float[np.ndarray, "n 3"], radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(pose, row, column) of every occupied cell in the square around each pose (metres to its sides at least)."""
    reach = int(np.ceil(radius / map.resolution_m)) + 1
    centre = np.rint((base[:, 1::-1] - map.origin_xy[::-1]) / map.resolution_m).astype(int)
    window = np.arange(-reach, reach + 1)
    rows, columns = centre[:, :1] + window, centre[:, 1:] + window
    h, w = map.state.shape
    known = ((rows >= 0) & (rows < h))[:, :, None] & ((columns >= 0) & (columns < w))[:, None, :]
    state = map.state[np.clip(rows, 0, h - 1)[:, :, None], np.clip(columns, 0, w - 1)[:, None, :]]
    pose, i, j = np.nonzero(known & (state == OCCUPIED))
    return pose, rows[pose, i], columns[pose, j]


def _overlaps(
    map: OccupancyMap, polygon: np.ndarray, base: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Whether polygon (at each of m poses) and cell (of each of m pairs) overlap."""
    half = 0.5 * map.resolution_m
    centre = map.origin_xy + map.resolution_m * np.column_stack([column, row])
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    normals, offsets = half_planes(polygon)
    world = np.einsum("mij,kj->mki", turn, normals)
    gap = np.einsum("mki,mi->mk", world, centre - base[:, :2]) - offsets - half * np.abs(world).sum(axis=2)
    corners = np.einsum("mij,kj->mki", turn, polygon) + base[:, None, :2] - centre[:, None]
    beside = (corners.min(axis=1) >= half) | (corners.max(axis=1) <= -half)
    return ~((gap >= 0).any(axis=1) | beside.any(axis=1))
