"""The recording folder, version 1: recording.json, color/, depth/ and perhaps truth.json and keypoints2d.json.

Where `timestamps_s` is missing and `fps` is there, the timestamps are index / fps; where both are, `timestamps_s`
counts.
"""

from __future__ import annotations

import math
import os
import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from understudy.camera import Camera, RGBDCamera
from understudy.errors import CameraError, FrameError, RecordingError
from understudy.files import read_json
from understudy.recordings.base import Recording
from understudy.recordings.images import read_color, read_depth
from understudy.recordings.keypoints import read_keypoints2d
from understudy.recordings.pairing import checked_times
from understudy.recordings.truth import Truth
from understudy.types import Keypoints2D

FORMAT = "rgbd-recording/1"
INFO, COLOR, DEPTH, TRUTH, KEYPOINTS2D = "recording.json", "color", "depth", "truth.json", "keypoints2d.json"
"""Names inside the folder."""

_IMAGE_NAME = re.compile(r"([0-9]{1,18})\.(?:jpg|png)")


class FolderRecording(Recording):
    """A recording folder."""

    format_name = "recording folder"
    looks_for = "a folder with recording.json, color/ and depth/"

    def __init__(self, path: str | Path):
        """Reads recording.json and the names of the images. Raises RecordingError that names the file and the field."""
        path = Path(path)
        info = path / INFO
        if not info.exists():
            raise RecordingError(f"{info}: no such file (it is written last: was the writing interrupted?)")
        data = read_json(info)
        if data.get("format") != FORMAT:
            raise RecordingError(f"{info}: field 'format' must be {FORMAT!r}, got {data.get('format')!r}")
        camera, self.unit_m = _camera_from_json(data, info)
        self._color, self._depth = images_in(path / COLOR), images_in(path / DEPTH)
        indices = sorted(self._color.keys() | self._depth.keys())
        if not indices:
            raise RecordingError(
                f"{path}: no frames: color/ and depth/ hold no images named like 000000.jpg or 000000.png"
            )
        fps = _fps(data.get("fps"), info)
        times = tuple(i / fps for i in indices) if fps else None
        if data.get("timestamps_s") is not None:
            times = checked_times(data["timestamps_s"], len(indices), f"{info}: field 'timestamps_s'")
        super().__init__(path, camera, indices, times, fps)

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / INFO).is_file() or ((path / COLOR).is_dir() and (path / DEPTH).is_dir())

    def _read(self, position: int) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "hd wd"]]:
        index = self.indices[position]
        for folder, images in ((COLOR, self._color), (DEPTH, self._depth)):
            if index not in images:
                raise FrameError(f"{self.path / folder}: frame {index} has no image here ({index:06d}.png is missing)")
            if len(images[index]) > 1:
                names = " and ".join(p.name for p in images[index])
                raise FrameError(f"{self.path / folder}: frame {index} is there more than once: {names}")
        color_path, depth_path = self._color[index][0], self._depth[index][0]
        color, depth = read_color(color_path), read_depth(depth_path)
        check_size(color, self.camera.color, color_path, f"{INFO}: color")
        check_size(depth, self.camera.depth, depth_path, f"{INFO}: depth")
        return color, depth * np.float32(self.unit_m)

    def sources(self, position: int) -> tuple[Path, ...]:
        index = self.indices[position]
        return (*self._color.get(index, ()), *self._depth.get(index, ()))

    @cached_property
    def truth(self) -> Truth | None:
        path = self.path / TRUTH
        return Truth.read(path) if path.exists() else None

    @cached_property
    def keypoints2d(self) -> dict[int, list[Keypoints2D]] | None:
        path = self.path / KEYPOINTS2D
        return read_keypoints2d(path) if path.exists() else None


def images_in(folder: Path) -> dict[int, list[Path]]:
    """Frame number -> its image files (more than one is the frame's error). Other files are none of our business."""
    try:
        names = sorted(os.listdir(folder))
    except FileNotFoundError as e:
        raise RecordingError(f"{folder}: no such folder") from e
    except OSError as e:
        raise RecordingError(f"{folder}: cannot be read: {e.strerror or e}") from e
    images: dict[int, list[Path]] = {}
    for name in names:
        if match := _IMAGE_NAME.fullmatch(name):
            images.setdefault(int(match[1]), []).append(folder / name)
    return images


def check_size(image: np.ndarray, camera: Camera, path: Path, source: str) -> None:
    """Raises FrameError unless the image is as large as its camera says; `source` names where that is said."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise FrameError(f"{path}: {width} x {height} pixels, but {source} says {camera.width} x {camera.height}")


def _camera_from_json(data: dict[str, Any], info: Path) -> tuple[RGBDCamera, float]:
    """The pair of cameras and the depth unit (metres)."""
    for key in ("color", "depth"):
        if not isinstance(data.get(key), dict):
            raise RecordingError(f"{info}: field {key!r} is missing or not an object")
    registered = data["depth"].get("registered", False)
    if not isinstance(registered, bool):
        raise RecordingError(f"{info}: depth: 'registered' must be true or false, got {registered!r}")
    unit_m = data["depth"].get("unit_m")
    if isinstance(unit_m, bool) or not isinstance(unit_m, int | float) or not 1e-9 < unit_m < 1e3:
        raise RecordingError(
            f"{info}: depth: 'unit_m' must be metres per depth value, above 0 (0.001 for millimetres), got {unit_m!r}"
        )
    T = data.get("T_color_depth")
    if T is None and not registered:
        raise RecordingError(f"{info}: field 'T_color_depth' is missing (only registered depth can do without)")
    color = Camera.from_json(data["color"], f"{info}: color")
    depth = Camera.from_json(data["depth"], f"{info}: depth")
    try:
        with np.errstate(all="ignore"):  # absurd numbers may overflow; they are refused all the same
            T_color_depth = np.eye(4) if T is None else np.array(T, dtype=np.float64)
            if T_color_depth.shape != (4, 4):
                raise CameraError(f"T_color_depth must be a 4x4 rigid transform, got shape {T_color_depth.shape}")
            return RGBDCamera(color, depth, T_color_depth, registered), float(unit_m)
    except (TypeError, ValueError, OverflowError) as e:
        named = any(word in str(e) for word in ("T_color_depth", "depth."))
        raise RecordingError(f"{info}: {e}" if named else f"{info}: T_color_depth: {e}") from e


def _fps(value: Any, info: Path) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (value > 0 and math.isfinite(value)):
        raise RecordingError(f"{info}: field 'fps' must be a number above 0, got {value!r}")
    return float(value)
