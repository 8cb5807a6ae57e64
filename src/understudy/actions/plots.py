"""Pictures of an action model, as PNG bytes. matplotlib is optional and imported late; no global state, no window."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float

from understudy.actions.features import BASE, FEATURES, ROTATION, YAW, Relative
from understudy.actions.model import ActionModel, SegmentModel
from understudy.actions.motions import RobotMotion
from understudy.actions.reproduction import Reproduction
from understudy.actions.segments import SEGMENTS, Comparable, comparable
from understudy.plots import require_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLORS: Final = {"reach": "#0072B2", "manipulate": "#D55E00", "release": "#009E73"}
_GREY, _PALE = "0.45", "0.75"
_PHASES: Final = 60
_SIGMAS: Final = 2.0
_ARROW_M: Final = 0.07
_CIRCLE: Final = np.column_stack([np.cos(np.linspace(0, 2 * np.pi, 49)), np.sin(np.linspace(0, 2 * np.pi, 49))])


def action_model(model: ActionModel, motions: Sequence[RobotMotion] = (), title: str = "Action model") -> bytes:
    """Paths of gripper and base from above and from the side with 2-sigma ellipses, and six features over the phase.

    Everything stands in the floor frame of the handle at rest: x out of the front, the robot to the right.
    motions: the demonstrations, drawn in grey. Raises MissingExtraError without matplotlib.
    """
    require_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec

    figure = Figure(figsize=(12, 7.6), layout="constrained")
    figure.suptitle(title)
    rows = GridSpec(2, 1, figure, height_ratios=[1.35, 1])
    above, side = figure.add_subfigure(rows[0]), figure.add_subfigure(rows[1])
    views = np.ravel(above.subplots(1, 2))
    run = model.reproduce(model.object.T_start)
    for axes, (i, j), what in zip(views, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        _demonstrations(axes, model, motions, (i, j))
        _run(axes, run, (i, j))
        axes.set(title=what, xlabel="x out of the front, m", ylabel=f"{'xyz'[j]}, m", aspect="equal")
        axes.grid(alpha=0.3)
    views[0].legend(loc="best", fontsize=8)
    cuts = [_on_side(model, comparable(motion, f"demonstration {i}")) for i, motion in enumerate(motions)]
    panels = np.ravel(side.subplots(2, 3, sharex=True))
    for axes, feature in zip(panels, (0, 2, 5, 6, 7, 8), strict=True):
        _feature(axes, model, cuts, feature)
    for axes in panels[3:]:
        axes.set_xticks([0.5, 1.5, 2.5], list(SEGMENTS))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return buffer.getvalue()


def _on_side(model: ActionModel, cut: Comparable) -> Comparable:
    """The demonstration as if the hinge were where the model's is."""
    return cut.mirrored(model.mirror(cut.object.up)) if cut.object.side * model.object.side < 0 else cut


def _demonstrations(axes: Axes, model: ActionModel, motions: Sequence[RobotMotion], ij: tuple[int, int]) -> None:
    """Paths, in the carrier of the model's object, so that other openings do not scatter them."""
    for k, motion in enumerate(motions):
        cut = _on_side(model, comparable(motion, "demonstration"))
        for n, (name, path) in enumerate(cut.paths.items()):
            label = "demonstrations" if k == n == 0 else None
            tool, base = _at_home(model, name, path.poses, path.phase)
            axes.plot(*tool[:, ij].T, color=_PALE, linewidth=0.7, label=label)
            if ij == (0, 1):
                axes.plot(*base.T, color=_PALE, linewidth=0.7)


def _at_home(
    model: ActionModel, name: str, poses: Relative, phase: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Positions of tool and base where the model's own object stands."""
    share = {"reach": np.zeros_like(phase), "manipulate": phase, "release": np.ones_like(phase)}[name]
    T, base, _ = poses.world(model.object.carrier(model.object.q_start + model.object.travel * share))
    return T[:, :3, 3], base[:, :2]


def _run(axes: Axes, run: Reproduction, ij: tuple[int, int]) -> None:
    i, j = ij
    handle = run.T_world_object[:, :3, 3]
    axes.plot(handle[:, i], handle[:, j], color="black", linewidth=3, alpha=0.35, label="handle")
    for name, part in run.segments.slices(len(run)).items():
        color, indices = _COLORS[name], np.arange(len(run))[part]
        tool = run.T_world_tool[part, :3, 3]
        axes.plot(tool[:, i], tool[:, j], color=color, linewidth=1.8, label=f"gripper: {name}")
        for k in indices[:: max(1, len(indices) // 6)]:
            _ellipse(axes, run.T_world_tool[k, :3, 3][[i, j]], run.covariance[k][np.ix_(ij, ij)], color)
        if ij == (0, 1):
            base = run.xy_yaw[part]
            label = "base" if name == "manipulate" else None
            axes.plot(base[:, 0], base[:, 1], color=color, linewidth=1.8, linestyle="--", label=label)
            for k in indices[:: max(1, len(indices) // 3)]:
                _ellipse(axes, run.xy_yaw[k, :2], run.covariance[k, 6:8, 6:8], color)
                x, y, yaw = (float(value) for value in run.xy_yaw[k])
                tip = (x + _ARROW_M * np.cos(yaw), y + _ARROW_M * np.sin(yaw))
                axes.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": color})


def _ellipse(axes: Axes, centre: np.ndarray, S: np.ndarray, color: str) -> None:
    values, vectors = np.linalg.eigh(S)
    ring = centre + _SIGMAS * (_CIRCLE * np.sqrt(np.maximum(values, 0))) @ vectors.T
    axes.fill(*ring.T, color=color, alpha=0.1, linewidth=0)
    axes.plot(*ring.T, color=color, alpha=0.4, linewidth=0.6)


def _feature(axes: Axes, model: ActionModel, cuts: Sequence[Comparable], feature: int) -> None:
    """Mean and 2 sigma over the phases of the three segments, components and demonstrations."""
    angle = feature in range(ROTATION.start, ROTATION.stop) or feature == YAW
    unit, word = (180 / np.pi, "degrees") if angle else (100.0, "cm")
    for k, (name, segment) in enumerate(model.segments.items()):
        for cut in cuts:
            path = cut.paths[name]
            y = segment.chart.features(path.poses)[:, feature] + _zero(segment, feature)
            axes.plot(k + path.phase, unit * y, color=_PALE, linewidth=0.6)
        _band(axes, segment, feature, k, unit, {"color": _COLORS[name]})
    for border in (1, 2):
        axes.axvline(border, color=_GREY, linewidth=0.7, linestyle=":")
    about = " from the segment's mean" if feature < BASE.start and angle else ""
    axes.set(title=f"{FEATURES[feature]}, {word}{about}", xlim=(0, 3))
    axes.title.set_fontsize(9)
    axes.grid(alpha=0.3)


def _zero(segment: SegmentModel, feature: int) -> float:
    """Yaws are drawn from the way out of the front on. Tangent vectors of rotations stay relative to their mean."""
    return segment.chart.yaw_mean % (2 * np.pi) if feature == YAW else 0.0


def _band(axes: Axes, segment: SegmentModel, feature: int, at: int, unit: float, style: dict[str, Any]) -> None:
    phase = np.linspace(0, 1, _PHASES)
    said = segment.predict(phase)
    mean = unit * (said.mean[:, feature] + _zero(segment, feature))
    sigma = unit * np.sqrt(said.covariance[:, feature, feature])
    axes.fill_between(at + phase, mean - _SIGMAS * sigma, mean + _SIGMAS * sigma, alpha=0.2, linewidth=0, **style)
    axes.plot(at + phase, mean, linewidth=1.5, **style)
    mixture = segment.mixture
    for middle, S in zip(mixture.means, mixture.covariances, strict=True):
        plane = np.ix_((0, 1 + feature), (0, 1 + feature))
        values, vectors = np.linalg.eigh(S[plane])
        ring = middle[[0, 1 + feature]] + (_CIRCLE * np.sqrt(np.maximum(values, 0))) @ vectors.T
        axes.plot(at + ring[:, 0], unit * (ring[:, 1] + _zero(segment, feature)), linewidth=0.5, alpha=0.8, **style)
