"""The benchmark of palm normals as a page: README.md with tables and definitions, and its plots as PNG."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float, Int

from understudy.benchmark.environment import environment
from understudy.benchmark.palms import (
    ALL_GIVEN,
    BOTH,
    CHECKED,
    DEPTH,
    HAND_M,
    LIFTED,
    MAIN,
    PAPER,
    POSTURE,
    WORD,
    PalmScore,
    Source,
    groups,
    score,
)
from understudy.benchmark.tables import environment_lines, markdown_lines, number
from understudy.files import write_atomically
from understudy.hands.estimator import LEAST_CONFIDENCE
from understudy.hands.predictor import weights_path
from understudy.metrics.joints import mean, median
from understudy.plots import _GREY, _figure, _png, _style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOTS: Final = ("errors", "distance", "calibration")
"""Plots of each source: SLUG-NAME.png"""
LEAST: Final = 10
"""hands in a bin: nothing is drawn of fewer"""

_FARTHEST_M = 10.0
_MANY = 500  # hands: of fewer, the bins over distance are 1 m wide, else half as wide
_CURVE_DEG = np.arange(0, 181)

_INTRODUCTION = (
    "Written by `benchmarks/palms.py` (the command is at the end); made anew, not edited. Angles between estimated and "
    "true normals of the palms, in degrees; definitions are at the end."
)
_METHODS = {
    BOTH: f"the default: palms with a confidence below {LEAST_CONFIDENCE:g} are left out.",
    ALL_GIVEN: "the same, nothing left out.",
    DEPTH: f"without the colour image, palms with a confidence below {LEAST_CONFIDENCE:g} left out.",
    POSTURE: "the network without any depth around the hand and without the colour image: what the joints make likely. "
    "Nothing left out.",
    CHECKED: "the colour path's own normal, its quality as confidence; nothing where it finds no palm at the wrist.",
    LIFTED: "the colour path's landmarks of the palm, each at the depth under it, and the plane through them; nothing "
    "where it finds no palm or where fewer than four have depth.",
    PAPER: "our reading of what Zimmermann et al. (ICRA 2018) do, with another network (MediaPipe's): one crop "
    "where the body says that the hand is, no palm detection, nothing checked or left out; left or right is the body's "
    "word; the normal is that of the network's own 3D hand. It has no confidence. The paper reports a mean of 60.3 "
    "degrees on 129 samples of its own, which are not the hands here.",
    WORD: "what the network is told of the colour image, drawn at random with the errors that the colour path was "
    "measured to have; a quarter of the people have none at all. So this is the simulation's input, not a result.",
}
_DEFINITIONS = f"""\
- Hands: true hands in view with a true normal, of people with at least 3 true joints and 1 in view. Those of missed
  people count as not given.
- given: share of the hands for which there is a normal. **All other columns are of the given normals**, so methods
  that give only sure ones look better there; the plot of errors counts a normal that is not given as wrong.
- within 30: error of at most 30 degrees. flipped: error of more than 90 degrees, the palm taken for the back.
- calibration error: mean over 10 bins of the confidence, weighted by hands, of
  |mean confidence - share within 30 degrees|.
- Distance: from the colour camera to the wrist. Size: of {HAND_M:g} m at that distance, in pixels of the colour image
  (recordings) or of the depth camera (simulated hands).
- View: cosine of the angle between the normal and the ray from the camera to the wrist. palm: less than -0.5; back:
  0.5 or more; side: between.
- Visibility: whether the truth calls the wrist occluded (recordings); the share of the hand's surface towards the
  camera which nothing hides (simulated hands).
- A distance or size at a limit belongs to the upper group.
- Time: wall time for both hands of one estimated person, median (and what nine in ten stay below) over the people of
  whom both hands can be looked at; networks warmed up, registration, 2D keypoints and 3D joints not included."""


def write_report(out: Path, sources: Sequence[Source]) -> None:
    """README.md and the plots of every source."""
    parts = ["# Benchmark of palm normals", _INTRODUCTION]
    for source in sources:
        for name, png in draw(source).items():
            write_atomically(out / name, png)
        parts += list(_section(source))
    where = environment() | {"weights": f"{weights_path().name}, SHA-256 {_sha256(weights_path())}"}
    parts += ["## The methods", _methods(sources), "## What the numbers mean", _DEFINITIONS]
    parts += ["## Where it ran", environment_lines(where)]
    write_atomically(out / "README.md", "\n\n".join(parts) + "\n")


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _methods(sources: Sequence[Source]) -> str:
    used = dict.fromkeys(m for source in sources for m in source.said)
    return "\n".join(f"- `{m}`: {_METHODS[m]}" if m in _METHODS else f"- `{m}`" for m in used)


def _section(source: Source) -> Iterator[str]:
    yield f"## {source.title}"
    yield source.about
    yield main_table(source)
    yield _image(source, "errors", "share of hands within an angle")
    yield _image(source, "distance", "error over distance")
    yield _image(source, "calibration", "confidence and how often it is right")
    for method in MAIN:
        if method in source.said:
            yield f"### {source.title}: {method}"
            yield group_table(source, method)
    if times := {m: ms for m, ms in source.ms.items() if m in (BOTH, DEPTH)}:
        yield f"### {source.title}: time"
        cells = [[m, number(half, 1), number(most, 1)] for m, (half, most) in times.items()]
        yield markdown_lines(["method", "both hands of one person, ms", "90 %"], cells)


def _image(source: Source, name: str, text: str) -> str:
    return f"![{source.title}: {text}]({source.slug}-{name}.png)"


# --- tables ---

_HEADS: Final = ("hands", "given %", "mean deg", "median deg", "within 30 deg %", "flipped %", "calibration error %")


def main_table(source: Source) -> str:
    """A line per method."""
    return markdown_lines(["method", *_HEADS], [[m, *_cells(score(source, m))] for m in source.said])


def group_table(source: Source, method: str) -> str:
    """A line per group of hands; groups without hands are left out."""
    lines = [["all", *_cells(score(source, method))]]
    for by, found in groups(source).items():
        for i, label in enumerate(found.labels):
            rows = found.of == i
            if rows.any():
                lines.append([f"{by}: {label}", *_cells(score(source, method, rows))])
    return markdown_lines(["group", *_HEADS], lines)


def _cells(s: PalmScore) -> list[str]:
    degrees = [number(float(np.degrees(a)), 1) for a in (s.mean_rad, s.median_rad)]
    shares = [number(100 * x, 1) for x in (s.within_30_deg, s.flipped, s.calibration.error)]
    return [str(s.n), number(100 * s.coverage, 1), *degrees, *shares]


# --- plots ---


def draw(source: Source) -> dict[str, bytes]:
    """File name -> PNG."""
    drawn = {"errors": _errors(source), "distance": _over_distance(source), "calibration": _calibration(source)}
    return {f"{source.slug}-{name}.png": drawn[name] for name in PLOTS}


def _title(source: Source) -> str:
    return source.title[0].lower() + source.title[1:]


def _errors(source: Source) -> bytes:
    """Share of all hands within an angle of the truth."""
    figure = _figure(11, 5.6, f"Palm normals within an angle of the truth: {_title(source)}")
    axes = figure.subplots()
    for i, method in enumerate(source.said):
        axes.plot(_CURVE_DEG, 100 * within(source.errors(method)), label=method, **_line(i, method))
    for angle in (30, 90):
        axes.axvline(angle, color=_GREY, linewidth=0.8, linestyle=":")
    axes.set(
        xlabel="angle, degrees", xlim=(0, 180), ylim=(0, 100),
        ylabel=f"hands within the angle, % of {len(source.hands.normal)}\n(not given: not within)",
    )  # fmt: skip
    axes.set_xticks(range(0, 181, 30))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9)
    return _png(figure)


def within(errors: Float[np.ndarray, " n"]) -> Float[np.ndarray, "181"]:
    """Share of all n errors (radians; NaN where not given) that are at most 0, 1 ... 180 degrees."""
    given = np.sort(errors[~np.isnan(errors)])
    return np.asarray(np.searchsorted(given, np.radians(_CURVE_DEG) + 1e-9, side="right") / max(len(errors), 1))


def _over_distance(source: Source) -> bytes:
    """Mean and median error of the given normals in bins of the distance; below, the hands in each."""
    figure = _figure(12, 6.6, f"Error of the palm normals over distance: {_title(source)}")
    panels = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=[4, 1])
    distance = source.hands.distance_m
    edges = np.arange(0, _FARTHEST_M + 0.1, 0.5 if len(distance) >= _MANY else 1.0)
    centers, counts = (edges[:-1] + edges[1:]) / 2, np.histogram(distance, edges)[0]
    for axes, bars, (name, reduce) in zip(*panels, (("mean", mean), ("median", median)), strict=True):
        for i, method in enumerate(source.said):
            found = np.degrees(in_bins(distance, source.errors(method), edges, reduce))
            axes.plot(centers, found, marker="o", markersize=4, label=method, **_line(i, method))
        axes.set_title(f"{name} of the given normals (where there are {LEAST} or more)", fontsize=11)
        axes.grid(alpha=0.3)
        bars.bar(centers, counts, np.diff(edges) * 0.9, color=_GREY)
        bars.set(xlabel="distance of the wrist from the camera, m", ylim=(0, 1.35 * max(counts.max(), 1)))
        _label_counts(bars, centers, counts)
    panels[0, 0].set(ylabel="error, degrees", ylim=(0, None))
    panels[1, 0].set_ylabel("hands")
    filled = np.flatnonzero(counts)
    if len(filled):
        panels[1, 0].set_xlim(edges[filled[0]], edges[filled[-1] + 1])
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return _png(figure)


def in_bins(
    distance_m: Float[np.ndarray, " n"],
    errors: Float[np.ndarray, " n"],
    edges_m: Float[np.ndarray, " k"],
    reduce: Callable[[np.ndarray], float],
) -> Float[np.ndarray, " _"]:
    """`reduce` (mean, median) of the given errors in each bin of the distance; NaN of fewer than LEAST."""
    bins = np.digitize(distance_m, edges_m) - 1
    of_bins = (errors[(bins == k) & ~np.isnan(errors)] for k in range(len(edges_m) - 1))
    return np.array([reduce(e) if len(e) >= LEAST else np.nan for e in of_bins])


def _line(i: int, method: str) -> dict[str, Any]:
    """Wide and pale for ALL_GIVEN, on which BOTH often lies."""
    return _style(i) | ({"linewidth": 5.0, "alpha": 0.4, "zorder": 1.5} if method == ALL_GIVEN else {})


def _label_counts(axes: Axes, at: Float[np.ndarray, " k"], counts: Int[np.ndarray, " k"]) -> None:
    for x, n in zip(at, counts, strict=True):
        if n:
            axes.annotate(str(n), (x, n), xytext=(0, 2), textcoords="offset points", ha="center", fontsize=8)


def _calibration(source: Source) -> bytes:
    """Confidence against the share within 30 degrees; below, the hands in each bin.

    BOTH is left out beside ALL_GIVEN, which has the same confidences and more.
    """
    figure = _figure(10, 7.2, f"Confidence of the palm normals: {_title(source)}")
    axes, bars = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1.2])
    axes.plot([0, 100], [0, 100], color=_GREY, linewidth=0.8, linestyle=":")
    shown = {i: m for i, m in enumerate(source.said) if m != BOTH or ALL_GIVEN not in source.said}
    scores = {i: score(source, m).calibration for i, m in shown.items()}
    scores = {i: c for i, c in scores.items() if c.bin_count.any()}
    width = 8.4 / max(len(scores), 1)
    for k, (i, c) in enumerate(scores.items()):
        few, n = c.bin_count < LEAST, c.bin_count
        x, y = (np.where(few, np.nan, 100 * part) for part in (c.bin_confidence, c.bin_share))
        axes.plot(x, y, label=f"{shown[i]}  {100 * c.error:.1f} %", **_style(i))
        axes.scatter(x, y, s=12 + 220 * n / n.sum(), color=_style(i)["color"], alpha=0.6, zorder=3)
        left = 10 * np.arange(len(n)) + 0.8 + k * width
        bars.bar(left, n, width * 0.92, align="edge", color=_style(i)["color"])
    axes.set(ylabel="normals within 30 degrees, %", xlim=(0, 100), ylim=(-3, 103))
    axes.set_title(f"bins with {LEAST} or more hands; dot size: share of the method's hands", fontsize=11)
    axes.text(74, 20, "over-confident", color=_GREY, fontsize=9)
    axes.text(10, 76, "under-confident", color=_GREY, fontsize=9)
    axes.grid(alpha=0.3)
    if scores:
        axes.legend(title="method  calibration error", loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9)
    bars.set(xlabel="confidence (probability of an error of at most 30 degrees), %", ylabel="hands in the bin")
    bars.set_xticks(range(0, 101, 10))
    bars.grid(axis="y", alpha=0.3)
    bars.set_axisbelow(True)
    return _png(figure)
