"""What goes into the paper's network and what becomes of its output. numpy only.

The paper: Zimmermann et al., 3D Human Pose Estimation in RGBD Images for Robotic Task Learning, ICRA 2018.

A cube of 64^3 cells stands about the person's root, axes x, y, z of the colour camera's frame, in metres. Coordinates
in cells: index (i, j, k), an integer at the centre of a cell, so cell 0 reaches from -0.5 to 0.5, and

    metres = origin + (index + 0.5) * cell          index = (metres - origin) / cell - 0.5

where `origin` is the corner of least x, y, z. (The authors' released program places the result of cell i at origin +
i * cell, the cell's corner: half a cell, 2 cm, less on each axis. What its training data did is not published.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Float32

from understudy.camera import Camera
from understudy.lifting import SEEN_SCORE, nearest_depths
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Keypoints2D, RegisteredDepth

SIZE: Final = 64
"""cells along each axis"""
ENLARGED: Final = 1.2
"""factor of the boxes at test time (the paper varies it in training)"""
SCORE_WIDTH: Final = 3.0
"""cells: a score map is exp(-d^2 / SCORE_WIDTH^2)"""
ROOTS: Final = (JOINT["neck"], JOINT["right_hip"], JOINT["left_hip"])
"""joints that can be the root, in order of preference"""

_BOX_MIN = {JOINT["neck"]: (-1.1, -0.4, -1.1)}  # metres from the root: the corner of least x, y, z
_BOX_MIN_HIP = (-1.1, -1.1, -1.1)
_BOX_SIZE = 2.2  # metres, along each axis

# --- root ---


@dataclass(frozen=True, eq=False)
class PaperRoot:
    """The joint about which the grid stands."""

    joint: int
    """row of the skeleton: neck, right hip or left hip"""
    xyz: Float[np.ndarray, "3"]
    """metres, colour camera's frame; on the visible surface"""


def paper_root(keypoints_2d: Keypoints2D, depth: RegisteredDepth, camera: Camera) -> PaperRoot | None:
    """The neck's 2D keypoint at the depth under it (the median of the 3 nearest valid depths); if the neck is not
    visible (2D score > 0.5), the right hip's, then the left hip's. None where there is none.

    A root without 3 valid depths within `lifting.RADIUS` counts as not visible.
    camera: the colour camera.
    """
    roots = np.array(ROOTS)
    visible = keypoints_2d.score[roots] > SEEN_SCORE
    uv = np.where(visible[:, None], keypoints_2d.uv[roots], np.nan)
    xyz = camera.unproject(uv, np.median(nearest_depths(depth, camera, uv), axis=1).astype(np.float64))
    for joint, point in zip(ROOTS, xyz, strict=True):
        if np.isfinite(point).all():
            return PaperRoot(joint, point)
    return None


# --- grid ---


@dataclass(frozen=True, eq=False)
class PaperGrid:
    """The cube of 64^3 cells, in the colour camera's frame."""

    origin: Float[np.ndarray, "3"]
    """metres: the corner of least x, y, z"""
    cell: float
    """metres: edge of a cell"""

    @classmethod
    def around(cls, root: PaperRoot, enlarged: float = ENLARGED) -> PaperGrid:
        """The paper's box: [-1.1, -0.4, -1.1] to [1.1, 1.8, 1.1] m about a neck, +-1.1 m about a hip, times 1.2."""
        low = np.array(_BOX_MIN.get(root.joint, _BOX_MIN_HIP))
        return cls(root.xyz + enlarged * low, enlarged * _BOX_SIZE / SIZE)

    def index(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Metres -> cells; integers are cell centres. Points outside have indices outside [-0.5, 63.5]."""
        return (points - self.origin) / self.cell - 0.5

    def metres(self, index: np.ndarray) -> Float[np.ndarray, "*n 3"]:
        """Cells, whole or not, shape (*n, 3) -> metres."""
        return self.origin + (index + 0.5) * self.cell

    def contains(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether points (metres) lie inside the cube. NaN is outside."""
        inside = (points >= self.origin) & (points < self.origin + SIZE * self.cell)
        return np.asarray(inside.all(axis=-1))


# --- input ---


def pixel_rays(camera: Camera) -> Float32[np.ndarray, "h w 2"]:
    """(X/Z, Y/Z) of every pixel; NaN where the lens model has none. Once per camera, for `depth_points`."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    return camera.normalized(np.stack([u, v], axis=-1)).astype(np.float32)


def depth_points(
    depth: RegisteredDepth, rays: Float32[np.ndarray, "h w 2"] | None = None
) -> Float32[np.ndarray, "n 3"]:
    """The measured points of a depth image: metres, colour camera's frame.

    rays: `pixel_rays(depth.camera)`, where it is at hand.
    """
    xy = pixel_rays(depth.camera) if rays is None else rays
    pixel = np.flatnonzero(depth.z)
    points = np.empty((len(pixel), 3), np.float32)
    points[:, 2] = depth.z.ravel()[pixel]
    points[:, :2] = xy.reshape(-1, 2)[pixel]
    points[:, :2] *= points[:, 2:]
    return points


def occupancy(points: Float[np.ndarray, "n 3"], grid: PaperGrid) -> Float32[np.ndarray, "64 64 64"]:
    """1 in cells (x, y, z) that hold at least one point, else 0. Points outside, or of NaN, do not count."""
    # A rim of one cell takes what is outside: no masks. Rim + cells: 66; truncation is floor, all being positive.
    shift = np.asarray(1 - grid.origin / grid.cell, np.float32)
    scale = np.float32(1 / grid.cell)
    rim = SIZE + 2
    flat = np.zeros(len(points), np.int32)
    for axis in range(3):
        at = np.multiply(points[:, axis], scale, dtype=np.float32)
        at += shift[axis]
        np.fmax(at, np.float32(0), out=at)  # fmax, fmin: NaN becomes the rim
        np.fmin(at, np.float32(rim - 1), out=at)
        flat *= rim
        flat += at.astype(np.int32)
    filled = np.zeros((rim, rim, rim), np.float32)
    filled.reshape(-1)[flat] = 1
    return np.ascontiguousarray(filled[1:-1, 1:-1, 1:-1])


def score_maps(keypoints_2d: Keypoints2D, camera: Camera, root: PaperRoot) -> Float32[np.ndarray, "64 64 18"]:
    """A map over (x, y) for each joint: exp(-d^2 / 3^2), d in cells from the 2D keypoint at the root's depth.

    As in the authors' program the centre is the middle of the keypoint's cell. The map is zero where the 2D score is
    not above 0.5, and where the keypoint lies outside the grid or in its outermost cells.
    """
    grid = PaperGrid.around(root)
    at = np.rint(grid.index(camera.unproject(keypoints_2d.uv, float(root.xyz[2])))[:, :2])
    shown = (keypoints_2d.score > SEEN_SCORE) & ((at > 0) & (at < SIZE - 1)).all(axis=1)
    cells = np.arange(SIZE)[:, None]
    along = np.exp(-(((cells - np.where(shown[:, None], at, 0.0).T[:, None]) / SCORE_WIDTH) ** 2))  # (2, 64, 18)
    maps = along[0][:, None] * along[1][None] * shown
    return maps.astype(np.float32)


def network_input(
    points: Float[np.ndarray, "n 3"], keypoints_2d: Keypoints2D, camera: Camera, root: PaperRoot
) -> Float32[np.ndarray, "64 64 64 19"]:
    """One person's input (x, y, z, channel): occupancy, then the joints' score maps, the same for every z.

    points: metres, colour camera's frame (`depth_points`). camera: the colour camera.
    """
    out = np.empty((SIZE, SIZE, SIZE, 1 + N_JOINTS), np.float32)
    out[..., 0] = occupancy(points, PaperGrid.around(root))
    out[..., 1:] = score_maps(keypoints_2d, camera, root)[:, :, None]
    return out


# --- output ---


def volume_peaks(
    volumes: Float[np.ndarray, "18 64 64 64"], grid: PaperGrid
) -> tuple[Float[np.ndarray, "18 3"], Float[np.ndarray, "18"]]:
    """The largest cell of each joint's score volume [joint, x, y, z]: its centre (metres), and its value, the 3D score.

    Of equal cells the first counts.
    """
    flat = volumes.reshape(N_JOINTS, -1)
    best = flat.argmax(axis=1)
    xyz = grid.metres(np.stack(np.unravel_index(best, volumes.shape[1:]), axis=1).astype(np.float64))
    return xyz, np.take_along_axis(flat, best[:, None], 1)[:, 0].astype(np.float64)


def assemble_paper(
    keypoints_2d: Keypoints2D, camera: Camera, xyz: Float[np.ndarray, "18 3"], score3d: Float[np.ndarray, "18"]
) -> Float[np.ndarray, "18 3"]:
    """The paper's result (metres): where the 2D score exceeds the 3D score, the 2D keypoint back-projected at the
    network's depth; otherwise the network's position. The same where that ray or depth is none.

    xyz, score3d: `volume_peaks`. camera: the colour camera.
    """
    along_ray = camera.unproject(keypoints_2d.uv, xyz[:, 2])
    trusted = (keypoints_2d.score > score3d) & np.isfinite(along_ray).all(axis=1) & (xyz[:, 2] > 0)
    return np.where(trusted[:, None], along_ray, xyz)
