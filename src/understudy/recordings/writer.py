"""Writes the recording folder. Each file is written whole or not at all; recording.json comes last.

So a folder whose writing was interrupted has no recording.json, and no reader takes it for complete.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from understudy.camera import RGBDCamera
from understudy.errors import RecordingError, one_of
from understudy.files import write_atomically
from understudy.recordings.folder import COLOR, DEPTH, FORMAT, INFO, KEYPOINTS2D, TRUTH, images_in
from understudy.recordings.keypoints import keypoints2d_to_json
from understudy.recordings.truth import Truth
from understudy.types import Frame, Keypoints2D

COLOR_FORMATS = ("jpg", "png")


class FolderWriter:
    """Writes frames as they come.

    with FolderWriter("OUT", camera, fps=30.0) as writer:
        for frame in frames:
            writer.write(frame)

    Leaving the block completes the folder; leaving it by an exception does not (there is no recording.json then).
    """

    def __init__(
        self,
        path: str | Path,
        camera: RGBDCamera,
        *,
        fps: float | None = None,
        unit_m: float = 0.001,
        color_format: str = "jpg",
        jpeg_quality: int = 95,
        overwrite: bool = False,
    ):
        """`unit_m`: metres per depth value. `overwrite`: a folder that is not empty is refused unless this is set; then
        the recording that is in it is removed first (and nothing else that may lie there)."""
        self.path, self.camera = Path(path), camera
        if color_format not in COLOR_FORMATS:
            raise RecordingError(f"color_format {color_format!r}: must be {one_of(COLOR_FORMATS)}")
        if not 1e-9 < unit_m < 1e3:
            raise RecordingError(f"unit_m must be metres per depth value, above 0, got {unit_m!r}")
        if fps is not None and not (fps > 0 and np.isfinite(fps)):
            raise RecordingError(f"fps must be above 0, got {fps!r}")
        self._fps, self._unit_m = fps, float(unit_m)
        self._color_format, self._jpeg_quality = color_format, jpeg_quality
        self._times: dict[int, float | None] = {}
        self._closed = False
        _make_room(self.path, overwrite)

    def write(self, frame: Frame) -> None:
        """Writes the two images of a frame. Raises RecordingError if it does not fit the frames before it."""
        if self._closed:
            raise RecordingError(f"{self.path}: the recording is complete, no frame can be added")
        if frame.index in self._times or frame.index < 0:
            raise RecordingError(f"{self.path}: frame number {frame.index} is negative or was written before")
        if frame.camera is not self.camera and _camera_to_json(frame.camera) != _camera_to_json(self.camera):
            raise RecordingError(f"{self.path}: frame {frame.index} has another camera than the recording")
        known = next(iter(self._times.values()), frame.timestamp_s)
        if (known is None) != (frame.timestamp_s is None):
            raise RecordingError(f"{self.path}: frame {frame.index}: either all frames have a timestamp or none")
        raw = quantized(frame.depth, self._unit_m, f"{self.path}: frame {frame.index}")
        name, options = f"{frame.index:06d}", []
        if self._color_format == "jpg":
            options = [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality]
        bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
        self._write_image(self.path / COLOR / f"{name}.{self._color_format}", bgr, options)
        self._write_image(self.path / DEPTH / f"{name}.png", raw, [])
        self._times[frame.index] = frame.timestamp_s

    def close(self, truth: Truth | None = None, keypoints2d: Mapping[int, Sequence[Keypoints2D]] | None = None) -> None:
        """Writes truth.json, keypoints2d.json (where given) and, last, recording.json. A second call does nothing."""
        if self._closed:
            return
        if not self._times:
            raise RecordingError(f"{self.path}: a recording needs at least one frame")
        data: dict[str, Any] = {"format": FORMAT}
        if self._fps is not None:
            data["fps"] = float(self._fps)
        times = [self._times[index] for index in sorted(self._times)]
        if times[0] is not None:
            data["timestamps_s"] = times
            if any(not before < after for before, after in pairwise(t for t in times if t is not None)):
                raise RecordingError(f"{self.path}: timestamp_s must ascend with the frame number")
        data |= _camera_to_json(self.camera)
        data["depth"]["unit_m"] = self._unit_m
        if truth is not None:
            _write_json(self.path / TRUTH, truth.to_json())
        if keypoints2d is not None:
            _write_json(self.path / KEYPOINTS2D, keypoints2d_to_json(keypoints2d))
        _write_json(self.path / INFO, data)
        self._closed = True

    def _write_image(self, path: Path, image: np.ndarray, options: list[int]) -> None:
        done, data = cv2.imencode(path.suffix, image, options)
        if not done:
            raise RecordingError(f"{path}: the image cannot be encoded")
        write_atomically(path, data.tobytes())

    def __enter__(self) -> FolderWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if kind is None:
            self.close()


def write_recording(
    path: str | Path,
    frames: Iterable[Frame],
    *,
    truth: Truth | None = None,
    keypoints2d: Mapping[int, Sequence[Keypoints2D]] | None = None,
    **options: Any,
) -> Path:
    """Writes frames (one camera, all with timestamps or none) as a recording folder; `options` are FolderWriter's.

    Frames are taken one at a time. Returns the folder. Raises RecordingError.
    """
    writer = None
    for frame in frames:
        writer = writer or FolderWriter(path, frame.camera, **options)
        writer.write(frame)
    if writer is None:
        raise RecordingError(f"{path}: a recording needs at least one frame")
    writer.close(truth, keypoints2d)
    return writer.path


def quantized(depth: Float32[np.ndarray, "h w"], unit_m: float, where: str) -> UInt16[np.ndarray, "h w"]:
    """Metres -> nearest 16-bit values. Raises RecordingError where they do not fit: a clipped depth is a lie."""
    raw = np.rint(depth.astype(np.float64) / unit_m)
    if raw.max(initial=0) > 65535:
        raise RecordingError(
            f"{where}: a depth of {depth.max():.3f} m does not fit 16 bits at unit_m = {unit_m:g} "
            f"(largest: {65535 * unit_m:.3f} m)"
        )
    return raw.astype(np.uint16)


def _camera_to_json(camera: RGBDCamera) -> dict[str, Any]:
    return {
        "color": camera.color.to_json(),
        "depth": camera.depth.to_json() | {"registered": camera.registered},
        "T_color_depth": camera.T_color_depth.tolist(),
    }


def _write_json(path: Path, data: dict[str, Any]) -> None:
    write_atomically(path, json.dumps(data, allow_nan=False, indent=1))


def _make_room(path: Path, overwrite: bool) -> None:
    if path.exists() and not path.is_dir():
        raise RecordingError(f"{path}: is a file, not a folder")
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            raise RecordingError(f"{path}: the folder is not empty; choose another or allow overwriting")
        for name in (INFO, TRUTH, KEYPOINTS2D):  # recording.json first: from here on the folder is incomplete
            (path / name).unlink(missing_ok=True)
        for name in (COLOR, DEPTH):
            if (path / name).is_dir():
                _remove_images(path / name)
    path.mkdir(parents=True, exist_ok=True)


def _remove_images(folder: Path) -> None:
    for files in images_in(folder).values():
        for file in files:
            file.unlink()
    if not any(folder.iterdir()):
        shutil.rmtree(folder)
