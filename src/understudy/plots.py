"""Plots of a benchmark, as PNG bytes. matplotlib is optional and imported late; no global state, no window."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float, Int

from understudy.errors import MissingExtraError
from understudy.metrics import PCK_THRESHOLDS_M, Evaluation
from understudy.metrics.calibration import EXPECTED_WITHIN_SIGMA
from understudy.metrics.joints import PCK_AT_M
from understudy.skeleton import JOINTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Told apart by the colour-blind too; after these the line style changes."""
_LINES: Final = ("-", "--", ":", "-.")
_GREY: Final = "0.45"


def require_matplotlib() -> None:
    """Raises MissingExtraError if it is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as e:
        raise MissingExtraError("Plots", "plots") from e


def pck_curves(evaluations: Mapping[str, Evaluation], title: str) -> bytes:
    """Share of joints within a distance, per method: all, visible and occluded joints. Joints left out are wrong."""
    columns = 2 if max(map(len, evaluations), default=0) <= 14 else 1
    height = 5.4 + 0.2 * max(0, len(evaluations) - 2 * columns)
    figure = _figure(12, height, f"Joints within a distance of the truth: {title}")
    panels = np.atleast_1d(figure.subplots(1, 3, sharey=True))
    for axes, joints in zip(panels, ("all", "visible", "occluded"), strict=True):
        for i, (method, evaluation) in enumerate(evaluations.items()):
            metrics = evaluation.joints[joints]
            if metrics.n_truth:
                label = f"{method}  {metrics.auc:.3f}"
                axes.plot(100 * PCK_THRESHOLDS_M, 100 * metrics.pck_curve, label=label, **_style(i))
        n = max((e.joints[joints].n_truth for e in evaluations.values()), default=0)
        axes.axvline(100 * PCK_AT_M, color=_GREY, linewidth=0.8, linestyle=":")
        axes.set(title=f"{joints} joints (n = {n})", xlabel="distance, cm", xlim=(0, 20), ylim=(0, 100))
        axes.set_xticks(range(0, 21, 5))
        axes.grid(alpha=0.3)
        if axes.lines[:-1]:
            axes.legend(title="method  AUC", loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=9, ncols=columns)
        else:
            axes.text(0.5, 0.5, "no such joints", transform=axes.transAxes, ha="center", color=_GREY)
    panels[0].set_ylabel("joints within the distance, %\n(missed and left out: not within)")
    return _png(figure)


def joint_bars(evaluations: Mapping[str, Evaluation], title: str) -> bytes:
    """Mean error per joint of those that were given, and the share that was given."""
    figure = _figure(12, 6.4, f"Error per joint: {title}")
    errors, shares = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    epe = {m: [100 * e.per_joint[j].epe_m for j in JOINTS] for m, e in evaluations.items()}
    given = {m: [100 * e.per_joint[j].coverage for j in JOINTS] for m, e in evaluations.items()}
    _bars(errors, epe)
    _bars(shares, given)
    errors.set_ylabel("mean error of given joints, cm")
    errors.legend(ncols=min(len(evaluations), 6), loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9, frameon=False)
    errors.set_xlim(-0.6, len(JOINTS) - 0.4)
    shares.set(ylabel="given, %", ylim=(0, 105))
    shares.set_xticks(range(len(JOINTS)), [j.replace("_", "\n") for j in JOINTS], fontsize=9)
    return _png(figure)


def calibration(evaluations: Mapping[str, Evaluation], title: str) -> bytes:
    """Left: confidence against how often it was right. Right: errors within 1 and 2 sigma."""
    figure = _figure(12, 6.2, f"Does the method know its errors: {title}")
    reliability, sigma = figure.subplots(1, 2, width_ratios=[1.2, 1])
    _reliability(reliability, evaluations)
    _sigma(sigma, evaluations)
    return _png(figure)


def pck_over_distance(
    shares: Mapping[str, Float[np.ndarray, " k"]],
    counts: Int[np.ndarray, " k"],
    edges_m: Sequence[float],
    title: str,
) -> bytes:
    """Share of joints within 10 cm, in bins of the person's distance; NaN: no point. Below: joints in each bin."""
    figure = _figure(9, 6.4, f"Joints within 10 cm over the person's distance: {title}")
    curves, bars = figure.subplots(2, 1, sharex=True, height_ratios=[4, 1])
    edges = np.asarray(edges_m)
    centers = (edges[:-1] + edges[1:]) / 2
    for i, (method, share) in enumerate(shares.items()):
        some = ~np.isnan(share)
        curves.plot(centers[some], 100 * share[some], marker="o", markersize=4, label=method, **_style(i))
    curves.set(ylabel="joints within 10 cm, %\n(left out: not within)", ylim=(0, 100))
    curves.grid(alpha=0.3)
    curves.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9)
    bars.bar(centers, counts, np.diff(edges) * 0.9, color=_GREY)
    filled = np.flatnonzero(counts)
    if len(filled):
        bars.set_xlim(edges[filled[0]], edges[filled[-1] + 1])
    bars.set(xlabel="distance of the person from the camera, m", ylabel="joints")
    return _png(figure)


def grouped_bars(
    heights: Mapping[str, Sequence[float]], groups: Sequence[str], label: str, title: str, digits: int = 1
) -> bytes:
    """Groups side by side, one bar per method in each, with its number."""
    figure = _figure(12, 5.4, title)
    axes = figure.subplots()
    _bars(axes, {k: list(v) for k, v in heights.items()}, label_bars=True, digits=digits)
    axes.set_xticks(range(len(groups)), [g.replace(", ", ",\n") for g in groups], fontsize=10)
    axes.set_ylabel(label)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, fontsize=9, frameon=False)
    return _png(figure)


def _reliability(axes: Axes, evaluations: Mapping[str, Evaluation]) -> None:
    axes.plot([0, 100], [0, 100], color=_GREY, linewidth=0.8, linestyle=":")
    for i, (method, evaluation) in enumerate(evaluations.items()):
        c = evaluation.calibration
        if c.n:
            some = c.bin_count > 0
            x, y, n = 100 * c.bin_confidence[some], 100 * c.bin_share[some], c.bin_count[some]
            axes.plot(x, y, label=f"{method}  {100 * c.ece:.1f} %", **_style(i))
            axes.scatter(x, y, s=12 + 150 * n / c.n, color=_style(i)["color"], alpha=0.6, zorder=3)
    axes.set(
        title="Confidence of being within 10 cm (dot size: share of joints)",
        xlabel="mean confidence, %", ylabel="joints within 10 cm, %", xlim=(0, 100), ylim=(0, 100),
    )  # fmt: skip
    axes.text(60, 34, "over-confident", color=_GREY, fontsize=9)
    axes.text(22, 64, "under-confident", color=_GREY, fontsize=9)
    axes.grid(alpha=0.3)
    if len(axes.lines) > 1:
        axes.legend(
            title="method  calibration error", loc="upper center", bbox_to_anchor=(0.5, -0.11), fontsize=9, ncols=2
        )


def _sigma(axes: Axes, evaluations: Mapping[str, Evaluation]) -> None:
    within = {
        m: [100 * e.calibration.within_1_sigma, 100 * e.calibration.within_2_sigma] for m, e in evaluations.items()
    }
    _bars(axes, within, label_bars=True)
    for x, expected in enumerate(EXPECTED_WITHIN_SIGMA):
        label = "what sigma claims (2 sigma: a Gaussian's)" if x == 0 else ""
        axes.hlines(100 * expected, x - 0.44, x + 0.44, color="black", linewidth=1.2, linestyle="--", label=label)
        axes.annotate(f" {100 * expected:.1f}", (x + 0.44, 100 * expected), va="center", fontsize=9)
    axes.set_xlim(-0.5, 1.62)
    axes.set_xticks([0, 1], ["within 1 sigma", "within 2 sigma"])
    axes.set(title="Errors within sigma (bar above its line: sigma too large)", ylabel="joints, %", ylim=(0, 106))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), fontsize=9, ncols=2)


def _bars(axes: Axes, heights: Mapping[str, list[float]], label_bars: bool = False, digits: int = 0) -> None:
    """Groups side by side, one bar per method in each."""
    width = 0.8 / max(len(heights), 1)
    for i, (method, values) in enumerate(heights.items()):
        x = np.arange(len(values)) + (i - (len(heights) - 1) / 2) * width
        bars = axes.bar(x, np.nan_to_num(values), width * 0.92, label=method, color=_style(i)["color"])
        if label_bars:
            texts = ["" if np.isnan(v) else f"{v:.{digits}f}" for v in values]
            turned = 90 if digits and len(heights) > 4 else 0
            axes.bar_label(bars, texts, label_type="center", color="white", fontsize=9, rotation=turned)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)


def _style(i: int) -> dict[str, Any]:
    return {"color": _COLORS[i % len(_COLORS)], "linestyle": _LINES[i // len(_COLORS) % len(_LINES)], "linewidth": 1.8}


def _figure(width: float, height: float, title: str) -> Figure:
    """Inches."""
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, fontsize=13)
    return figure


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()
