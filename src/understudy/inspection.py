"""What is in a recording, in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sized

from understudy.camera import Camera
from understudy.errors import FrameError, RecordingError
from understudy.recordings.base import Recording


def describe(recording: Recording) -> str:
    """A few lines for a person to read. Opens no image."""
    camera = recording.camera
    t = recording.timestamps_s
    clock = "no clock" if not t else f"{t[0]:g} s to {t[-1]:g} s"
    rate = "unknown" if recording.fps is None else f"{recording.fps:g} fps"
    numbers = f"{recording.indices[0]} to {recording.indices[-1]}" if recording.indices else "none"
    lines = [
        f"{recording.path} ({recording.format_name})",
        f"  frames      {len(recording)} (numbers {numbers}), {rate}, {clock}",
        f"  color       {_camera(camera.color)}",
        f"  depth       {_camera(camera.depth)}",
    ]
    if camera.registered:
        lines.append("  registered  yes: depth lies in the colour camera's pixels")
    else:
        x, y, z = camera.T_color_depth[:3, 3] * 1000
        lines.append(f"  registered  no: depth camera at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the colour camera's frame")
    lines.append("  truth       " + _frames(lambda: None if (truth := recording.truth) is None else truth.frames))
    lines.append("  keypoints2d " + _frames(lambda: recording.keypoints2d))
    return "\n".join(lines)


def _frames(read: Callable[[], Sized | None]) -> str:
    try:
        frames = read()
    except RecordingError as e:
        return f"cannot be read: {e}"
    return "none" if frames is None else f"{len(frames)} frames"


def check(recording: Recording, progress: bool = False) -> list[tuple[int, FrameError]]:
    """Reads every frame; the numbers and errors of those that are broken."""
    from tqdm import tqdm

    broken: list[tuple[int, FrameError]] = []
    with tqdm(total=len(recording), unit="frame", desc="check", disable=not progress) as bar:

        def report(index: int, error: FrameError) -> None:
            broken.append((index, error))
            bar.update()

        for _ in recording.frames(report):
            bar.update()
    return broken


def _camera(camera: Camera) -> str:
    fov = math.degrees(2 * math.atan(camera.width / 2 / camera.fx))
    lens = "" if not camera.distorted else f", {camera.distortion_model}"
    return (
        f"{camera.width} x {camera.height}, fx {camera.fx:.1f} fy {camera.fy:.1f} "
        f"cx {camera.cx:.1f} cy {camera.cy:.1f}{lens}, {fov:.0f} degrees across"
    )
