"""Pictures of the report: the frames that were watched, with what was seen in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt8

from understudy import recordings
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import ESTIMATION
from understudy.errors import RecordingError, UnderstudyError
from understudy.overlay import draw_people
from understudy.people_file import PeopleFile
from understudy.pipeline import PEOPLE
from understudy.registration import register

WIDTH: Final = 480
"""of a frame in the report, pixels"""
_QUALITY: Final = 78


@dataclass(frozen=True)
class Picture:
    """One frame."""

    content: bytes
    """JPEG"""
    size: tuple[int, int]
    caption: str


def watched_frames(folder: Path, demonstration: Demonstration, count: int) -> list[Picture]:
    """Frames with skeletons and hands, evenly over the time, the ones of grasp and release among them.

    folder: of the demonstration. Raises UnderstudyError when the recording is no longer where it was.
    """
    d = demonstration
    people = {f.index: f.people for f in PeopleFile.read(folder / ESTIMATION / PEOPLE).frames if f.skipped is None}
    with recordings.open(str(d.source.get("recording", ""))) as recording:
        rate = recording.fps or 1.0
        times = np.array(recording.timestamps_s or [i / rate for i in recording.indices], float)
        pictures = []
        for position in _chosen(d, times, count):
            index = recording.indices[position]
            try:
                frame = register(recording[position])
            except RecordingError:
                continue
            image = draw_people(frame.color, people.get(index, ()), frame.camera, legend=False)
            caption = f"{times[position] - times[0]:.1f} s, {_segment(d, float(times[position]))}"
            pictures.append(Picture(*jpeg(image), caption))
    if not pictures:
        raise UnderstudyError(f"{recording.path}: no frame can be read")
    return pictures


def jpeg(image: UInt8[np.ndarray, "h w 3"], width: int = WIDTH) -> tuple[bytes, tuple[int, int]]:
    """An RGB image made small enough for the report: content, (width, height)."""
    scale = min(1.0, width / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return data.tobytes(), (small.shape[1], small.shape[0])


def image_size(content: bytes) -> tuple[int, int]:
    """(width, height) of a PNG or JPEG image."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError("an image of the report cannot be decoded")
    return image.shape[1], image.shape[0]


def _chosen(d: Demonstration, times: np.ndarray, count: int) -> list[int]:
    """Positions in the recording: evenly spread, moved to grasp and release where these are nearest."""
    at = np.linspace(d.times_s[0], d.times_s[-1], count)
    if count > 3:
        last = min(d.segments.release, len(d) - 1)
        for moment in (d.times_s[d.segments.grasp], d.times_s[last]):
            at[1 + int(np.argmin(np.abs(at[1:-1] - moment)))] = moment
    return sorted({int(np.argmin(np.abs(times - t))) for t in at})


def _segment(d: Demonstration, time: float) -> str:
    sample = int(np.clip(np.searchsorted(d.times_s, time + 1e-6) - 1, 0, len(d) - 1))
    return next(name for name, part in d.segments.slices(len(d)).items() if part.start <= sample < part.stop)
