"""Where a handle's bar begins and ends, from all frames: each shows the parts of it that nobody hides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from understudy.geometry import inverse, rigid
from understudy.objects.articulation import Articulation, Handle
from understudy.objects.moving_part.handle import KNOB
from understudy.objects.moving_part.scoring import motions
from understudy.objects.moving_part.stack import UNIT, DepthStack

_REACH: Final = 0.36  # metres along the bar, either way
_ACROSS: Final = 0.065  # metres across it
_CELL: Final = 0.005  # metres
_OUT: Final = 0.015  # metres: stands out of the front
_NEAR: Final = (0.03, 0.017)  # metres along the optical axis: wide at first
_FRAMES: Final = 120
_BAR, _BESIDE = 0.75, 1.75  # pixels beyond the radius: belongs to the bar, is beside it
_BLOCKED: Final = 0.35  # share of what is beside a bar that other things may take
_SEES_THROUGH: Final = 0.8  # share of the bar's width
_VOTES: Final = 5  # for a bar, less those against it
_UNSEEN: Final = 0.06  # metres by which a bar may be longer than was seen
_RADIUS: Final = (0.004, 0.03)  # metres
_SHORTEST: Final = 0.015  # metres
_TINY: Final = 1e-9


@dataclass(frozen=True, eq=False)
class _Looks:
    """What k frames show at places along the bar (a) and across it, as the camera sees it (c)."""

    along: Float[np.ndarray, " a"]
    across: Float[np.ndarray, " c"]
    T_cam_handle: Float[np.ndarray, "k 4 4"]
    pixel_m: float
    """size of a pixel there"""
    near_m: float
    """along the optical axis: what is so near to where the bar should be may be the bar"""
    pixel: Int[np.ndarray, "k a c"]
    """flat index"""
    measured: Float[np.ndarray, "k a c"]
    """metres, 0 = nothing"""
    gap: Float[np.ndarray, "k a c"]
    """metres that it is farther than the bar's surface"""
    height: Float[np.ndarray, "k a c"]
    """metres that it stands out of the front"""

    @property
    def hit(self) -> Bool[np.ndarray, "k a c"]:
        return np.asarray((np.abs(self.gap) < self.near_m) & self.taken)

    @property
    def free(self) -> Bool[np.ndarray, "k a c"]:
        """The camera sees through."""
        return np.asarray((self.measured > 0) & (self.gap >= self.near_m))

    @property
    def taken(self) -> Bool[np.ndarray, "k a c"]:
        """Something that stands out of the front is there, or before it."""
        return np.asarray((self.measured > 0) & (self.gap < self.near_m) & (self.height > _OUT))


def settle_on_bar(
    stack: DepthStack,
    T_world_cam: Float[np.ndarray, "4 4"],
    articulation: Articulation,
    q: Float[np.ndarray, " t"],
    frames: Int[np.ndarray, " k"],
    T_rest: Float[np.ndarray, "4 4"],
    handle: Handle,
) -> tuple[Float[np.ndarray, "4 4"], Handle]:
    """A handle that was found roughly, put where its bar really begins and ends.

    articulation: of the part, for q. frames: in which the part is known well. T_rest: of the handle found (world, part
    at rest). Each frame votes at each place along the bar. Bar: a surface is at its height and both sides are free; so
    hands, which are wide, are no bar, whether they were told from the furniture or not. No bar: the camera sees
    through. Where most votes are for a bar, there it is.
    """
    picked = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).astype(int))]
    T, bar = T_rest, handle
    for near_m in _NEAR if handle.length_m > KNOB else _NEAR[-1:]:
        looks = _look(stack, T_world_cam, articulation, q, picked, T, bar, near_m)
        found = _settled(looks, stack, bar)
        if found is None:
            return T_rest, handle
        shift, bar = found
        T = T @ rigid(np.eye(3), shift)
    return T, bar


def _settled(looks: _Looks, stack: DepthStack, handle: Handle) -> tuple[Float[np.ndarray, "3"], Handle] | None:
    """By what the handle's frame has to move, and the handle as it is then."""
    pixel_m = looks.pixel_m
    own = np.abs(looks.across) < handle.radius_m + _BAR * pixel_m
    beside = np.abs(looks.across) > handle.radius_m + _BESIDE * pixel_m
    hit = looks.hit
    thin = _clear(looks, beside & (looks.across < 0)) & _clear(looks, beside & (looks.across > 0))
    bar = hit[:, :, own].any(2) & thin
    none = looks.free[:, :, own].mean(2) > _SEES_THROUGH
    ends = _ends(looks.along, bar.sum(0), none.sum(0))
    if ends is None:
        return None
    low, high = ends
    shown = hit & (bar & (looks.along > low) & (looks.along < high))[:, :, None]
    middle, radius = _axis(looks, stack, shown & ~beside, float(shown.sum() / max(1, shown.any(2).sum())))
    length = max(high - low - pixel_m / 2, 2 * radius, _SHORTEST)
    out = max(handle.standoff_m + middle[0], 0.01)
    return np.array([*middle, (low + high) / 2]), Handle(length, radius, out)


def _look(
    stack: DepthStack,
    T_world_cam: Float[np.ndarray, "4 4"],
    articulation: Articulation,
    q: Float[np.ndarray, " t"],
    frames: Int[np.ndarray, " k"],
    T_rest: Float[np.ndarray, "4 4"],
    handle: Handle,
    near_m: float,
) -> _Looks:
    along, across = (np.arange(-round(x / _CELL), round(x / _CELL) + 1) * _CELL for x in (_REACH, _ACROSS))
    T = inverse(T_world_cam) @ motions(articulation, q[frames]) @ T_rest
    line = T[:, None, :3, 3] + along[:, None] * T[:, None, :3, 2]
    side = np.cross(T[:, :3, 2], T[:, :3, 3])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), _TINY)
    places = line[:, :, None] + across[:, None] * side[:, None, None]
    camera, shape = stack.camera, places.shape[:3]
    uv = np.nan_to_num(camera.project(places.reshape(-1, 3)), nan=-9.0)
    inside = camera.contains(uv)
    column, row = np.where(inside, np.rint(uv.T), 0).astype(np.int64)
    measured = stack.z[np.repeat(frames, shape[1] * shape[2]), row, column] * UNIT
    measured = np.where(inside, measured, 0.0).reshape(shape)
    pixel = (row * camera.width + column).reshape(shape)
    out = T[:, :3, 0]  # of the front
    away = np.einsum("kacj,kj->kac", stack.rays().astype(np.float32).reshape(-1, 3)[pixel], out.astype(np.float32))
    height = measured * away + (handle.standoff_m - np.einsum("kj,kj->k", out, T[:, :3, 3]))[:, None, None]
    gap = measured - (places[..., 2] - handle.radius_m)
    pixel_m = float(np.linalg.norm(T[:, :3, 3], axis=1).mean()) / camera.fx
    return _Looks(along, across, T, pixel_m, near_m, pixel, measured, gap, height)


def _clear(looks: _Looks, side: Bool[np.ndarray, " c"]) -> Bool[np.ndarray, "k a"]:
    """Whether nothing is beside the bar on this side. No measurement is nothing: bars cast shadows in depth images."""
    return np.asarray(looks.taken[:, :, side].mean(2) < _BLOCKED)


def _ends(
    along: Float[np.ndarray, " a"], bar: Int[np.ndarray, " a"], none: Int[np.ndarray, " a"]
) -> tuple[float, float] | None:
    """The interval with the most votes for a bar, less those against it; None if they say nothing.

    An end that no frame showed is put into the middle of where it may be.
    """
    total = np.concatenate([[0], np.cumsum(bar - none)])  # before each place
    least = np.minimum.accumulate(total)
    last = int((total - least).argmax())
    first = int(total[: last + 1].argmin())
    if total[last] - total[first] < _VOTES or first == 0 or last == len(along):
        return None  # no bar, or one that is longer than handles are
    share = (bar + 0.5) / (bar + none + 1.0)
    below, above = _unseen((bar + none)[:first][::-1]), _unseen((bar + none)[last:])
    low = along[first] - _CELL * (1 + below) / 2 if below else _crossing(along, share, first - 1)
    high = along[last - 1] + _CELL * (1 + above) / 2 if above else _crossing(along, share, last - 1)
    return float(low), float(high)


def _unseen(votes: Int[np.ndarray, " n"]) -> int:
    """Places from the first on that nobody has voted on; up to _UNSEEN."""
    seen = np.flatnonzero(votes)
    return min(int(seen[0]) if len(seen) else len(votes), round(_UNSEEN / _CELL))


def _crossing(along: np.ndarray, share: np.ndarray, i: int) -> float:
    """Where the share of votes passes one half between places i and i + 1; halfway if it does not."""
    a, b = share[i] - 0.5, share[i + 1] - 0.5
    return float(along[i] + _CELL * (a / (a - b) if a * b < 0 else 0.5))


def _axis(
    looks: _Looks, stack: DepthStack, shown: Bool[np.ndarray, "k a c"], cells: float
) -> tuple[tuple[float, float], float]:
    """Where the bar's axis is (x and y of the handle's frame) and its radius; cells: width of what the places show."""
    frame = np.nonzero(shown)[0]
    rays = stack.rays().reshape(-1, 3)[looks.pixel[shown]]
    T = looks.T_cam_handle[frame]
    points = np.einsum("nji,nj->ni", T[:, :3, :3], rays * looks.measured[shown][:, None] - T[:, :3, 3])
    rays = np.einsum("nji,nj->ni", T[:, :3, :2], rays)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), _TINY)
    radius = float(np.clip(cells * _CELL / 2, *_RADIUS))
    x, y = np.median(points[:, :2] + radius * rays, axis=0)  # the surface is a radius before the axis
    return (float(x), float(y)), radius
