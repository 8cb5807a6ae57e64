"""Every method on the same detections of the same people, with what was lifted kept on disk.

`lift_group` runs; `scores` counts; `comparison_report` writes. What is in the cache is not run again: a file is known
by the recording, the 2D keypoints, and the weights and code of the method.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from understudy.benchmark.methods import NETWORK, Method, fingerprint
from understudy.benchmark.subjects import DETECTIONS, QUALITIES, TRUE, TRUE_VISIBLE, Subjects, number_of, read_subjects
from understudy.errors import UnderstudyError
from understudy.files import write_atomically
from understudy.lifting import Lifter
from understudy.pipeline import signature
from understudy.recordings.base import Recording
from understudy.registration import register
from understudy.skeleton import N_JOINTS
from understudy.types import Keypoints2D, Person

DEGRADED: Final = ("naive", "naive-offset", "mlp", *NETWORK)
"""methods that are run on every quality of 2D keypoints, not only on the detections"""
Key = tuple[str, str]
"""(quality of 2D, method)"""
UPPER_BOUND: Final = (TRUE, TRUE_VISIBLE)


@dataclass(frozen=True, eq=False)
class Lifted:
    """What a method gave for n subjects; rows."""

    keypoints: Float[np.ndarray, "n 18 3"]
    """metres; NaN where not given"""
    confidence: Float[np.ndarray, "n 18"]
    """NaN where not given"""
    sigma_m: Float[np.ndarray, "n 18"]
    failed: Bool[np.ndarray, " n"]
    """no joint at all"""

    @classmethod
    def pooled(cls, parts: Sequence[Lifted]) -> Lifted:
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass(frozen=True, eq=False)
class Group:
    """Recordings that are reported together."""

    title: str
    slug: str
    """begins the names of its plots"""
    names: tuple[str, ...]
    """of the recordings"""
    subjects: Subjects
    lifted: dict[Key, Lifted]

    def rows(self, part: str) -> Bool[np.ndarray, " n"]:
        """Subjects of the recordings whose names hold `part`."""
        numbers = [number_of(name) for name in self.names if part in name]
        return np.isin(self.subjects.recording, numbers)

    @property
    def methods(self) -> tuple[str, ...]:
        """Those that ran on the detections, but for other trainings of the network."""
        return tuple(m for q, m in self.lifted if q == DETECTIONS and not m.startswith(RUN))


RUN: Final = "run "
"""begins the names of other trainings of the network"""


def labels(recordings: Sequence[Recording]) -> list[str]:
    """A name for each: the folder's, with its parent's where two are alike."""
    names = [r.name for r in recordings]
    return [
        f"{r.path.resolve().parent.name}/{n}" if names.count(n) > 1 else n
        for r, n in zip(recordings, names, strict=True)
    ]


def jobs_for(methods: Mapping[str, Method]) -> list[tuple[str, Method]]:
    """Everything on the detections; `DEGRADED` on the other qualities, too."""
    jobs = [(DETECTIONS, method) for method in methods.values()]
    return jobs + [(q, methods[m]) for q in QUALITIES if q != DETECTIONS for m in DEGRADED if m in methods]


def lift_group(
    title: str,
    slug: str,
    recordings: Sequence[Recording],
    methods: Mapping[str, Method],
    cache: Path,
    progress: Callable[[str], object] = lambda text: None,
) -> Group:
    """Runs what is not in the cache."""
    if not recordings:
        raise UnderstudyError(f"{title}: no recordings to compare methods on")
    names = labels(recordings)
    if len(set(names)) < len(names):
        raise UnderstudyError(f"{title}: two recordings are named alike: {names}; their rows could not be told apart")
    jobs = jobs_for(methods)
    subjects: list[Subjects] = []
    lifted: dict[Key, list[Lifted]] = {(quality, method.name): [] for quality, method in jobs}
    for recording, name in zip(recordings, names, strict=True):
        progress(f"{title}: {name}")
        some, results = lift_recording(recording, name, jobs, cache)
        subjects.append(some)
        for key, result in results.items():
            lifted[key].append(result)
    return Group(title, slug, tuple(names), Subjects.pooled(subjects), {k: Lifted.pooled(v) for k, v in lifted.items()})


def lift_recording(
    recording: Recording, name: str, jobs: Sequence[tuple[str, Method]], cache: Path
) -> tuple[Subjects, dict[Key, Lifted]]:
    """Subjects of one recording, and what each job gave for them."""
    files = [path for i in range(len(recording)) for path in recording.sources(i)]
    files += [recording.path / n for n in ("recording.json", "truth.json", "keypoints2d.json")]
    made_from = signature(files)
    folder = cache / f"{_slug(name)}-{made_from}"
    where = folder / f"subjects-{fingerprint(('benchmark/subjects',))}.npz"
    subjects = _load(where, Subjects)
    if subjects is None:
        subjects = read_subjects(recording, name)
        _save(where, subjects)
    rows = {quality: QUALITIES[quality](subjects) for quality in dict.fromkeys(q for q, _ in jobs)}
    paths: dict[Key, Path] = {}
    done: dict[Key, Lifted] = {}
    missing: list[tuple[str, Method]] = []
    for quality, method in jobs:
        key = quality, method.name
        of = hashlib.sha256(rows[quality].tobytes()).hexdigest()[:12]
        paths[key] = folder / f"{_slug(method.name)}-{_slug(quality)}-{of}-{method.key}.npz"
        known = _load(paths[key], Lifted)
        if known is None:
            missing.append((quality, method))
        else:
            done[key] = known
    if missing:
        new = _lift(recording, subjects, rows, missing)
        for key, lifted in new.items():
            _save(paths[key], lifted)
        done |= new
    return subjects, done


def _lift(
    recording: Recording, subjects: Subjects, rows: Mapping[str, np.ndarray], jobs: Sequence[tuple[str, Method]]
) -> dict[Key, Lifted]:
    n = len(subjects.frame)
    out = {
        (quality, method.name): Lifted(
            np.full((n, N_JOINTS, 3), np.nan),
            np.full((n, N_JOINTS), np.nan),
            np.full((n, N_JOINTS), np.nan),
            np.ones(n, bool),
        )
        for quality, method in jobs
    }
    lifters: dict[str, Lifter] = {method.name: method.make() for _, method in jobs}
    for index in dict.fromkeys(subjects.frame.tolist()):
        frame = register(recording.frame(index))
        here = np.flatnonzero(subjects.frame == index)
        for (quality, name), lifted in out.items():
            seen = [Keypoints2D.from_rows(row) for row in rows[quality][here]]
            _fill(lifted, here, lifters[name].lift(frame, seen))
    return out


def _fill(lifted: Lifted, here: np.ndarray, people: Sequence[Person]) -> None:
    for i, person in zip(here, people, strict=True):
        given = np.isfinite(person.keypoints).all(1)
        lifted.keypoints[i] = np.where(given[:, None], person.keypoints, np.nan)
        lifted.confidence[i] = np.where(given, person.confidence, np.nan)
        lifted.sigma_m[i] = np.where(given, person.sigma_m, np.nan)
        lifted.failed[i] = not given.any()


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


Arrays = TypeVar("Arrays", Subjects, Lifted)


def _save(path: Path, arrays: Any) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{f.name: getattr(arrays, f.name) for f in fields(arrays)})
    write_atomically(path, buffer.getvalue())


def _load(path: Path, kind: type[Arrays]) -> Arrays | None:
    """None where there is no such file, or one that was damaged."""
    try:
        with np.load(path) as data:
            return kind(*[data[f.name] for f in fields(kind)])
    except (OSError, ValueError, KeyError, EOFError):
        return None
