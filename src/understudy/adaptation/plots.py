"""Pictures of an adaptation, as PNG bytes: from above, from the side, energies over time, metrics before and after."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

from understudy.adaptation import prepare
from understudy.adaptation.metrics import ROWS, Metrics
from understudy.adaptation.platform import Platform
from understudy.adaptation.result import AdaptationResult, Adapted
from understudy.demonstration.demonstration import FREE, OCCUPIED, Demonstration, OccupancyMap
from understudy.plots import require_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TEACHER: Final = "#D55E00"
_ROBOT: Final = "#0072B2"
_OBJECT: Final = "#009E73"
_KINDS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
_FOOTPRINTS: Final = 7  # drawn along a path
_AROUND_M: Final = 0.5
_HEADROOM: Final = 300  # above the curves, for the legend
_LEAST_SHARE: Final = 1e-3  # of the greatest energy: kinds below are not drawn


def pictures(
    demonstrations: Sequence[Demonstration],
    result: AdaptationResult,
    robot: Platform,
    metrics: Mapping[str, Metrics] | None = None,
) -> dict[str, bytes]:
    """File name -> PNG. One picture per demonstration; one of the metrics, when given."""
    out = {
        f"{i:03d}.png": trajectories(d, a, result, robot)
        for i, (d, a) in enumerate(zip(demonstrations, result.demonstrations, strict=True))
    }
    if metrics is not None:
        out["metrics.png"] = comparison({result.task: metrics})
    return out


def trajectories(d: Demonstration, a: Adapted, result: AdaptationResult, robot: Platform) -> bytes:
    """Teacher and robot from above and from the side, and what was bent when."""
    figure = _figure(13, 7.6, f"{d.task}: adapted to {result.robot}")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1])
    _above(figure.add_subplot(grid[:, 0]), d, a, result, robot)
    _side(figure.add_subplot(grid[0, 1]), d, a, result)
    _energies(figure.add_subplot(grid[1, 1]), d, a)
    return _png(figure)


def comparison(results: Mapping[str, Mapping[str, Metrics]]) -> bytes:
    """The ten rows, before and after, per task."""
    figure = _figure(14, 5.6, "Before and after adaptation")
    panels = figure.subplots(2, 5).ravel()
    for axes, (name, words) in zip(panels, ROWS.items(), strict=True):
        for shift, (when, color) in zip((-0.2, 0.2), (("before", _TEACHER), ("after", _ROBOT)), strict=True):
            values = [getattr(pair[when], name) for pair in results.values()]
            axes.bar(np.arange(len(values)) + shift, values, 0.38, color=color, label=when)
        axes.set_title(words, fontsize=9)
        axes.set_xticks(range(len(results)), [task.replace("_", "\n") for task in results], fontsize=8)
        axes.grid(axis="y", alpha=0.3)
    panels[0].legend(fontsize=8)
    return _png(figure)


def _above(axes: Axes, d: Demonstration, a: Adapted, result: AdaptationResult, robot: Platform) -> None:
    _map(axes, d.map)
    hand, _ = prepare.hand_targets(d, result.calibration.hand_tool(d.acting))
    object = prepare.object_path(d)
    axes.plot(*d.torso.xy_yaw[:, :2].T, ".", color=_TEACHER, markersize=3, label="teacher's torso")
    axes.plot(*hand[:, :2, 3].T, "x", color=_TEACHER, markersize=4, markeredgewidth=0.8, label="teacher's hand (H X)")
    axes.plot(*object[:, :2, 3].T, color=_OBJECT, linewidth=3, alpha=0.6, label="object")
    panel = prepare.panel_path(d, object)
    for k in (d.segments.grasp, min(d.segments.release, len(d)) - 1):
        axes.plot(*panel[k].T, color=_OBJECT, linewidth=1.5, linestyle=":")
    axes.plot(*a.base[:, :2].T, color=_ROBOT, linewidth=1.2, linestyle="--", label="base")
    axes.plot(*a.T_world_tool[:, :2, 3].T, color=_ROBOT, linewidth=1.5, label="gripper")
    for k in np.unique(np.linspace(0, len(a.base) - 1, _FOOTPRINTS).round().astype(int)):
        _footprint(axes, robot.footprint, a.base[k], good=bool(a.collision_free[k]))
    failed = ~a.achievable
    if failed.any():
        axes.plot(*a.T_world_tool[failed, :2, 3].T, "o", color="red", markersize=5, label="not achievable")
    everything = np.concatenate([a.base[:, :2], a.T_world_tool[:, :2, 3], object[:, :2, 3]])
    low, high = everything.min(axis=0) - _AROUND_M, everything.max(axis=0) + _AROUND_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.set_title("from above (grey: not known; dark: occupied)", fontsize=10)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, frameon=False)


def _map(axes: Axes, map: OccupancyMap) -> None:
    shade = np.where(map.state == OCCUPIED, 0.35, np.where(map.state == FREE, 1.0, 0.88))
    h, w = shade.shape
    x, y = map.origin_xy - map.resolution_m / 2
    extent = (x, x + w * map.resolution_m, y, y + h * map.resolution_m)
    axes.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, interpolation="nearest")


def _footprint(axes: Axes, polygon: Float[np.ndarray, "k 2"], base: Float[np.ndarray, "3"], good: bool) -> None:
    c, s = np.cos(base[2]), np.sin(base[2])
    corners = np.vstack([polygon, polygon[:1]]) @ np.array([[c, s], [-s, c]]) + base[:2]
    axes.plot(*corners.T, color=_ROBOT if good else "red", linewidth=0.8, alpha=0.7)
    front = base[:2] + 0.8 * np.abs(polygon).max() * np.array([c, s])
    axes.plot([base[0], front[0]], [base[1], front[1]], color=_ROBOT, linewidth=0.8, alpha=0.7)


def _side(axes: Axes, d: Demonstration, a: Adapted, result: AdaptationResult) -> None:
    """Across the direction in which the gripper moves most: heights are the point."""
    hand, _ = prepare.hand_targets(d, result.calibration.hand_tool(d.acting))
    p = a.T_world_tool[:, :3, 3]
    along = np.linalg.svd(p[:, :2] - p[:, :2].mean(axis=0), full_matrices=False)[2][0]
    object = prepare.object_path(d)
    axes.plot(hand[:, :2, 3] @ along, hand[:, 2, 3], "x", color=_TEACHER, markersize=4, markeredgewidth=0.8)
    axes.plot(object[:, :2, 3] @ along, object[:, 2, 3], color=_OBJECT, linewidth=3, alpha=0.6)
    axes.plot(p[:, :2] @ along, p[:, 2], color=_ROBOT, linewidth=1.5)
    axes.set(xlabel="along the gripper's main direction, m", ylabel="height, m")
    low, high = p[:, 2].min() - 0.15, p[:, 2].max() + 0.15
    axes.set_ylim(low, high)
    axes.set_title("from the side", fontsize=10)
    axes.grid(alpha=0.3)


def _energies(axes: Axes, d: Demonstration, a: Adapted) -> None:
    totals = {kind: float(values.sum()) for kind, values in a.energies.items()}
    greatest = max(totals.values(), default=0.0)
    kinds = sorted((k for k in totals if totals[k] > _LEAST_SHARE * greatest), key=lambda k: -totals[k])
    seconds = a.times_s - a.times_s[0]
    for i, kind in enumerate(kinds[: 2 * len(_KINDS)]):
        line = "-" if i < len(_KINDS) else "--"
        axes.plot(seconds, np.maximum(a.energies[kind], 1e-6), line, color=_KINDS[i % len(_KINDS)], label=kind, lw=1.1)
    for k in (d.segments.grasp, d.segments.release):
        if k < len(seconds):
            axes.axvline(seconds[k], color="0.5", linewidth=0.8, linestyle=":")
    axes.set_yscale("log")
    axes.set_ylim(1e-4, _HEADROOM * max(float(a.energies[k].max()) for k in kinds) if kinds else 1.0)
    axes.set(xlabel="time, s (dotted: grasp, release)", ylabel="cost of the edges")
    axes.set_title("what was bent, and against what", fontsize=10)
    axes.legend(fontsize=7, ncols=2, loc="upper right")
    axes.grid(alpha=0.3)


def _figure(width: float, height: float, title: str) -> Figure:
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return buffer.getvalue()
