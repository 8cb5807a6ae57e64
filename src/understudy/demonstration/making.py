"""One recording -> one demonstration, after another: `Maker`."""

from __future__ import annotations

import hashlib
import json
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import understudy
from understudy import detectors, methods, recordings, runtime
from understudy.demonstration import plots, storage
from understudy.demonstration.build import DemonstrationConfig, build
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.estimator import Estimator
from understudy.files import read_json, write_atomically
from understudy.people_file import PeopleFile
from understudy.pipeline import PEOPLE, OnStep, estimate_recording
from understudy.registration import register

PICTURE: Final = "demonstration.png"
ESTIMATION: Final = "people"
_AT_A_TIME: Final = 2  # frames: more do not make it faster


@dataclass(frozen=True)
class Order:
    """What is to be made of one recording."""

    recording: str
    folder: Path
    """for the demonstration"""
    config: DemonstrationConfig


@dataclass(frozen=True)
class Result:
    """What became of one recording."""

    recording: str
    folder: Path
    demonstration: Demonstration | None
    failed: str | None = None
    """why there is none"""


@dataclass(frozen=True)
class Estimation:
    """How the people of all recordings are estimated: arguments of `pipeline.estimate_recording`."""

    method: str = methods.DEFAULT
    detector: str = "blazepose"
    hands: str = "full"
    weights: Path | None = None
    overlays: bool = False


class Maker:
    """Makes demonstrations; the networks are loaded once."""

    def __init__(self, estimation: Estimation, restart: bool = False):
        """restart: what is there already is made anew."""
        self.estimation, self.restart = estimation, restart
        self._shared: Estimator | None = None

    def make(self, order: Order, step: OnStep = lambda done, frames: None) -> Result:
        """The demonstration that a recording shows, or why there is none; also when something goes wrong that should
        not: many recordings are made while nobody looks.
        """
        try:
            return Result(order.recording, order.folder, self._made(order, step))
        except (UnderstudyError, MissingExtraError) as e:
            why = str(e)
        except Exception as e:
            place = traceback.extract_tb(e.__traceback__)[-1]
            why = f"unexpected {type(e).__name__}: {e} ({Path(place.filename).name}, line {place.lineno})"
        return Result(order.recording, order.folder, None, why)

    def _made(self, order: Order, step: OnStep) -> Demonstration:
        folder, people = order.folder, order.folder / ESTIMATION / PEOPLE
        with recordings.open(order.recording) as recording:
            estimate_recording(
                recording,
                people.parent,
                **vars(self.estimation),
                restart=self.restart,
                step=step,
                threads=min(_AT_A_TIME, runtime.processors()),
                estimator=self._estimator(recording),
            )
            # read back: a run that goes on where another stopped must see the very same (rounded) numbers
            frames = PeopleFile.read(people).frames
            key = _key(people, order.config)
            demo = None if self.restart else _finished(folder, key)
            if demo is None:
                (folder / storage.INFO).unlink(missing_ok=True)
                demo = build(recording, frames, order.config)
                demo.source["key"] = key
                _draw(recording, demo, folder)
                storage.save(folder, demo)
        return demo

    def _estimator(self, recording: recordings.Recording) -> Estimator:
        how = self.estimation
        if self._shared is None:
            detector = detectors.create(how.detector, recording)
            self._shared = Estimator(how.method, detector, weights=how.weights, hands=how.hands)
        elif how.detector == "recording":
            self._shared = self._shared.with_detector(detectors.create(how.detector, recording))
        return self._shared


def _key(people: Path, config: DemonstrationConfig) -> str:
    """Changes when anything does that the demonstration is made from."""
    markers = Path(config.markers).read_bytes() if config.markers else b""
    parts = [people.read_bytes(), markers, json.dumps(asdict(config)).encode(), understudy.__version__.encode()]
    return hashlib.sha256(b"|".join(hashlib.sha256(p).digest() for p in parts)).hexdigest()[:16]


def _finished(folder: Path, key: str) -> Demonstration | None:
    """What an earlier run has made of the same; None if it is damaged: it is made again then."""
    if not (folder / storage.INFO).exists():
        return None
    try:
        source: Any = read_json(folder / storage.INFO).get("source")
        return storage.load(folder) if isinstance(source, dict) and source.get("key") == key else None
    except RecordingError:
        return None


def _draw(recording: recordings.Recording, demo: Demonstration, folder: Path) -> None:
    try:
        write_atomically(folder / PICTURE, picture(recording, demo))
    except MissingExtraError:
        return  # pictures are optional, as matplotlib is


def picture(recording: recordings.Recording | None, demo: Demonstration) -> bytes:
    """`plots.plot` over the frame at which the hand grasps; without a recording, the scene from the side."""
    if recording is None or not len(recording):
        return plots.plot(demo)
    times = recording.timestamps_s or [i / (recording.fps or 1.0) for i in recording.indices]
    grasp = demo.times_s[demo.segments.grasp]
    for position in sorted(range(len(recording)), key=lambda i: abs(times[i] - grasp))[:10]:
        try:
            frame = register(recording[position])
        except RecordingError:
            continue
        return plots.plot(demo, frame.color, frame.camera)
    return plots.plot(demo)
