"""Recordings -> a folder of demonstrations. Resumes where it stopped; one recording that fails does not stop the rest.

OUT/NAME/demonstration.json, .npz   what `storage` reads
OUT/NAME/demonstration.png          trajectories over the image, from above, and over time (with matplotlib)
OUT/NAME/people/                    the estimation of its frames (`pipeline`)
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import understudy
from understudy import methods, recordings
from understudy.demonstration import plots, storage
from understudy.demonstration.build import DemonstrationConfig, build
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.people_file import PeopleFile
from understudy.pipeline import PEOPLE, estimate_recording
from understudy.registration import register

PICTURE: Final = "demonstration.png"
ESTIMATION: Final = "people"


@dataclass(frozen=True)
class Result:
    """What became of one recording."""

    recording: str
    folder: Path
    demonstration: Demonstration | None
    failed: str | None = None
    """why there is none"""


def demonstrate(
    paths: Sequence[str | Path],
    out: Path,
    config: DemonstrationConfig | None = None,
    *,
    method: str = methods.DEFAULT,
    detector: str = "blazepose",
    hands: str = "full",
    weights: Path | None = None,
    overlays: bool = False,
    restart: bool = False,
    progress: bool = False,
    report: Callable[[Result], object] = lambda result: None,
) -> list[Result]:
    """Makes a demonstration of each recording, under `out`.

    method, detector, hands, weights, overlays, restart, progress: as in `pipeline.estimate_recording`. What was
    finished with the same settings is not made again. report: called with each result as it comes.
    """
    out, results, config = Path(out), [], config or DemonstrationConfig()
    folders = _folders(paths, out)
    for path, folder in zip(paths, folders, strict=True):
        try:
            with recordings.open(path) as recording:
                estimate_recording(
                    recording,
                    folder / ESTIMATION,
                    method=method,
                    detector=detector,
                    hands=hands,
                    weights=weights,
                    overlays=overlays,
                    restart=restart,
                    progress=progress,
                )
                # read back: a run that goes on where another stopped must see the very same (rounded) numbers
                people = PeopleFile.read(folder / ESTIMATION / PEOPLE)
                key = _key(folder / ESTIMATION / PEOPLE, config)
                demo = None if restart else _finished(folder, key)
                if demo is None:
                    (folder / storage.INFO).unlink(missing_ok=True)
                    demo = build(recording, people.frames, config)
                    demo.source["key"] = key
                    _draw(recording, demo, folder)
                    storage.save(folder, demo)
            result = Result(str(path), folder, demo)
        except UnderstudyError as e:
            result = Result(str(path), folder, None, str(e))
        results.append(result)
        report(result)
    return results


def load_all(paths: Sequence[str | Path]) -> list[Demonstration]:
    """The demonstrations in folders: each is one itself, or holds some. Raises RecordingError if there is none."""
    found: list[Demonstration] = []
    for path in map(Path, paths):
        inner = sorted(p.parent for p in path.glob(f"*/{storage.INFO}"))
        folders = [path] if (path / storage.INFO).exists() else inner
        if not folders:
            raise RecordingError(
                f"{path}: holds no demonstration ({storage.INFO}); `understudy demonstrate` makes them"
            )
        found += [storage.load(folder) for folder in folders]
    return found


def _folders(paths: Sequence[str | Path], out: Path) -> list[Path]:
    """A folder for each recording, by its name; recordings of the same name are told apart by where they lie."""
    names = [Path(p).resolve().stem if Path(p).is_file() else Path(p).resolve().name for p in paths]
    folders = []
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            name = f"{name}_{hashlib.sha256(str(Path(path).resolve()).encode()).hexdigest()[:6]}"
        folders.append(out / name)
    return folders


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
