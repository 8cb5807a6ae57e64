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
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2

import understudy
from understudy import detectors, methods
from understudy.errors import DetectorError, FrameError, RecordingError
from understudy.estimator import Estimator
from understudy.files import parse_json, read_json, write_atomically
from understudy.overlay import draw_frame
from understudy.people_file import FramePeople, PeopleFile, frame_from_json, frame_to_json
from understudy.recordings import open as open_recording
from understudy.recordings import write_recording
from understudy.recordings.base import Recording
from understudy.recordings.pair import PairRecording
from understudy.tracking import IdentityTracker
from understudy.types import RegisteredFrame

PEOPLE, CONFIG, OVERLAYS, JOURNAL, PAIR = "people.json", "config.json", "overlays", "journal.jsonl", "pair"
CONFIG_FORMAT = "estimate-config/1"

Report = Callable[[FramePeople, float], object]
"""Called with each frame that was estimated, and the seconds that its estimation took."""


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
    """SHA-256 of a network of one's own; empty for the one that comes with the package"""
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
) -> PeopleFile:
    """Estimates every frame of a recording and writes the folder `out`.

    An interrupted run goes on where it stopped when it is started again with the same settings; frames whose images
    have changed since are estimated again; `restart` begins anew. A frame that cannot be read is listed with `skipped`
    and the reason. `overlays`: also a picture per frame. `progress`: a bar on stderr.
    Raises RecordingError when `out` holds results of other settings, or something that is not ours.
    """
    out = Path(out)
    estimator = Estimator(method, detectors.create(detector, recording), min_score, weights, hands)
    source = (out / PAIR).resolve() if isinstance(recording, PairRecording) else recording.path.resolve()
    reads = _detector_input(recording, detector)
    cameras = recording.camera.to_json()
    own = hashlib.sha256(weights.read_bytes()).hexdigest() if weights else ""
    settings = Settings(str(source), cameras, recording.unit_m, method, detector, reads, min_score, hands, own)
    _prepare(out, settings, restart)
    name = recording.name
    if isinstance(recording, PairRecording):
        recording = _kept(recording, out / PAIR)
    run = _Run(recording, out, estimator, overlays, _read_journal(out / JOURNAL), report)
    try:
        for _ in _bar(run, len(recording), progress):
            pass
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


def signature(files: list[Path] | tuple[Path, ...]) -> str:
    """A word that changes when files are replaced, edited or removed: from their names, sizes and times."""
    parts = []
    for path in files:
        try:
            state = path.stat()
            parts.append(f"{path.name}:{state.st_size}:{state.st_mtime_ns}")
        except OSError:
            parts.append(f"{path.name}:missing")
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:16]


def _kept(pair: PairRecording, folder: Path) -> Recording:
    """The pair as a recording folder beside its results, so that they can be viewed later."""
    state = folder / "made_from.json"
    now = json.dumps([signature(pair.sources(0)), pair.unit_m, pair.camera.to_json()])
    if not (state.exists() and state.read_text() == now):
        write_recording(folder, pair, unit_m=pair.unit_m, color_format="png", overwrite=True)
        write_atomically(state, now)
    return open_recording(folder)


@dataclass(frozen=True)
class _Done:
    """A line of the journal."""

    frame: FramePeople
    made_from: str


class _Run:
    """All frames, one after the other: estimated, or taken from the journal."""

    def __init__(
        self,
        recording: Recording,
        out: Path,
        estimator: Estimator,
        overlays: bool,
        journal: dict[int, _Done],
        report: Report,
    ):
        self.recording, self.out, self.estimator, self.overlays = recording, out, estimator, overlays
        self.results: list[FramePeople] = []
        self._journal, self._report = journal, report
        self._tracker = IdentityTracker()
        vanished = journal.keys() - set(recording.indices)
        if vanished:
            warnings.warn(f"{len(vanished)} frames are no longer in {recording.path}: left out", stacklevel=3)

    def __iter__(self) -> Iterator[FramePeople]:
        """Each result is on disk before the next begins."""
        with (self.out / JOURNAL).open("a", encoding="utf-8") as journal:
            for position, index in enumerate(self.recording.indices):
                made_from = signature(self.recording.sources(position))
                done = self._journal.get(index)
                known = done is not None and done.made_from == made_from and done.frame.skipped is None
                frame = self._taken_over(done.frame, position) if known and done else self._estimated(position)
                if done is None or frame is not done.frame:
                    line = {"made_from": made_from, **frame_to_json(frame)}
                    journal.write(json.dumps(line, allow_nan=False) + "\n")
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
            self._draw(self.estimator.register(self.recording[position]), frame)
        return frame if renamed or frame.timestamp_s != done.timestamp_s else done

    def _estimated(self, position: int) -> FramePeople:
        index = self.recording.indices[position]
        frame = FramePeople(index, (), self._timestamp(position))
        start = time.perf_counter()
        try:
            registered = self.estimator.register(self.recording[position])
            people = self.estimator.estimate(registered)
        except (FrameError, DetectorError) as error:
            self._picture(index).unlink(missing_ok=True)
            return replace(frame, skipped=str(error))
        frame = self._numbered(replace(frame, people=tuple(people)))
        self._report(frame, time.perf_counter() - start)
        if self.overlays:
            self._draw(registered, frame)
        return frame

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


def _read_journal(path: Path) -> dict[int, _Done]:
    """Finished frames by index; of several lines for a frame the last counts."""
    if not path.exists():
        return {}
    *complete, rest = path.read_bytes().split(b"\n")
    done: dict[int, _Done] = {}
    for n, line in enumerate(complete, 1):
        where = f"{path}: line {n}"
        try:
            data = parse_json(line, where)
            frame = frame_from_json(data, where)
        except RecordingError as e:
            raise RecordingError(f"{e}. The journal is damaged; begin anew with --restart") from e
        done[frame.index] = _Done(frame, str(data.get("made_from")))
    if rest:  # a line cut short by a crash
        write_atomically(path, b"\n".join([*complete, b""]))
    return done


def _bar(frames: _Run, total: int, show: bool) -> Iterator[FramePeople]:
    if not show:
        return iter(frames)
    from tqdm import tqdm

    return iter(tqdm(frames, total=total, unit="frame", desc="estimate"))
