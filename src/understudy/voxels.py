"""The person's view: the voxel grid of the default network, and the way between it and the camera.

A virtual pinhole camera stands where the colour camera stands and looks straight at the person; its frame is called
`view`. The grid has 64 x 64 columns, which are that camera's pixels, and 64 slices along its z. A 2D keypoint is thus
exactly one column, wherever in the image the person is (the paper's metric grid has that only as an orthographic
approximation), and what a surface hides lies exactly behind it in its column.

View coordinates (metres): x = X/Z * root_z and y = Y/Z * root_z, the position scaled to the plane of the root; and
z = Z - root_z. Cells have an edge of `CELL` in these coordinates and begin at -HALF.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from understudy.camera import Camera
from understudy.floor import Floor
from understudy.types import RegisteredDepth

HALF: Final = 1.32
"""metres from the centre of the grid to its sides (the paper's box: 2.2 m times 1.2)"""
CELLS: Final = 64
CELL: Final = 2 * HALF / CELLS
"""edge of a cell, 4.1 cm"""
LIMIT: Final = 1.4
"""metres: depths before or behind the grid are put here, just outside of it"""
EMPTY: Final = 2.0
"""stands in a depth grid for a column without any depth"""
ENOUGH: Final = 110_000
"""points of a frame, see `cloud`"""
_NEAREST_Z = 0.1  # metres: nothing nearer to the camera is measured


@dataclass(frozen=True, eq=False)
class PersonView:
    """Where one person's grid stands in the colour camera's frame."""

    R_view_cam: Float[np.ndarray, "3 3"]
    """the z axis of the view goes through the person; a rotation, or (`mirrored`) one with a reflection"""
    root_z: float
    """metres along that axis to the grid's centre"""

    @classmethod
    def towards(cls, point: Float[np.ndarray, "3"]) -> PersonView:
        """The view whose centre is `point` (metres, colour camera's frame, before the camera)."""
        distance = float(np.linalg.norm(point))
        return cls(rotation_to(point / distance), distance)

    def mirrored(self) -> PersonView:
        """The same in a mirror: x has the other sign everywhere, and left and right look exchanged."""
        return replace(self, R_view_cam=self.R_view_cam * np.array([[-1.0], [1.0], [1.0]]))

    def from_cam(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Colour camera's frame -> view coordinates; NaN for points that are not before the view's camera."""
        p = points @ self.R_view_cam.T
        z = np.where(p[..., 2:] > _NEAREST_Z, p[..., 2:], np.nan)
        return np.concatenate([p[..., :2] / z * self.root_z, z - self.root_z], -1)

    def to_cam(self, view: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """View coordinates -> colour camera's frame, metres."""
        return self.to_view_frame(view) @ self.R_view_cam

    def to_view_frame(self, view: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """View coordinates -> metres in the virtual camera's frame, where lengths are true."""
        z = np.maximum(view[..., 2:] + self.root_z, _NEAREST_Z)
        return np.concatenate([view[..., :2] * (z / self.root_z), z], -1)

    def from_view_frame(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """The inverse of `to_view_frame`."""
        z = np.maximum(points[..., 2:], _NEAREST_Z)
        return np.concatenate([points[..., :2] / z * self.root_z, points[..., 2:] - self.root_z], -1)

    def columns(self, camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """x and y in view coordinates of image points (colour pixels); NaN where the camera has no ray."""
        ray = np.concatenate([camera.normalized(uv), np.ones((len(uv), 1))], 1)
        return self.from_cam(ray * self.root_z)[:, :2]

    def floor_plane(self, floor: Floor | None) -> Float32[np.ndarray, "4"]:
        """(a, b, c, d): a point (x, y, z) of the virtual camera's frame is a x + b y + c z + d metres above the floor.

        Zeros without a floor.
        """
        if floor is None:
            return np.zeros(4, np.float32)
        return np.append(self.R_view_cam @ floor.up, -floor.height).astype(np.float32)

    def depth_grid(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "2 64 64"]:
        """Nearest depth of each column, and farthest one within the grid; rows are y, columns x.

        points: what the camera measured, colour camera's frame, metres. Depths are view z (relative to the root),
        limited to +-LIMIT; `EMPTY` where nothing was measured. One value or a hundred in a column make no difference,
        so that coarse and fine sensors look alike.
        """
        # einsum, not @: see `geometry.along`
        x, y, z = np.einsum("ij,nj->in", self.R_view_cam.astype(points.dtype), points)
        scale = points.dtype.type(self.root_z / CELL)
        edge = z * points.dtype.type(CELLS // 2)
        x, y = x * scale, y * scale
        inside = np.flatnonzero((z > _NEAREST_Z) & (np.abs(x) < edge) & (np.abs(y) < edge))
        x, y, z = x[inside], y[inside], z[inside]
        # a point just inside the grid may be rounded onto its far side
        row, column = (np.minimum((p / z + CELLS // 2).astype(np.int32), CELLS - 1) for p in (y, x))
        column += row * CELLS
        depth = (z - self.root_z).astype(np.float32)
        near = np.full(CELLS * CELLS, EMPTY, np.float32)
        np.minimum.at(near, column, depth.clip(-LIMIT, LIMIT))
        within = np.abs(depth) < HALF
        far = np.full(CELLS * CELLS, -EMPTY, np.float32)
        np.maximum.at(far, column[within], depth[within])
        return np.stack([near, np.where(far > -EMPTY, far, EMPTY)]).reshape(2, CELLS, CELLS)


def cloud(depth: RegisteredDepth, enough: int | None = None) -> Float32[np.ndarray, "n 3"]:
    """Every measured point of a frame, row by row: colour camera's frame, metres; each axis is contiguous in memory.

    enough: where there are more than one and a half times as many, every second one, or third ..., such that about so
    many are left. The grid's columns are 4 cm wide: `ENOUGH` leaves several points in each of those of a person.
    """
    rays = pixel_rays(depth.camera).reshape(2, -1)
    pixel = np.flatnonzero(depth.z.ravel() > 0)
    if enough:
        pixel = pixel[:: max(1, round(len(pixel) / enough))]
    z = depth.z.ravel()[pixel]
    out = np.empty((3, len(z)), np.float32)
    np.multiply(rays[0, pixel], z, out=out[0])
    np.multiply(rays[1, pixel], z, out=out[1])
    out[2] = z
    return out.T


def pixel_rays(camera: Camera) -> Float32[np.ndarray, "2 h w"]:
    """X/Z and Y/Z of every pixel of a camera; computed once."""
    rays = _rays(camera.width, camera.height, camera.K.tobytes(), camera.distortion_model, camera.distortion)
    return rays.reshape(2, camera.height, camera.width)


@lru_cache(maxsize=4)
def _rays(width: int, height: int, K: bytes, model: str, distortion: tuple[float, ...]) -> Float32[np.ndarray, "2 n"]:
    """X/Z and Y/Z of every pixel of a camera, row by row."""
    camera = Camera(width, height, np.frombuffer(K).reshape(3, 3), model, distortion)
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    return np.ascontiguousarray(camera.normalized(np.stack([u.ravel(), v.ravel()], 1)).T, dtype=np.float32)


def rotation_to(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_view_cam: the smallest rotation that takes the unit vector `direction` to the z axis."""
    x, y, z = direction
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])
