"""Methods x recordings -> rows of metrics, files and plots."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from understudy.benchmark.environment import environment
from understudy.benchmark.tables import MS_DEFINITION, MS_PER_FRAME, Row, csv_table, markdown, text_table
from understudy.errors import RecordingError, UnderstudyError, one_of
from understudy.files import write_atomically
from understudy.metrics import (
    CLASS_DEFINITIONS,
    DEFAULT_RULE,
    METRICS,
    PCK_THRESHOLDS_M,
    Evaluation,
    JointMetrics,
    MatchRule,
    Observations,
    observe,
)
from understudy.metrics import summarise as summarise_observations
from understudy.people_file import PeopleFile
from understudy.recordings.truth import Truth

FORMAT: Final = "benchmark/1"
ALL: Final = "all recordings"
"""Name of the pooled rows."""


@runtime_checkable
class RecordingWithTruth(Protocol):
    """What a benchmark needs of a recording; what else `estimate` needs is its own affair."""

    @property
    def name(self) -> str: ...

    @property
    def truth(self) -> Truth | None: ...


TABLES = ("table.md", "table.csv", "results.json")
PLOTS = ("pck.png", "joints.png", "calibration.png")
"""Files that `BenchmarkResult.write` writes."""


@dataclass(frozen=True, eq=False)
class Timed:
    """People whose estimation was timed elsewhere, or (None) was not."""

    people: PeopleFile
    ms_per_frame: float | None = None


Estimate = Callable[[Any, str], PeopleFile | Timed]
"""(recording, method) -> its people. The benchmark times the call unless the answer is `Timed`."""


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """What came out."""

    rows: tuple[Row, ...]
    """per recording and method; then, when there are several recordings, per method over all of them pooled (ALL)"""
    rule: MatchRule = DEFAULT_RULE

    @property
    def summary(self) -> tuple[Row, ...]:
        """One row per method: pooled when there are several recordings."""
        return tuple(r for r in self.rows if r.recording == self.rows[-1].recording)

    def table(self) -> str:
        """The short table, for a terminal of 120 columns."""
        return text_table(self.rows)

    def write(self, out: Path, plots: bool = True) -> None:
        """table.md, table.csv, results.json and, if wanted, pck.png, joints.png, calibration.png in a folder."""
        where = environment()
        others = tuple(r for r in self.rows if r not in self.summary)
        write_atomically(out / "table.md", markdown(self.summary + others, where, self.rule.definition))
        write_atomically(out / "table.csv", csv_table(self.rows))
        write_atomically(out / "results.json", json.dumps(self._json(where), allow_nan=False))
        if plots:
            self._plot(out)

    def _plot(self, out: Path) -> None:
        from understudy import plots  # matplotlib is optional

        evaluations = {r.method: r.evaluation for r in self.summary}
        write_atomically(out / "pck.png", plots.pck_curves(evaluations, self.summary[0].recording))
        write_atomically(out / "joints.png", plots.joint_bars(evaluations, self.summary[0].recording))
        write_atomically(out / "calibration.png", plots.calibration(evaluations, self.summary[0].recording))

    def _json(self, where: Mapping[str, object]) -> dict[str, Any]:
        definitions = {m.key: {"name": m.label, "unit": m.unit, "definition": m.definition} for m in METRICS}
        definitions[MS_PER_FRAME] = {"name": "time", "unit": "ms/frame", "definition": MS_DEFINITION}
        return {
            "format": FORMAT,
            **where,
            "matching": self.rule.definition,
            "definitions": definitions,
            "joint_classes": CLASS_DEFINITIONS,
            "pck_thresholds_cm": _numbers(100 * PCK_THRESHOLDS_M),
            "rows": [_row_json(r) for r in self.rows],
        }


def benchmark(
    recordings: Sequence[RecordingWithTruth | Path | str],
    methods: Sequence[str],
    out: Path | None,
    estimate: Estimate,
    *,
    rule: MatchRule = DEFAULT_RULE,
    plots: bool = True,
    progress: Callable[[str], None] = lambda message: None,
) -> BenchmarkResult:
    """Evaluates every method on every recording, writes the tables and plots to the folder `out` (None: nowhere).

    Raises RecordingError for a recording without truth, before anything is estimated.
    """
    if plots and out is not None:
        from understudy.plots import require_matplotlib  # fail now, not after hours of estimating

        require_matplotlib()
    known = _with_truth(recordings)
    if not methods or len(set(methods)) != len(methods):
        raise UnderstudyError(f"methods to compare: give at least one, each once; got {list(methods)}")
    cells: dict[tuple[str, str], _Cell] = {}
    for name, (recording, truth) in known.items():
        for method in methods:
            progress(f"{name}: {method}")
            cells[name, method] = _run(recording, truth, method, estimate, rule)
    rows = [_row(name, method, [cell]) for (name, method), cell in cells.items()]
    if len(known) > 1:
        rows += [_row(ALL, method, [cells[name, method] for name in known]) for method in methods]
    result = BenchmarkResult(tuple(rows), rule)
    if out is not None:
        result.write(out, plots)
    return result


def precomputed(people: Mapping[tuple[str, str], PeopleFile]) -> Estimate:
    """An `estimate` that looks up (recording name, method) -> people that were estimated before; without times."""

    def estimate(recording: RecordingWithTruth, method: str) -> Timed:
        key = (recording.name, method)
        if key not in people:
            raise UnderstudyError(f"no people were estimated for {key}; must be {one_of(map(str, people))}")
        return Timed(people[key])

    return estimate


@dataclass(frozen=True, eq=False)
class _Cell:
    """One recording, one method."""

    observations: Observations
    frames: int
    seconds: float | None


def _with_truth(
    recordings: Sequence[RecordingWithTruth | Path | str],
) -> dict[str, tuple[RecordingWithTruth, Truth]]:
    """Name -> recording and its truth, which is read once."""
    from understudy import recordings as formats  # readers are not needed when recordings are handed over

    known: dict[str, tuple[RecordingWithTruth, Truth]] = {}
    for given in recordings:
        recording = formats.open(given) if isinstance(given, (str, Path)) else given
        truth = recording.truth
        if truth is None:
            path = given if isinstance(given, (str, Path)) else getattr(given, "path", given.name)
            raise RecordingError(
                f"{Path(path) / 'truth.json'}: no such file; a benchmark needs the truth to compare with"
            )
        if recording.name in {*known, ALL}:
            raise RecordingError(f"two recordings are named {recording.name!r}; their rows could not be told apart")
        known[recording.name] = recording, truth
    if not known:
        raise UnderstudyError("no recording to benchmark: give at least one")
    return known


def _run(recording: RecordingWithTruth, truth: Truth, method: str, estimate: Estimate, rule: MatchRule) -> _Cell:
    start = time.perf_counter()
    answer = estimate(recording, method)
    seconds: float | None = time.perf_counter() - start
    people = answer.people if isinstance(answer, Timed) else answer
    frames = len(people.frames)
    if isinstance(answer, Timed):
        seconds = None if answer.ms_per_frame is None else answer.ms_per_frame * frames / 1000
    return _Cell(observe(people.frames, truth, rule), frames, seconds)


def _row(recording: str, method: str, cells: Sequence[_Cell]) -> Row:
    """Joints, people and times pooled."""
    frames = sum(c.frames for c in cells)
    seconds = [c.seconds for c in cells if c.seconds is not None]
    ms = 1000 * sum(seconds) / frames if frames and len(seconds) == len(cells) else None
    return Row(recording, method, summarise_observations(Observations.pooled([c.observations for c in cells])), ms)


def _row_json(row: Row) -> dict[str, Any]:
    e = row.evaluation
    return {
        "recording": row.recording,
        "method": row.method,
        "metrics": {key: _number(value) for key, value in row.values().items()},
        "joints": {name: _joint_json(metrics) for name, metrics in e.per_joint.items()},
        "pck_curves_percent": {name: _numbers(100 * metrics.pck_curve, 3) for name, metrics in e.joints.items()},
        "calibration_bins": _bins_json(e),
    }


def _joint_json(m: JointMetrics) -> dict[str, float | None]:
    return {
        "joints": m.n_truth,
        "epe_cm": _number(100 * m.epe_m),
        "epe_median_cm": _number(100 * m.epe_median_m),
        "coverage_percent": _number(100 * m.coverage),
        "pck10_percent": _number(100 * m.pck),
    }


def _bins_json(e: Evaluation) -> dict[str, list[float | None]]:
    c = e.calibration
    return {
        "confidence": _numbers(c.bin_confidence),
        "within_10cm": _numbers(c.bin_share),
        "joints": _numbers(c.bin_count),
    }


def _number(value: float, digits: int = 6) -> float | None:
    return None if math.isnan(value) else round(float(value), digits)


def _numbers(values: np.ndarray, digits: int = 6) -> list[float | None]:
    return [_number(v, digits) for v in values]
