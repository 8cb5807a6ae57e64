"""A whole recording -> a folder of results. Resumes where it stopped; one broken frame does not stop it.

OUT/people.json          people of every frame (docs/people.md)
OUT/config.json          what made it: recording, method, detector, version
OUT/overlays/000000.png  the skeletons on colour and depth, one picture per frame
OUT/people.jsonl         only while unfinished: one line per finished frame
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import understudy
from understudy import detectors
from understudy.benchmark import Timed
from understudy.errors import DetectorError, FrameError, RecordingError
from understudy.estimator import Estimator
from understudy.files import read_json, write_atomically
from understudy.overlay import draw_frame
from understudy.people_file import FramePeople, PeopleFile, frame_from_json, frame_to_json
from understudy.recordings.base import Recording
from understudy.tracking import IdentityTracker
from understudy.types import Frame, Person

PEOPLE, CONFIG, OVERLAYS, JOURNAL = "people.json", "config.json", "overlays", "people.jsonl"


@dataclass(frozen=True)
class Settings:
    """What decides the results; saved beside them. A resumed run must have the same."""

    recording: str
    """absolute path"""
    method: str
    detector: str
    min_score: float
    version: str = understudy.__version__

    def to_json(self) -> dict[str, Any]:
        return {"format": "estimate-config/1", **self.__dict__}


def estimate_recording(
    recording: Recording,
    out: Path,
    *,
    method: str = "naive",
    detector: str = "blazepose",
    min_score: float = 0.2,
    overlays: bool = True,
    restart: bool = False,
    progress: bool = False,
) -> PeopleFile:
    """Estimates every frame of a recording and writes the folder `out`.

    An interrupted run goes on where it stopped when it is started again with the same settings; `restart` begins anew.
    A frame that cannot be read is listed with `skipped` and the reason. `overlays`: also a picture per frame.
    Raises RecordingError when `out` holds results of other settings.
    """
    out = Path(out)
    settings = Settings(str(recording.path.resolve()), method, detector, min_score)
    estimator = Estimator(method, detectors.create(detector, recording), min_score)
    done = _prepare(out, settings, restart)
    run = _Run(recording, out, estimator, overlays, done)
    try:
        for _ in _bar(run.remaining(), len(recording), len(done), progress):
            pass
    finally:  # also when interrupted: what is done can be looked at
        result = PeopleFile(method, recording.name, tuple(run.done[i] for i in recording.indices if i in run.done))
        result.write(out / PEOPLE)
    (out / JOURNAL).unlink(missing_ok=True)
    return result


class _Run:
    """The frames that are still to do, one after the other."""

    def __init__(
        self, recording: Recording, out: Path, estimator: Estimator, overlays: bool, done: dict[int, FramePeople]
    ):
        self.recording, self.out, self.estimator, self.overlays = recording, out, estimator, overlays
        self.done = done
        self._tracker = IdentityTracker()

    def remaining(self) -> Iterator[FramePeople]:
        """Estimates what is missing, in order; each result is on disk before the next begins."""
        with (self.out / JOURNAL).open("a", encoding="utf-8") as journal:
            for position, index in enumerate(self.recording.indices):
                if index in self.done:
                    self._tracker.remember(self.done[index].people)
                    continue
                result = self._frame(position, index)
                journal.write(json.dumps(frame_to_json(result), allow_nan=False) + "\n")
                journal.flush()
                self.done[index] = result
                yield result

    def _frame(self, position: int, index: int) -> FramePeople:
        times = self.recording.timestamps_s
        timestamp = None if times is None else times[position]
        try:
            people = self._people(self.recording[position])
        except (FrameError, DetectorError) as error:
            return FramePeople(index, (), timestamp, skipped=str(error))
        return FramePeople(index, tuple(people), timestamp)

    def _people(self, frame: Frame) -> list[Person]:
        registered = self.estimator.register(frame)
        people = sorted(self._tracker.update(self.estimator.estimate(registered)), key=lambda person: person.id)
        if self.overlays:
            write_png(self.out / OVERLAYS / f"{frame.index:06d}.png", draw_frame(registered, people))
        return people


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes an RGB image as PNG, whole or not at all."""
    ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert ok
    write_atomically(path, data.tobytes())


def _prepare(out: Path, settings: Settings, restart: bool) -> dict[int, FramePeople]:
    """Makes the folder; what an earlier run with the same settings has finished, by frame index."""
    if out.exists() and not out.is_dir():
        raise RecordingError(f"{out}: is a file; --out must name a folder")
    if restart:
        for name in (PEOPLE, JOURNAL, CONFIG):
            (out / name).unlink(missing_ok=True)
        for old in (out / OVERLAYS).glob("[0-9]*.png"):
            old.unlink()
    if (out / CONFIG).exists():
        before, now = read_json(out / CONFIG), settings.to_json()
        different = [k for k in now if before.get(k) != now[k]]
        if different:
            k = different[0]
            raise RecordingError(
                f"{out}: holds results of other settings ({k} was {before.get(k)!r}, is {now[k]!r}). "
                "Choose another folder, or begin anew with --restart"
            )
        return _finished(out)
    if (out / PEOPLE).exists() or (out / JOURNAL).exists():
        raise RecordingError(f"{out}: holds results without {CONFIG}. Choose another folder, or use --restart")
    write_atomically(out / CONFIG, json.dumps(settings.to_json(), indent=1) + "\n")
    return {}


def _finished(out: Path) -> dict[int, FramePeople]:
    done: dict[int, FramePeople] = {}
    if (out / PEOPLE).exists():
        done = {f.index: f for f in PeopleFile.read(out / PEOPLE).frames}
    if (out / JOURNAL).exists():
        lines = (out / JOURNAL).read_bytes().split(b"\n")
        complete = lines[:-1]  # a line cut short by a crash has no end
        for n, line in enumerate(complete, 1):
            where = f"{out / JOURNAL}: line {n}"
            try:
                frame = frame_from_json(json.loads(line), where)
            except ValueError as e:
                raise RecordingError(f"{where}: damaged ({e}). Begin anew with --restart") from e
            done[frame.index] = frame
        if lines[-1]:
            write_atomically(out / JOURNAL, b"\n".join([*complete, b""]))
    return {i: f for i, f in done.items() if f.skipped is None}  # a broken frame gets another chance


def _bar(frames: Iterator[FramePeople], total: int, done: int, show: bool) -> Iterator[FramePeople]:
    if not show:
        return frames
    from tqdm import tqdm

    quiet = os.environ.get("UNDERSTUDY_PROGRESS") == "0"
    return iter(tqdm(frames, total=total, initial=done, unit="frame", desc="estimate", disable=quiet))


def benchmark_estimate(out: Path, detector: str) -> Callable[[Any, str], Timed]:
    """The `estimate` that `benchmark` calls: results go to OUT/RECORDING/METHOD, and an interrupted run goes on."""

    def estimate(recording: Recording, method: str) -> Timed:
        start = time.perf_counter()
        folder = out / recording.name / method
        fresh = not (folder / CONFIG).exists()
        people = estimate_recording(recording, folder, method=method, detector=detector, overlays=False, progress=True)
        ms = 1000 * (time.perf_counter() - start) / max(len(people.frames), 1)
        return Timed(people, ms if fresh else None)

    return estimate
