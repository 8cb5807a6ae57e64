"""Things in a depth image: a coarse grid of depths without its floor, split where the depth jumps.

A person who stands free is one component; its outline says where to look in the colour image, and its cells say which
pixels are this person's and not somebody else's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from understudy.camera import Camera
from understudy.geometry import along, plane_normal
from understudy.types import RegisteredDepth

GRID_WIDTH = 160
"""cells across the image"""
_HOLE = 2.5  # cells: holes up to this far from a measurement take its label
_FLOOR_TOLERANCE = 0.06  # metres, plus 1 % of the distance


@dataclass(frozen=True)
class Component:
    """One connected thing."""

    label: int
    box: tuple[float, float, float, float]
    """left, top, right, bottom in colour pixels"""
    z: float
    """median depth, metres"""
    width: float
    """metres"""
    height: float
    """metres"""
    area: float
    """metres^2 of visible surface, as if it faced the camera"""

    def could_be_person(self) -> bool:
        """Large enough to be a person, or a good part of one. It can be much more: a person against a wall."""
        return self.area > 0.05 and self.height > 0.3 and self.width > 0.1

    def is_compact(self) -> bool:
        """Small enough to be one person, or a few who touch."""
        return self.width < 2.2 and self.height < 2.4


class DepthGrid:
    """The grid of one registered depth image."""

    def __init__(self, depth: RegisteredDepth, color: Camera):
        self.cell = int(np.ceil(depth.camera.width / GRID_WIDTH))
        """depth pixels per cell; more where the depth is so sparse that cells would stay empty"""
        self.z = _cell_minima(depth.z, self.cell)
        while _is_full_of_gaps(self.z) and self.z.shape[1] > GRID_WIDTH // 4:
            self.z, self.cell = _cell_minima(self.z, 2), 2 * self.cell
        """nearest valid depth in each cell (metres), 0 = none"""
        self._scale = depth.scale_to(color)
        gh, gw = self.z.shape
        self.camera = depth.camera.crop(0, 0, gw * self.cell, gh * self.cell).resize(gw, gh)
        """the camera whose pixels are the cells"""

    @cached_property
    def points(self) -> Float32[np.ndarray, "gh gw 3"]:
        """Cell centres in the colour camera's frame, metres; 0 where z = 0 or the lens model has no ray."""
        gh, gw = self.z.shape
        u, v = np.meshgrid(np.arange(gw), np.arange(gh))
        points = self.camera.unproject(np.stack([u, v], -1).astype(np.float64), self.z).astype(np.float32)
        return np.where(np.isfinite(points).all(-1, keepdims=True), points, 0)

    @cached_property
    def floor(self) -> Float[np.ndarray, "4"] | None:
        """Plane (unit normal up, offset): n . p + d = height above the floor in metres; None if none is seen."""
        return fit_floor(self.points, self.z > 0)

    @cached_property
    def labels(self) -> Int[np.ndarray, "gh gw"]:
        """Component of each cell, from 1; 0 for the floor and where nothing was measured nearby."""
        solid = self.z > 0
        if self.floor is not None:
            height = along(self.points, self.floor[None, :3].astype(np.float32))[..., 0] + np.float32(self.floor[3])
            solid &= height > _FLOOR_TOLERANCE + 0.01 * self.z
        if not solid.any():
            return np.zeros(self.z.shape, np.int64)
        ids = np.arange(self.z.size).reshape(self.z.shape)
        pairs = []
        for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            near = np.abs(self.z[a] - self.z[b]) < 0.08 + 0.02 * np.minimum(self.z[a], self.z[b])
            joined = solid[a] & solid[b] & near
            pairs.append((ids[a][joined], ids[b][joined]))
        i, j = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
        graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(self.z.size, self.z.size))
        labels = connected_components(graph, directed=False)[1].reshape(self.z.shape) + 1
        return self._fill_holes(np.where(solid, labels, 0), self.z > 0)

    @staticmethod
    def _fill_holes(labels: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """Cells without a measurement take the label of the nearest cell that has one, if it is near."""
        distance, (row, col) = distance_transform_edt(~measured, return_indices=True)
        return np.where(distance <= _HOLE, labels[row, col], 0)

    @cached_property
    def components(self) -> list[Component]:
        """Components that could be people, nearest first."""
        rows, cols = np.nonzero((self.labels > 0) & (self.z > 0))
        if not len(rows):
            return []
        names, which, counts = np.unique(self.labels[rows, cols], return_inverse=True, return_counts=True)
        points = self.points[rows, cols]
        side = points[:, 2] / np.float32(self.camera.fx)
        area = np.bincount(which, side**2)
        out = []
        for k in np.flatnonzero((area > 0.05) & (counts > 8)):
            mine = which == k
            (x0, x1), (y0, y1) = np.percentile(points[mine, :2], (1, 99), axis=0).T
            c, r = cols[mine], rows[mine]
            left, right = self.edges_to_color(int(c.min()), int(c.max()))
            top, bottom = self.edges_to_color(int(r.min()), int(r.max()))
            found = Component(
                int(names[k]),
                (left, top, right, bottom),
                float(np.median(points[mine, 2])),
                float(x1 - x0),
                float(y1 - y0),
                float(area[k]),
            )
            if found.could_be_person():
                out.append(found)
        return sorted(out, key=lambda c: c.z)

    @property
    def color_pixels(self) -> float:
        """Colour pixels per cell."""
        return self.cell / self._scale

    def edges_to_color(self, first: int, last: int) -> tuple[float, float]:
        """Outer edges of a run of cells -> colour pixels (one axis)."""
        return first * self.color_pixels - 0.5, (last + 1) * self.color_pixels - 0.5

    def cells_of(self, uv: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour pixels -> (row, column) of their cells, clipped, and whether they are inside."""
        cell = np.floor((np.nan_to_num(uv, nan=-1.0) + 0.5) / self.color_pixels).astype(np.int64)
        limit = np.array(self.z.shape[::-1]) - 1
        inside = ((cell >= 0) & (cell <= limit)).all(1)
        clipped = cell.clip(0, limit)
        return clipped[:, 1], clipped[:, 0], inside

    def to_color(self) -> Float[np.ndarray, "2 3"]:
        """Affine map from cell indices (column, row) to colour pixels."""
        k = self.color_pixels
        return np.array([[k, 0, 0.5 * k - 0.5], [0, k, 0.5 * k - 0.5]])


def _cell_minima(z: np.ndarray, cell: int) -> np.ndarray:
    """Smallest positive value of each cell x cell block, 0 where there is none; border blocks may be partial."""
    far = np.float32(1e9)
    h, w = z.shape
    padded = np.full((-(-h // cell) * cell, -(-w // cell) * cell), far, np.float32)
    np.copyto(padded[:h, :w], z, where=z > 0)
    rows = padded.reshape(-1, cell, padded.shape[1]).min(axis=1)
    out = rows.reshape(len(rows), -1, cell).min(axis=2)
    out[out == far] = 0
    return out


def _is_full_of_gaps(z: np.ndarray) -> bool:
    """Whether many cells (one for every 6 with a value) are empty between two neighbours that are not."""
    has = np.pad(z > 0, 1)
    between = (has[1:-1, :-2] & has[1:-1, 2:]) | (has[:-2, 1:-1] & has[2:, 1:-1])
    return bool(6 * (between & (z == 0)).sum() > (z > 0).sum())


def fit_floor(
    points: Float32[np.ndarray, "gh gw 3"], measured: Bool[np.ndarray, "gh gw"], trials: int = 120
) -> Float[np.ndarray, "4"] | None:
    """The plane that people stand on, by RANSAC over the cells whose surface faces upwards.

    About level (within 45 degrees of the camera's y), below the camera, with next to nothing beneath it. None if there
    is no such plane. Deterministic.
    """
    rng = np.random.default_rng(0)
    upward = points[_faces_up(points, measured)].astype(np.float64)
    everything = points[measured].astype(np.float64)
    if len(upward) < max(60, 0.02 * len(everything)):
        return None
    upward = upward[rng.choice(len(upward), min(len(upward), 800), replace=False)]
    sample = everything[rng.choice(len(everything), min(len(everything), 1500), replace=False)]
    a, b, c = upward[rng.integers(0, len(upward), (3, trials))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    ok = length > 1e-3
    normal = normal[ok] / length[ok, None]
    normal *= -np.sign(normal[:, 1:2] + 1e-12)  # up is -y
    offset = -np.einsum("ij,ij->i", normal, a[ok])
    good = (normal[:, 1] < -0.7) & (offset > 0.3) & (offset < 4.0)
    if not good.any():
        return None
    normal, offset = normal[good], offset[good]
    tolerance = (0.03 + 0.01 * upward[:, 2])[:, None]
    on = np.abs(along(upward, normal) + offset) < tolerance
    beneath = (along(sample, normal) + offset < -3 * (0.03 + 0.01 * sample[:, 2])[:, None]).mean(0)
    support = on.mean(0) - 3 * beneath
    best = int(np.argmax(support))
    if support[best] < 0.2:
        return None
    inliers = upward[on[:, best]]
    refined = plane_normal(inliers)
    refined *= -np.sign(refined[1])
    return np.append(refined, -refined @ inliers.mean(0))


def _faces_up(points: np.ndarray, measured: np.ndarray, step: int = 2) -> np.ndarray:
    """Cells whose surface normal, from the cells `step` away on each side, is within 45 degrees of up (-y)."""
    out = np.zeros(measured.shape, bool)
    if min(measured.shape) <= 2 * step:
        return out
    inner = slice(step, -step)
    across = points[inner, 2 * step :] - points[inner, : -2 * step]
    down = points[2 * step :, inner] - points[: -2 * step, inner]
    normal = np.cross(down, across)  # towards the camera
    known = measured[inner, inner] & measured[inner, 2 * step :] & measured[inner, : -2 * step]
    known &= measured[2 * step :, inner] & measured[: -2 * step, inner]
    out[inner, inner] = known & (normal[..., 1] < -0.7 * np.linalg.norm(normal, axis=-1))
    return out
