"""One colour image and one depth image, with the camera as plain numbers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from understudy.camera import RGBDCamera
from understudy.errors import CameraError, FrameError, RecordingError
from understudy.recordings.base import Recording
from understudy.recordings.folder import check_size
from understudy.recordings.images import read_color, read_depth, read_size
from understudy.recordings.intrinsics import Numbers, camera_from_numbers


class PairRecording(Recording):
    """A recording of one frame, number 0. Made by `open_pair`: two files cannot be told from one path."""

    format_name = "pair of images"
    looks_for = "nothing: open_pair(color, depth, K) opens it"

    def __init__(self, color: Path, depth: Path, camera: RGBDCamera, unit_m: float):
        self._color, self._depth, self.unit_m = color, depth, unit_m
        super().__init__(color, camera, [0])

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def sources(self, position: int) -> tuple[Path, ...]:
        return self._color, self._depth

    def _read(self, position: int) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "hd wd"]]:
        color, depth = read_color(self._color), read_depth(self._depth)
        check_size(color, self.camera.color, self._color, "its header, when it was opened,")
        check_size(depth, self.camera.depth, self._depth, "its header, when it was opened,")
        return color, depth * np.float32(self.unit_m)


def open_pair(
    color: str | Path,
    depth: str | Path,
    K: Numbers,
    *,
    unit_m: float = 0.001,
    distortion: Numbers = (),
    registered: bool = True,
    depth_K: Numbers | None = None,
    depth_distortion: Numbers = (),
    T_color_depth: Numbers | None = None,
) -> Recording:
    """A recording of one frame from two image files (color: 8-bit; depth: 16-bit PNG of one channel).

    `K`: fx fy cx cy (pixels) or 3x3, of the colour camera; `distortion`: its 0, 4, 5 or 8 coefficients, OpenCV's order.
    `unit_m`: metres per depth value. `registered`: depth lies in the colour camera's pixels, up to a uniform scale; if
    not, `depth_K`, `depth_distortion` and `T_color_depth` (4x4, metres, depth camera -> colour camera) say where.
    Raises RecordingError, FrameError, CameraError.
    """
    color, depth = Path(color), Path(depth)
    if not (unit_m > 0 and math.isfinite(unit_m)):
        raise RecordingError(f"unit_m must be metres per depth value, above 0 (0.001 for millimetres), got {unit_m!r}")
    if not registered and (depth_K is None or T_color_depth is None):
        raise CameraError("depth that is not registered needs depth_K and T_color_depth")
    if registered and T_color_depth is not None:
        raise CameraError("T_color_depth goes with depth that is not registered (registered=False)")
    for path in (color, depth):
        if path.is_dir():
            raise FrameError(f"{path}: is a folder, not an image")
    color_camera = camera_from_numbers(*read_size(color), K, distortion, "K")
    width, height = read_size(depth)
    if depth_K is not None:
        model = distortion if registered and not len(depth_distortion) else depth_distortion
        depth_camera = camera_from_numbers(width, height, depth_K, model, "depth_K")
    else:
        depth_camera = color_camera.resize(width, height)
    try:
        T = np.eye(4) if T_color_depth is None else np.asarray(T_color_depth, dtype=np.float64)
        if T.shape != (4, 4):
            raise CameraError(f"T_color_depth must be a 4x4 rigid transform, got shape {T.shape}")
        return PairRecording(color, depth, RGBDCamera(color_camera, depth_camera, T, registered), unit_m)
    except CameraError:
        raise
    except (TypeError, ValueError) as e:
        raise CameraError(f"T_color_depth must be 4x4 numbers: {e}") from e
