"""What the viewer shows: a people.json and the recording it was made from, one frame at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from understudy.camera import Camera
from understudy.errors import FrameError, RecordingError
from understudy.files import read_json
from understudy.overlay import draw_people
from understudy.people_file import FramePeople, PeopleFile
from understudy.registration import register
from understudy.types import Person
from understudy.viewer.cloud import Cloud, make_cloud, smaller

if TYPE_CHECKING:
    from understudy.recordings import Recording

OVERLAY_WIDTH = 960
PHOTO_WIDTH = 480


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame, ready to be shown."""

    frame: FramePeople
    cloud: Cloud | None = None
    overlay: UInt8[np.ndarray, "h w 3"] | None = None
    """RGB with the people drawn on it, at most `OVERLAY_WIDTH` wide"""
    photo: UInt8[np.ndarray, "h2 w2 3"] | None = None
    """RGB, at most `PHOTO_WIDTH` wide"""
    problem: str | None = None
    """why there is no picture of the frame; None when there is one"""

    @property
    def lifted(self) -> tuple[Person, ...]:
        """The people who have 3D joints."""
        return tuple(p for p in self.frame.people if p.failed is None and np.isfinite(p.keypoints).any())


@dataclass(frozen=True, eq=False)
class Results:
    """A folder of results and its recording."""

    folder: Path
    people: PeopleFile
    recording: Recording

    @classmethod
    def open(cls, folder: Path, recording: Path | None = None) -> Results:
        """Opens both. `recording` replaces the place that config.json names. Raises RecordingError."""
        from understudy import recordings

        path = folder / "people.json"
        if not path.is_file():
            raise RecordingError(
                f"{folder}: holds no people.json, so there is nothing to view. "
                f"'understudy estimate RECORDING --out {folder}' writes it there (with overlays/ and config.json)"
            )
        people = PeopleFile.read(path)
        if not people.frames:
            raise RecordingError(f"{path}: field 'frames' is empty, so there is nothing to view")
        opened = recordings.open(_recording_path(folder, recording))
        made_with = read_json(folder / "config.json").get("cameras") if (folder / "config.json").is_file() else None
        if made_with is not None and made_with != opened.camera.to_json():
            opened.close()
            raise RecordingError(
                f"{path}: was made from a recording of other cameras than those of {opened.path}; "
                "say which recording it was made from with --recording PATH"
            )
        if not {f.index for f in people.frames} & set(opened.indices):
            opened.close()
            raise RecordingError(
                f"{path}: none of its frames ({people.frames[0].index} ...) is in the recording {opened.path}; "
                "say which recording it was made from with --recording PATH"
            )
        return cls(folder, people, opened)

    @property
    def camera(self) -> Camera:
        """The colour camera."""
        return self.recording.camera.color

    def load(self, position: int) -> Moment:
        """The frame at a position in people.json. What cannot be read becomes a `problem`."""
        frame = self.people.frames[position]
        if frame.skipped is not None:
            return Moment(frame, problem=f"Frame {frame.index} was skipped: {frame.skipped}")
        if frame.index not in self.recording.indices:
            return Moment(frame, problem=f"Frame {frame.index} is not in the recording {self.recording.path}")
        try:
            registered = register(self.recording.frame(frame.index))
        except FrameError as e:
            return Moment(frame, problem=f"Frame {frame.index} cannot be read: {e}")
        overlay = draw_people(registered.color, frame.people, registered.camera)
        return Moment(
            frame, make_cloud(registered), smaller(overlay, OVERLAY_WIDTH), smaller(registered.color, PHOTO_WIDTH)
        )


def _recording_path(folder: Path, given: Path | None) -> Path:
    """Where the recording is. Raises RecordingError if it is not there."""
    if given is not None:
        return given
    say_where = f"Say where the recording is: understudy view {folder} --recording PATH"
    config = folder / "config.json"
    if not config.is_file():
        raise RecordingError(f"{config}: no such file, so the recording is not known. {say_where}")
    named = read_json(config).get("recording")
    if not isinstance(named, str) or not named:
        raise RecordingError(f"{config}: field 'recording' must be a path, got {named!r}. {say_where}")
    if named != "sample" and not Path(named).exists():
        raise RecordingError(f"{config}: the recording is no longer at {named}. {say_where}")
    return Path(named)


class Cache:
    """Moments by position: loaded by one thread of its own, the latest `size` kept."""

    def __init__(self, load: Callable[[int], Moment], size: int = 24):
        self._load, self._size = load, size
        self._kept: OrderedDict[int, Future[Moment]] = OrderedDict()
        self._lock = threading.Lock()
        self._loader = ThreadPoolExecutor(1, thread_name_prefix="understudy-viewer-load")

    def get(self, position: int) -> Moment:
        """The moment; waits until it is loaded."""
        return self.prefetch(position).result()

    def prefetch(self, position: int) -> Future[Moment]:
        """Begins to load a moment, unless it is kept already."""
        with self._lock:
            if position not in self._kept:
                self._kept[position] = self._loader.submit(self._load, position)
            self._kept.move_to_end(position)
            while len(self._kept) > self._size:
                self._kept.popitem(last=False)[1].cancel()
            return self._kept[position]

    def close(self) -> None:
        self._loader.shutdown(wait=True, cancel_futures=True)
