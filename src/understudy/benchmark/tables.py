"""A benchmark's rows as text, Markdown and CSV. Units in the heads; '-' where there is nothing to measure."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from understudy.metrics import CLASS_DEFINITIONS, DEFINITION, METRICS, Evaluation, metric_values
from understudy.skeleton import JOINTS


@dataclass(frozen=True, eq=False)
class Row:
    """One method on one recording, or on all of them pooled."""

    recording: str
    method: str
    evaluation: Evaluation
    ms_per_frame: float | None = None
    """wall time of the whole estimation / its frames; None when it was not measured"""

    def values(self) -> dict[str, float]:
        """All metrics by key, and ms_per_frame; NaN where unknown."""
        ms = math.nan if self.ms_per_frame is None else self.ms_per_frame
        return metric_values(self.evaluation) | {MS_PER_FRAME: ms}


@dataclass(frozen=True)
class Column:
    """A column of the short table."""

    head: str
    unit: str
    key: str
    digits: int


MS_PER_FRAME: Final = "ms_per_frame"
MS_DEFINITION: Final = (
    "Wall time per frame, reading its images included: as the estimate reports it (`estimate_into`: the median over "
    "the frames, which leaves out the loading of the networks), else that of the whole recording / its frames."
)

COLUMNS: Final = (
    Column("EPE", "cm", "epe_cm_all", 1),
    Column("visible", "cm", "epe_cm_visible", 1),
    Column("occluded", "cm", "epe_cm_occluded", 1),
    Column("out", "cm", "epe_cm_out_of_view", 1),
    Column("given", "%", "coverage_percent_all", 1),
    Column("PCK@10", "%", "pck10_percent_all", 1),
    Column("AUC", "", "auc_all", 3),
    Column("missed", "", "missed", 0),
    Column("false", "", "false", 0),
    Column("failed", "", "failed", 0),
    Column("swaps", "%", "swapped_percent", 1),
    Column("bones", "deg", "bone_direction_deg", 1),
    Column("time", "ms/frame", MS_PER_FRAME, 1),
)
"""The short table: one line per method, at most 120 characters when the method's name has at most 14."""

PALM_COLUMNS: Final = (
    Column("palms", "", "palms", 0),
    Column("given", "%", "palm_coverage_percent", 1),
    Column("error", "deg", "palm_mean_deg", 1),
    Column("median", "deg", "palm_median_deg", 1),
    Column("within 30 deg", "%", "palm_within_30_percent", 1),
    Column("flipped", "%", "palm_flipped_percent", 1),
)
CALIBRATION_COLUMNS: Final = (
    Column("ECE", "%", "ece_percent", 1),
    Column("within 1 sigma", "%, right: 68", "within_1_sigma_percent", 1),
    Column("within 2 sigma", "%, Gaussian: 99.7", "within_2_sigma_percent", 1),
    Column("flexion", "deg", "flexion_deg", 1),
    Column("ID switches", "", "id_switches", 0),
)

NOTE: Final = (
    "EPE (mean error, by class of joint; out = out of view) is over the joints that a method gave for matched people;\n"
    "'given' is the share it gave. PCK@10 and AUC are over all joints of all people: missed or left out is wrong."
)


def number(value: float, digits: int) -> str:
    """Fixed digits; '-' for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def text_table(rows: Sequence[Row]) -> str:
    """Aligned columns for a terminal: a block per recording, a line per method."""
    blocks = []
    for recording, group in groupby(rows, key=lambda r: r.recording):
        block = list(group)
        cells = [["method", *(c.head for c in COLUMNS)], ["", *(c.unit for c in COLUMNS)]]
        cells += [_cells(row, COLUMNS) for row in block]
        blocks.append(f"{_heading(recording, block[0])}\n{_aligned(cells)}")
    return "\n\n".join([*blocks, NOTE])


def markdown(rows: Sequence[Row], environment: Mapping[str, object], matching: str) -> str:
    """table.md: the short table, palms and calibration per recording, errors per joint, definitions, where it ran."""
    parts = ["# Benchmark"]
    for recording, group in groupby(rows, key=lambda r: r.recording):
        block = list(group)
        parts.append(f"## {_heading(recording, block[0])}")
        parts += [_markdown_table(block, columns) for columns in (COLUMNS, CALIBRATION_COLUMNS)]
        if block[0].evaluation.palms.n_truth:
            parts.append(_markdown_table(block, PALM_COLUMNS))
        parts.append(_joint_table(block))
    parts += ["## What the numbers mean", _definitions(matching), "## Where it ran", environment_lines(environment)]
    return "\n\n".join(parts) + "\n"


def csv_table(rows: Sequence[Row]) -> str:
    """table.csv: a line per recording and method, a column per metric; empty where there is nothing to measure."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["recording", "method", *(m.key for m in METRICS), MS_PER_FRAME])
    for row in rows:
        writer.writerow(
            [row.recording, row.method, *("" if math.isnan(v) else f"{v:.6g}" for v in row.values().values())]
        )
    return out.getvalue()


def _heading(recording: str, row: Row) -> str:
    counts = row.evaluation.counts
    return f"{recording}: {counts.truth_people} people in {counts.frames} frames"


def _cells(row: Row, columns: Iterable[Column]) -> list[str]:
    values = row.values()
    return [row.method, *(number(values[c.key], c.digits) for c in columns)]


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    """First column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ("  ".join([c[0].ljust(widths[0]), *map(str.rjust, c[1:], widths[1:])]) for c in cells)
    return "\n".join(line.rstrip() for line in lines)


def _markdown_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    heads = ["method", *(f"{c.head} {c.unit}".strip() for c in columns)]
    return markdown_lines(heads, [_cells(row, columns) for row in rows])


def markdown_lines(heads: Sequence[str], cells: Iterable[Sequence[str]]) -> str:
    """A Markdown table: first column to the left, the others to the right."""
    rule = ["---", *(["---:"] * (len(heads) - 1))]
    return "\n".join("| " + " | ".join(x.replace("|", "\\|") for x in line) + " |" for line in (heads, rule, *cells))


def _joint_table(rows: Sequence[Row]) -> str:
    """EPE per joint, with the share of the joint that was given."""
    heads = ["joint", *(f"{r.method} EPE cm (given %)" for r in rows)]
    cells = []
    for joint in JOINTS:
        metrics = [r.evaluation.per_joint[joint] for r in rows]
        cells.append(
            [joint.replace("_", " "), *(f"{number(100 * m.epe_m, 1)} ({number(100 * m.coverage, 0)})" for m in metrics)]
        )
    return markdown_lines(heads, cells)


def _definitions(matching: str) -> str:
    """Those of the columns in this file; results.json has all of them."""
    shown = [c.key for c in (*COLUMNS, *CALIBRATION_COLUMNS, *PALM_COLUMNS) if c.key != MS_PER_FRAME]
    metrics = {m.name: m for m in map(DEFINITION.__getitem__, shown)}  # once, not per class of joints
    lines = [f"Matching: {matching}"]
    lines += [f"Classes of joints, {name.replace('_', ' ')}: {text}." for name, text in CLASS_DEFINITIONS.items()]
    lines += [f"{m.name}{f' ({m.unit})' if m.unit else ''}: {m.definition}" for m in metrics.values()]
    lines.append(f"time (ms/frame): {MS_DEFINITION}")
    return "\n".join(f"- {line}" for line in lines)


def environment_lines(environment: Mapping[str, object]) -> str:
    def words(value: object) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{k} {v}" for k, v in value.items() if v is not None)
        return f"`{value}`"

    return "\n".join(f"- {name}: {words(value)}" for name, value in environment.items())
