"""A demonstration to look at: over the image, from above, and over time. matplotlib is optional and imported late."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float, UInt8

from understudy.camera import Camera
from understudy.demonstration.demonstration import FREE, OCCUPIED, Demonstration
from understudy.geometry import inverse, transform_points
from understudy.plots import require_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SEGMENT_COLORS: Final = {"reach": "#0072B2", "manipulate": "#D55E00", "release": "#009E73"}
_OBJECT: Final = "#CC79A7"
_TORSO: Final = "0.35"


def plot(demo: Demonstration, color: UInt8[np.ndarray, "h w 3"] | None = None, camera: Camera | None = None) -> bytes:
    """A PNG: trajectories over the image, from above, and over time.

    color, camera: the colour image that the trajectories are drawn on (undistorted or not) and its camera; without
    them, that panel shows the scene from the side instead. Raises MissingExtraError without matplotlib.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1), height_ratios=(1.25, 1))
    if color is not None and camera is not None:
        _over_image(figure.add_subplot(grid[0, 0]), demo, color, camera)
    else:
        _from_the_side(figure.add_subplot(grid[0, 0]), demo)
    _from_above(figure.add_subplot(grid[:, 1]), demo)
    _over_time(figure.add_subplot(grid[1, 0]), demo)
    figure.suptitle(f"{demo.task}: {len(demo)} samples, {demo.acting} hand, {demo.articulation.kind} object")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=80)
    return out.getvalue()


def _paths(axes: Axes, demo: Demonstration, hand: Float[np.ndarray, "t 2"], object: Float[np.ndarray, "t 2"]) -> None:
    """The hand by segment (measured: dots; filled in: line only) and the object, in the panel's coordinates."""
    for name, part in demo.segments.slices(len(demo)).items():
        line = slice(part.start, min(part.stop + 1, len(demo)))
        axes.plot(*hand[line].T, color=SEGMENT_COLORS[name], linewidth=1.2, label=f"hand, {name}")
        seen = hand[part][demo.hand.observed[part]]
        axes.plot(*seen.T, ".", color=SEGMENT_COLORS[name], markersize=4)
    axes.plot(*object.T, color=_OBJECT, linewidth=2.5, alpha=0.8, label="handle")


def _over_image(axes: Axes, demo: Demonstration, color: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    T_cam_world = inverse(demo.T_world_cam)

    def seen(points: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 2"]:
        p = transform_points(T_cam_world, points)
        p[~(p[:, 2] > 0.1)] = np.nan
        return camera.project(p)

    axes.imshow(color)
    _paths(axes, demo, seen(demo.hand.positions), seen(demo.object.positions))
    floor = np.column_stack([demo.torso.xy_yaw[:, :2], np.zeros(len(demo))])
    axes.plot(*seen(floor).T, color="yellow", linewidth=1.2, label="torso, on the floor")
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), title="over the image (at the grasp)")
    axes.axis("off")


def _from_the_side(axes: Axes, demo: Demonstration) -> None:
    x = demo.articulation.T_rest[:3, 0]
    away = np.array([x[0], x[1], 0]) / max(float(np.hypot(x[0], x[1])), 1e-9)

    def side(points: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 2"]:
        return np.column_stack([(points - demo.articulation.T_rest[:3, 3]) @ away, points[:, 2]])

    axes.plot(*side(demo.scene.astype(float)).T, ",", color="0.7")
    _paths(axes, demo, side(demo.hand.positions), side(demo.object.positions))
    axes.set(xlabel="in front of the handle, m", ylabel="height, m", title="from the side", aspect="equal")


def _from_above(axes: Axes, demo: Demonstration) -> None:
    m = demo.map
    shades = np.full((*m.state.shape, 3), 0.88)
    shades[m.state == FREE] = 1.0
    shades[m.state == OCCUPIED] = 0.55
    low = m.origin_xy - m.resolution_m / 2
    high = low + m.resolution_m * np.array(m.state.shape[::-1])
    axes.imshow(shades, origin="lower", extent=(low[0], high[0], low[1], high[1]), interpolation="nearest")
    _paths(axes, demo, demo.hand.positions[:, :2], demo.object.positions[:, :2])
    torso = demo.torso.xy_yaw
    axes.plot(*torso[:, :2].T, color=_TORSO, linewidth=1.2, label="torso")
    every = max(1, len(demo) // 16)
    arrows = torso[::every][np.isfinite(torso[::every]).all(axis=1)]
    axes.quiver(*arrows[:, :2].T, np.cos(arrows[:, 2]), np.sin(arrows[:, 2]), color=_TORSO, scale=18, width=0.004)
    axes.plot(*demo.T_world_cam[:2, 3], "^", color="black", label="camera")
    everything = np.concatenate(
        [torso[:, :2], demo.hand.positions[:, :2], demo.object.positions[:, :2], demo.T_world_cam[None, :2, 3]]
    )
    everything = everything[np.isfinite(everything).all(axis=1)]
    middle, half = (everything.max(0) + everything.min(0)) / 2, np.ptp(everything, axis=0).max() / 2 + 0.6
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set(xlabel="x, m", ylabel="y, m", title="from above (dark: occupied, white: free, grey: unknown)")
    axes.legend(fontsize=8, loc="best")


def _over_time(axes: Axes, demo: Demonstration) -> None:
    times = demo.times_s
    borders = [0, demo.segments.grasp, demo.segments.release, len(demo)]
    for name, a, b in zip(SEGMENT_COLORS, borders[:-1], borders[1:], strict=True):
        if b > a:
            axes.axvspan(times[a], times[min(b, len(demo) - 1)], color=SEGMENT_COLORS[name], alpha=0.12, label=name)
    known = demo.object.known
    moved = np.full(len(demo), np.nan)
    moved[known] = np.linalg.norm(demo.object.positions[known] - demo.articulation.T_rest[:3, 3], axis=1)
    apart = np.linalg.norm(demo.hand.positions - demo.object.positions, axis=1)
    sigma = np.sqrt(np.trace(demo.hand.covariance[:, :3, :3], axis1=1, axis2=2))
    curves: list[tuple[str, np.ndarray, dict[str, Any]]] = [
        ("handle moved", 100 * moved, {"color": _OBJECT, "linewidth": 2}),
        ("hand to handle", 100 * apart, {"color": "0.2"}),
    ]
    for label, y, style in curves:
        axes.plot(times, y, label=label, **style)
    axes.fill_between(times, 100 * (apart - sigma), 100 * (apart + sigma), color="0.2", alpha=0.15, linewidth=0)
    lost = ~demo.hand.observed
    axes.plot(times[lost], np.zeros(int(lost.sum())), "|", color="red", label="hand not seen")
    axes.set(xlabel="s", ylabel="cm", xlim=(times[0], times[-1]), title="over time")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=3, loc="upper left")
