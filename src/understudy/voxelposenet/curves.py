"""Pictures of a training run, from the tables in its folder. matplotlib is optional and imported late.

curves.png     loss and error of training, errors and calibration of the validations, over hours
joints.png     error per joint at the last validation, visible and occluded
distance.png   error over the distance between camera and person at the last validation
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from understudy.files import write_atomically
from understudy.plots import require_matplotlib
from understudy.voxelposenet import records

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CURVES: Final = "curves.png"
JOINTS: Final = "joints.png"
DISTANCE: Final = "distance.png"

_COLORS: Final = {"all": "#000000", "visible": "#0072B2", "occluded": "#D55E00", "hard": "#009E73"}


def write(folder: Path) -> list[Path]:
    """Draws what the tables of a run allow, into its folder. Raises MissingExtraError without matplotlib."""
    require_matplotlib()
    made = []
    log, validations = records.read(folder / records.LOG), records.read(folder / records.VALIDATION)
    if log or validations:
        made.append((CURVES, _curves(log, validations)))
    joints, distance = (_last(records.read(folder / records.TABLES[k])) for k in ("joints", "distance"))
    if joints:
        made.append((JOINTS, _joints(joints)))
    if distance:
        made.append((DISTANCE, _distance(distance)))
    for name, figure in made:
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=100)
        write_atomically(folder / name, out.getvalue())
    return [folder / name for name, _ in made]


def _curves(log: Sequence[dict[str, str]], validations: Sequence[dict[str, str]]) -> Figure:
    figure = _figure(12, 7.5, "Training")
    loss, error, held, share = figure.subplots(2, 2, sharex=True).ravel()
    hours = _column(log, "hours")
    loss.plot(hours, _column(log, "loss"), color="black", linewidth=1)
    loss.set(title="loss, mean of the steps since the last line", yscale="log")
    error.plot(hours, 100 * _column(log, "error"), color="black", linewidth=1)
    error.set(title="mean error in training (weights not averaged), cm", yscale="log")
    hours = _column(validations, "hours")
    for name, color in _COLORS.items():
        held.plot(hours, _column(validations, name), color=color, marker=".", label=name)
    held.set(title="mean error in validation, cm", xlabel="hours")
    for name, label in (
        ("auc20", "AUC 0-20 cm"), ("pck10", "within 10 cm"), ("inside_sigma", "inside sigma (0.68)"),
        ("calibration", "calibration error of confidence"), ("swapped", "left and right exchanged"),
    ):  # fmt: skip
        share.plot(hours, _column(validations, name), marker=".", label=label)
    share.axhline(0.68, color="0.6", linewidth=0.8, linestyle=":")
    share.set(title="shares in validation", xlabel="hours", ylim=(0, 1))
    for axes in (loss, error, held, share):
        axes.grid(alpha=0.3)
    held.set_ylim(bottom=0)
    held.legend(fontsize=9)
    share.legend(fontsize=9)
    return figure


def _joints(rows: Sequence[dict[str, str]]) -> Figure:
    figure = _figure(12, 5, f"Error per joint after {rows[0]['step']} steps")
    axes = figure.subplots()
    x = np.arange(len(rows))
    for i, name in enumerate(("visible", "occluded")):
        axes.bar(x + 0.4 * i - 0.2, np.nan_to_num(_column(rows, name)), 0.38, label=name, color=_COLORS[name])
    axes.set_xticks(x, [row["joint"].replace("_", "\n") for row in rows], fontsize=9)
    _errors(axes)
    return figure


def _distance(rows: Sequence[dict[str, str]]) -> Figure:
    figure = _figure(8, 5, f"Error over distance after {rows[0]['step']} steps")
    axes = figure.subplots()
    middle = (_column(rows, "from_m") + _column(rows, "to_m")) / 2
    for name in ("all", "visible", "occluded"):
        axes.plot(middle, _column(rows, name), color=_COLORS[name], marker="o", label=name)
    axes.set_xlabel("distance between camera and person, m")
    _errors(axes)
    return figure


def _errors(axes: Axes) -> None:
    axes.set_ylabel("mean error, cm")
    axes.set_ylim(bottom=0)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend()


def _figure(width: float, height: float, title: str) -> Figure:
    """Inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, fontsize=13)
    return figure


def _column(rows: Sequence[dict[str, str]], name: str) -> np.ndarray:
    """Numbers of a column; NaN where it is empty."""
    return np.array([float(row.get(name) or "nan") for row in rows])


def _last(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Rows of the last validation."""
    return [row for row in rows if row["step"] == rows[-1]["step"]]
