"""A whole recording -> a folder of results. Resumes where it stopped; one broken frame does not stop it.

    OUT/people.json          people of every frame (docs/people.md)
    OUT/overlays/000000.png  the skeletons on colour and depth, one picture per frame
    OUT/config.json          what made it: recording and its cameras, method, detector, version
    OUT/journal.jsonl        one line per finished frame, and which files it was made from: what a later run builds on
    OUT/pair/                only for a pair of images: the pair, as a recording folder

Ids are given anew over the whole recording each time, from the journal, so that a frame that was mended between two
runs fits in.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import cv2

import understudy
from understudy import detectors, methods
from understudy.ahead import in_order
from understudy.errors import DetectorError, FrameError, RecordingError
from understudy.estimator import Estimator
from understudy.files import read_json, write_atomically
from understudy.journal import Entry, read_journal, signature
from understudy.overlay import draw_frame
from understudy.people_file import FramePeople, PeopleFile
from understudy.recordings import open as open_recording
from understudy.recordings import write_recording
from understudy.recordings.base import Recording
from understudy.recordings.pair import PairRecording
from understudy.tracking import IdentityTracker
from understudy.types import RegisteredFrame
from understudy.voxelposenet.predictor import weights_path

PEOPLE, CONFIG, OVERLAYS, JOURNAL, PAIR = "people.json", "config.json", "overlays", "journal.jsonl", "pair"
CONFIG_FORMAT = "estimate-config/1"

Report = Callable[[FramePeople, float], object]
"""Called with each frame that was estimated, and the seconds that its estimation took (with other frames beside it, if
`threads` says so)."""

OnStep = Callable[[int, int], object]
"""Called before the first frame and after each: how many are done, and how many there are."""


@dataclass(frozen=True)
class Settings:
    """What decides the results; saved beside them as config.json. A resumed run must have the same."""

    recording: str
    """absolute path"""
    cameras: dict[str, Any]
    unit_m: float
    """metres per stored depth value"""
    method: str
    detector: str
    detector_input: str
    """which files a detector reads its keypoints from; empty for others"""
    min_score: float
    hands: str = "full"
    weights: str = ""
    """SHA-256 of the network: results of another one, or of another version's, do not mix with it"""
    version: str = understudy.__version__
    format: str = CONFIG_FORMAT


def estimate_recording(
    recording: Recording,
    out: Path,
    *,
    method: str = methods.DEFAULT,
    detector: str = "blazepose",
    min_score: float = 0.2,
    weights: Path | None = None,
    hands: str = "full",
    overlays: bool = True,
    restart: bool = False,
    progress: bool = False,
    report: Report = lambda frame, seconds: None,
    step: OnStep = lambda done, frames: None,
    threads: int = 1,
    estimator: Estimator | None = None,
) -> PeopleFile:
    """Estimates every frame of a recording and writes the folder `out`.

    An interrupted run goes on where it stopped when it is started again with the same settings; frames whose images
    have changed since are estimated again; `restart` begins anew. A frame that cannot be read is listed with `skipped`
    and the reason. `overlays`: also a picture per frame. `progress`: a bar on stderr. `threads`: frames that are
    estimated at a time; the results are the same. `estimator`: one of the same settings (method to hands) that is there
    already, so that its networks are not loaded again.
    Raises RecordingError when `out` holds results of other settings, or something that is not ours.
    """
    out = Path(out)
    estimator = estimator or Estimator(method, detectors.create(detector, recording), min_score, weights, hands)
    source = (out / PAIR).resolve() if isinstance(recording, PairRecording) else recording.path.resolve()
    reads = _detector_input(recording, detector)
    cameras = recording.camera.to_json()
    network = hashlib.sha256((weights or weights_path()).read_bytes()).hexdigest()
    settings = Settings(str(source), cameras, recording.unit_m, method, detector, reads, min_score, hands, network)
    _prepare(out, settings, restart)
    name = recording.name
    if isinstance(recording, PairRecording):
        recording = _kept(recording, out / PAIR)
    run = _Run(recording, out, estimator, overlays, read_journal(out / JOURNAL), report, threads)
    step(0, len(recording))
    try:
        for done, _ in enumerate(_bar(run, len(recording), progress), 1):
            step(done, len(recording))
    finally:  # also when interrupted: what is done can be looked at
        result = PeopleFile(method, name, run.known())
        result.write(out / PEOPLE)
    return result


def _detector_input(recording: Recording, detector: str) -> str:
    """A word that changes when the files change from which a detector reads precomputed keypoints."""
    kind, _, argument = detector.partition(":")
    if kind == "recording":
        return signature([recording.path / "keypoints2d.json"])
    if kind == "openpose-json":
        folder = Path(argument if Path(argument).is_dir() else argument.rpartition(":")[0])
        return f"{folder.resolve()}: {signature(sorted(folder.glob('*.json')))}"
    return ""


def _kept(pair: PairRecording, folder: Path) -> Recording:
    """The pair as a recording folder beside its results, so that they can be viewed later."""
    state = folder / "made_from.json"
    now = json.dumps([signature(pair.sources(0)), pair.unit_m, pair.camera.to_json()])
    if not (state.exists() and state.read_text() == now):
        write_recording(folder, pair, unit_m=pair.unit_m, color_format="png", overwrite=True)
        write_atomically(state, now)
    return open_recording(folder)


@dataclass(frozen=True, eq=False)
class _Look:
    """A frame, before it is known who of its people is who."""

    frame: FramePeople
    made_from: str
    registered: RegisteredFrame | None = None
    """of a frame that was estimated; None for one that could not be read, or that the journal has"""
    seconds: float = 0.0
    known: bool = False
    """from the journal"""


class _Run:
    """All frames, one after the other: estimated, or taken from the journal."""

    def __init__(
        self,
        recording: Recording,
        out: Path,
        estimator: Estimator,
        overlays: bool,
        journal: dict[int, Entry],
        report: Report,
        threads: int,
    ):
        self.recording, self.out, self.estimator, self.overlays = recording, out, estimator, overlays
        self.results: list[FramePeople] = []
        self._journal, self._report, self._threads = journal, report, threads
        self._tracker = IdentityTracker()
        self._one_reads = Lock()
        vanished = journal.keys() - set(recording.indices)
        if vanished:
            warnings.warn(f"{len(vanished)} frames are no longer in {recording.path}: left out", stacklevel=3)

    def __iter__(self) -> Iterator[FramePeople]:
        """Each result is on disk before the next is there."""
        looks = in_order((partial(self._look, i) for i in range(len(self.recording))), self._threads)
        with (self.out / JOURNAL).open("a", encoding="utf-8") as journal, closing(looks):
            for position, look in enumerate(looks):
                frame = self._taken_over(look.frame, position) if look.known else self._finished(look)
                if not look.known or frame is not look.frame:
                    journal.write(Entry(frame, look.made_from).line())
                    journal.flush()
                self.results.append(frame)
                yield frame

    def known(self) -> tuple[FramePeople, ...]:
        """What there is of every frame: of this run, and from the journal for frames that it has not reached."""
        frames = {i: done.frame for i, done in self._journal.items()} | {f.index: f for f in self.results}
        return tuple(frames[i] for i in self.recording.indices if i in frames)

    def _taken_over(self, done: FramePeople, position: int) -> FramePeople:
        """A finished frame; drawn again only if its picture is missing or its people have got other ids."""
        frame = self._numbered(replace(done, timestamp_s=self._timestamp(position)))
        renamed = [p.id for p in frame.people] != [p.id for p in done.people] or any(
            p.keypoints_2d is not q.keypoints_2d for p, q in zip(frame.people, done.people, strict=True)
        )
        if self.overlays and (renamed or not self._picture(frame.index).exists()):
            self._draw(self._registered(position), frame)
        return frame if renamed or frame.timestamp_s != done.timestamp_s else done

    def _look(self, position: int) -> _Look:
        """Runs in several threads at once."""
        made_from = signature(self.recording.sources(position))
        done = self._journal.get(self.recording.indices[position])
        if done is not None and done.made_from == made_from and done.frame.skipped is None:
            return _Look(done.frame, made_from, known=True)
        frame = FramePeople(self.recording.indices[position], (), self._timestamp(position))
        start = time.perf_counter()
        try:
            registered = self._registered(position)
            people = self.estimator.estimate(registered)
        except (FrameError, DetectorError) as error:
            return _Look(replace(frame, skipped=str(error)), made_from)
        return _Look(replace(frame, people=tuple(people)), made_from, registered, time.perf_counter() - start)

    def _finished(self, look: _Look) -> FramePeople:
        if look.registered is None:
            self._picture(look.frame.index).unlink(missing_ok=True)
            return look.frame
        frame = self._numbered(look.frame)
        self._report(frame, look.seconds)
        if self.overlays:
            self._draw(look.registered, frame)
        return frame

    def _registered(self, position: int) -> RegisteredFrame:
        with self._one_reads:  # a recording need not be readable from several threads
            frame = self.recording[position]
        return self.estimator.register(frame)

    def _timestamp(self, position: int) -> float | None:
        times = self.recording.timestamps_s
        return None if times is None else times[position]

    def _numbered(self, frame: FramePeople) -> FramePeople:
        """With ids that stay with people, in their order."""
        people = self._tracker.update(frame.people, frame.timestamp_s)
        return replace(frame, people=tuple(sorted(people, key=lambda person: person.id)))

    def _picture(self, index: int) -> Path:
        return self.out / OVERLAYS / f"{index:06d}.png"

    def _draw(self, registered: RegisteredFrame, frame: FramePeople) -> None:
        image = cv2.cvtColor(draw_frame(registered, frame.people), cv2.COLOR_RGB2BGR)
        ok, data = cv2.imencode(".png", image)
        assert ok
        write_atomically(self._picture(frame.index), data.tobytes())


def _prepare(out: Path, settings: Settings, restart: bool) -> None:
    """Makes the folder, or makes sure that it holds results of the same settings (`restart`: of any)."""
    if out.exists() and not out.is_dir():
        raise RecordingError(f"{out}: is a file; the results need a folder")
    ours = _is_ours(out)
    if ours and restart:
        for name in (PEOPLE, JOURNAL):
            (out / name).unlink(missing_ok=True)
        for old in (out / OVERLAYS).glob("*.png"):
            if re.fullmatch(r"\d{6,}\.png", old.name):
                old.unlink()
    elif ours:
        before, now = read_json(out / CONFIG), json.loads(json.dumps(asdict(settings)))
        different = [k for k in now if before.get(k) != now[k]]
        if different:
            k = different[0]
            was = "" if isinstance(now[k], dict) else f": {before.get(k)!r} then, {now[k]!r} now"
            raise RecordingError(
                f"{out}: holds results of other settings ({k} differs{was}). "
                "Choose another folder, or begin anew with --restart"
            )
    write_atomically(out / CONFIG, json.dumps(asdict(settings), indent=1) + "\n")


def _is_ours(out: Path) -> bool:
    """Whether the folder holds results of ours; raises RecordingError if it holds files that would be in the way."""
    if (out / CONFIG).exists() and read_json(out / CONFIG).get("format") == CONFIG_FORMAT:
        return True
    in_the_way = [name for name in (CONFIG, PEOPLE, JOURNAL, OVERLAYS, PAIR) if (out / name).exists()]
    if in_the_way:
        raise RecordingError(
            f"{out}: holds {in_the_way[0]}, which `understudy estimate` did not write there. Choose another folder"
        )
    return False


def _bar(frames: _Run, total: int, show: bool) -> Iterator[FramePeople]:
    if not show:
        return iter(frames)
    from tqdm import tqdm

    return iter(tqdm(frames, total=total, unit="frame", desc="estimate"))
