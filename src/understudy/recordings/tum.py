"""TUM RGB-D sequences: rgb.txt and depth.txt list 'timestamp filename'; depth is in the colour camera's pixels."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from understudy.camera import Camera, RGBDCamera
from understudy.errors import FrameError, RecordingError
from understudy.recordings.base import Recording
from understudy.recordings.folder import check_size
from understudy.recordings.images import read_color, read_depth, read_size
from understudy.recordings.intrinsics import Numbers, camera_from_numbers
from understudy.recordings.pairing import pair_nearest

INTRINSICS = {  # fx fy cx cy, then k1 k2 p1 p2 k3: the colour cameras' calibration as the benchmark publishes it
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""Part of the folder's name -> the camera of that sequence, for images of 640 x 480."""

DEFAULT_K = (525.0, 525.0, 319.5, 239.5)
"""The ROS default for a Kinect v1, 640 x 480; used, with a warning, where nothing better is known."""

UNIT_M = 1 / 5000
"""metres per depth value"""

MAX_DIFFERENCE_S = 0.02
"""farthest apart in time that a colour and a depth image may be to make a frame"""


class TumRecording(Recording):
    """A TUM RGB-D sequence. Frames are the pairs of images, numbered from 0; the colour image's time is the frame's."""

    format_name = "TUM RGB-D sequence"
    looks_for = "a folder with rgb.txt and depth.txt"

    def __init__(self, path: str | Path, K: Numbers | None = None, distortion: Numbers = (), unit_m: float = UNIT_M):
        """`K`: fx fy cx cy or 3x3, with its `distortion` (OpenCV's order); left out, the sequence's published values.

        Images without a partner are left out, counted in `unmatched_color` and `unmatched_depth`, and warned about.
        Raises RecordingError, CameraError.
        """
        path = Path(path)
        color_s, self._color = _read_list(path / "rgb.txt")
        depth_s, self._depth = _read_list(path / "depth.txt")
        self._pairs = pair_nearest(color_s, depth_s, MAX_DIFFERENCE_S)
        if not self._pairs:
            raise RecordingError(
                f"{path}: no frames: no entry of rgb.txt is within {MAX_DIFFERENCE_S} s of one of depth.txt"
            )
        if not (unit_m > 0 and math.isfinite(unit_m)):
            raise RecordingError(f"{path}: unit_m must be metres per depth value, above 0, got {unit_m!r}")
        self.unit_m = unit_m
        self.unmatched_color = len(color_s) - len(self._pairs)
        self.unmatched_depth = len(depth_s) - len(self._pairs)
        if self.unmatched_color or self.unmatched_depth:
            warnings.warn(
                f"{path}: left out for want of a partner within {MAX_DIFFERENCE_S} s: "
                f"{self.unmatched_color} colour and {self.unmatched_depth} depth images",
                stacklevel=2,
            )
        times = [float(color_s[i]) for i, _ in self._pairs]
        fps = 1 / float(np.median(np.diff(times))) if len(times) > 1 else None
        size = _first_size(path, [self._color[i] for i, _ in self._pairs])
        camera = RGBDCamera.aligned(_camera(path, size, K, distortion))
        super().__init__(path, camera, range(len(times)), times, fps)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()

    def _read(self, position: int) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "hd wd"]]:
        i, j = self._pairs[position]
        color, depth = read_color(self._color[i]), read_depth(self._depth[j])
        check_size(color, self.camera.color, self._color[i], "the first image's size")
        check_size(depth, self.camera.depth, self._depth[j], "the first image's size")
        return color, depth * np.float32(self.unit_m)

    def sources(self, position: int) -> tuple[Path, ...]:
        i, j = self._pairs[position]
        return self._color[i], self._depth[j]


def _read_list(path: Path) -> tuple[np.ndarray, list[Path]]:
    """Times (seconds, ascending) and image files of rgb.txt or depth.txt. Raises RecordingError that names the line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise RecordingError(f"{path}: cannot be read: {e}") from e
    entries: list[tuple[float, Path]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time, name = float(words[0]), words[1]
        except (ValueError, IndexError) as e:
            raise RecordingError(f"{path}: line {number}: must be 'timestamp filename', got {line[:60]!r}") from e
        if not math.isfinite(time) or "\0" in name:
            raise RecordingError(f"{path}: line {number}: must be 'timestamp filename', got {line[:60]!r}")
        entries.append((time, path.parent / name))
    entries.sort(key=lambda entry: entry[0])
    times = np.array([time for time, _ in entries], dtype=np.float64)
    repeated = np.flatnonzero(np.diff(times) <= 0)
    if len(repeated):
        raise RecordingError(f"{path}: timestamp {times[repeated[0]]:f} is there twice")
    return times, [file for _, file in entries]


def _first_size(path: Path, images: list[Path]) -> tuple[int, int]:
    """(width, height) of the first image that has a size; a broken one is its own frame's error."""
    for image in images:
        try:
            return read_size(image)
        except FrameError:
            continue
    raise RecordingError(f"{path}: none of the images of rgb.txt can be read, the first is {images[0]}")


def _camera(path: Path, size: tuple[int, int], K: Numbers | None, distortion: Numbers) -> Camera:
    width, height = size
    if K is not None:
        return camera_from_numbers(width, height, K, distortion, f"{path}: option K")
    if len(distortion):
        raise RecordingError(f"{path}: option 'distortion' goes with option 'K': give both or neither")
    if (width, height) != (640, 480):
        raise RecordingError(
            f"{path}: images of {width} x {height} need the option K (the known ones are for 640 x 480)"
        )
    name = path.resolve().name.lower()
    for key, (known_K, known_distortion) in INTRINSICS.items():
        if key in name or f"fr{key[-1]}" in name.replace("-", "_").split("_"):
            return camera_from_numbers(width, height, known_K, known_distortion, key)
    warnings.warn(
        f"{path}: the name says none of {', '.join(INTRINSICS)}: taking fx fy cx cy = {DEFAULT_K}; set the option K",
        stacklevel=3,
    )
    return camera_from_numbers(width, height, DEFAULT_K, (), "default")
