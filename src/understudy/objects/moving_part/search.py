"""Which panel moves, and roughly how: hypotheses from the panels near the hand's path, tried on a few frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from understudy.geometry import plane_normal, rigid
from understudy.objects.articulation import PRISMATIC, REVOLUTE, Articulation
from understudy.objects.moving_part.scoring import HIDDEN, PartModel, Scorer, motions, point_scores
from understudy.objects.moving_part.stack import Reference

_NEAR_SURFACE: Final = 0.2  # metres between hand and surface when it takes hold
_APART: Final = 0.06  # metres between grasps that are tried
_MAX_GRASPS: Final = 12
_PATCH: Final = 0.22  # metres around the grasp: where the panel is looked for
_ON_PLANE: Final = 0.012  # metres
_OUT: Final = (0.015, 0.13)  # metres in front of the panel: handles
_STEEP: Final = 0.5  # largest vertical component of a front's normal
_RADII: Final = np.arange(0.2, 1.01, 0.05)
_FLAPS: Final = np.arange(0.15, 0.71, 0.1)
_SPAN: Final = 0.16  # metres of q around the hand's that are tried
_SIGMA: Final = 0.02
_POINTS: Final = 120
_ENOUGH: Final = 150  # points that moved: then the panel is among them
_FRAMES: Final = 8
_WINDOW_S: Final = 0.4  # of the running median
_HAND_WEIGHT: Final = 0.3


@dataclass(frozen=True, eq=False)
class HandPath:
    """The hand without outliers and gaps."""

    positions: Float[np.ndarray, "t 3"]
    """world; interpolated where missing"""
    sigma_m: Float[np.ndarray, " t"]
    """large where it is missing"""
    known: Bool[np.ndarray, " t"]


@dataclass(frozen=True, eq=False)
class Panel:
    """A front near where the hand took hold."""

    model: PartModel
    T_world_panel: Float[np.ndarray, "4 4"]
    """origin at the grasp, x out of the front, z up"""
    grasp_frame: int


@dataclass(frozen=True, eq=False)
class Hypothesis:
    panel: Panel
    articulation: Articulation
    family: str
    gain: float
    """how much better it explains the frames than a part that stays where it is; per frame, at most 2"""


def samples(times_s: Float[np.ndarray, " t"], seconds: float) -> int:
    """The odd number of samples that a window of about this length holds."""
    return 2 * int(seconds / 2 / float(np.median(np.diff(times_s))) + 0.5) + 1


def hand_path(times_s: np.ndarray, positions: np.ndarray, sigma_m: np.ndarray) -> HandPath:
    """Outliers replaced by a running median, gaps interpolated."""
    known = np.isfinite(positions).all(1)
    index = np.flatnonzero(known)
    filled = np.column_stack([np.interp(times_s, times_s[index], positions[index, i]) for i in range(3)])
    smooth = median_filter(filled, size=(samples(times_s, _WINDOW_S), 1), mode="nearest")
    gap = np.abs(times_s[:, None] - times_s[index][None]).min(1)
    sigma = np.where(known, np.nan_to_num(sigma_m, nan=0.1), 0.1) + 0.3 * gap
    return HandPath(smooth, np.clip(sigma, 0.04, 0.6), known)


def grasp_frames(hand: HandPath, ref: Reference) -> Int[np.ndarray, " k"]:
    """Frames at which the hand may have taken hold: near a surface, apart from each other."""
    points = ref.points[::3, ::3][ref.z[::3, ::3] > 0]
    distance = cKDTree(points).query(hand.positions, distance_upper_bound=1.0)[0]
    out: list[int] = []
    for i in np.flatnonzero((distance < _NEAR_SURFACE) & hand.known):
        if all(np.linalg.norm(hand.positions[i] - hand.positions[j]) > _APART for j in out):
            out.append(int(i))
        if len(out) == _MAX_GRASPS:
            break
    return np.array(out, np.int64)


def find_panel(
    ref: Reference, moved: Bool[np.ndarray, "h w"], at: Float[np.ndarray, "3"], frame: int, eye: np.ndarray
) -> Panel | None:
    """The upright plane near a point, and the points that make the first model of what moves. eye: the camera."""
    rng = np.random.default_rng(0)
    near = (ref.z > 0) & (np.abs(ref.points - at).max(-1) < _PATCH)
    if near.sum() < 60:
        return None
    loose = near & moved
    fitted = _upright_plane(ref.points[loose if loose.sum() > _ENOUGH else near], rng)
    if fitted is None:
        return None
    n, center = _wider(ref, loose if loose.sum() > _ENOUGH else ref.z > 0, at, fitted)
    n = n if n @ (eye - center) > 0 else -n
    points = ref.points[near]
    height = (points - center) @ n
    flat = np.abs(height) < _ON_PLANE
    out = (height > _OUT[0]) & (height < _OUT[1])
    if flat.sum() < 40:
        return None
    chosen = (flat | out) & moved[near]
    if chosen.sum() < 40:  # a front that slides covers its own place: nothing of it seems to have moved
        chosen = flat | out
    up = np.array([0, 0, 1.0]) - n * n[2]
    up /= np.linalg.norm(up)
    R = np.column_stack([n, np.cross(up, n), up])
    origin = at - n * ((at - center) @ n - 0.04)
    model = PartModel(points[chosen], flat[chosen], n)
    return Panel(model, rigid(R, origin), frame)


Plane = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Unit normal and a point."""


def _upright_plane(points: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Plane | None:
    """The upright plane through most of the points (random triples, then least squares)."""
    sample = points[rng.permutation(len(points))[:600]]
    a, b, c = sample[rng.integers(0, len(sample), (3, 200))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    good = (length > 1e-3) & (np.abs(normal[:, 2]) < _STEEP * length)
    if not good.any():
        return None
    normal, a = normal[good] / length[good, None], a[good]
    best = int(np.argmax((np.abs(sample @ normal.T - np.einsum("ij,ij->i", normal, a)) < _ON_PLANE).sum(0)))
    inliers = points[np.abs((points - a[best]) @ normal[best]) < _ON_PLANE]
    return fit_plane(inliers) if len(inliers) >= 40 else None


def _wider(ref: Reference, usable: Bool[np.ndarray, "h w"], at: np.ndarray, plane: Plane) -> Plane:
    """Fitted again to what it holds farther around: a small patch says little about its tilt."""
    for reach in (1.0, 1.5, 2.0):
        near = usable & (np.abs(ref.points - at).max(-1) < reach * _PATCH)
        points = ref.points[near]
        points = points[np.abs((points - plane[1]) @ plane[0]) < _ON_PLANE]
        if len(points) >= 40:
            plane = fit_plane(points)
    return plane


def fit_plane(points: Float[np.ndarray, "n 3"]) -> Plane:
    """Least squares."""
    return plane_normal(points), points.mean(0)


def hypotheses(panel: Panel) -> Iterator[tuple[str, Articulation]]:
    """How a panel could move: along its normal, in its plane, about an upright or level line in its plane."""
    T = panel.T_world_panel
    n, side, up, at = T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3]
    for family, direction in (("out", n), ("level", side), ("lift", up)):
        yield family, Articulation(PRISMATIC, T, direction, at, (0.0, 0.0))
    for family, axis, across, radii in (("hinge", up, side, _RADII), ("flap", side, up, _FLAPS)):
        for radius in (*radii, *-radii):
            yield family, Articulation(REVOLUTE, T, axis, at + radius * across - 0.05 * n, (0.0, 0.0))


def step_m(articulation: Articulation) -> float:
    """Metres that the part's origin goes per unit of q."""
    return max(articulation.radius_m, 0.15) if articulation.kind == REVOLUTE else 1.0


def hand_q(articulation: Articulation, positions: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, " t"]:
    """q at which the part's origin is nearest to each position, unwrapped for hinges within half a turn."""
    a = articulation
    origin = a.T_rest[:3, 3]
    if a.kind == PRISMATIC:
        return np.asarray((positions - origin) @ a.direction)
    x = origin - a.point
    x = x - a.direction * (x @ a.direction)
    y = np.cross(a.direction, x)
    d = positions - a.point
    return np.asarray(np.arctan2(d @ y, d @ x))


def hand_cost(
    articulation: Articulation, q: Float[np.ndarray, "t k"], positions: np.ndarray, sigma_m: np.ndarray
) -> Float[np.ndarray, "t k"]:
    """0 (the hand is where the part's origin is) to 1 (it is elsewhere)."""
    at = articulation.pose(q.ravel())[:, :3, 3].reshape(*q.shape, 3)
    d2 = ((at - positions[:, None]) ** 2).sum(-1) / (2 * sigma_m[:, None]) ** 2
    return np.asarray(d2 / (1 + d2))


def try_panel(panel: Panel, scorer: Scorer, hand: HandPath, frames: Int[np.ndarray, " k"]) -> list[Hypothesis]:
    """The best hypothesis of each family for a panel, from some frames; before the grasp, it stays where it is."""
    model = panel.model.thinned(_POINTS, np.random.default_rng(0))
    total, frames = len(frames), frames[frames > panel.grasp_frame]
    if not len(frames):
        return []
    offsets = np.linspace(-_SPAN, _SPAN, 15)
    T = panel.T_world_panel
    still = Articulation(PRISMATIC, T, T[:3, 0], T[:3, 3], (0.0, 0.0))
    at_rest = scorer.compare(model, motions(still, np.zeros(len(frames))), frames)
    stays = point_scores(at_rest, _SIGMA, 0.0, HIDDEN).mean(1)
    positions, sigma = hand.positions[frames], hand.sigma_m[frames]
    best: dict[str, Hypothesis] = {}
    for family, articulation in hypotheses(panel):
        q = hand_q(articulation, positions)[:, None] + offsets / step_m(articulation)
        if articulation.kind == REVOLUTE:
            q = q.clip(-2.1, 2.1)
        cost = hand_cost(articulation, q, positions, sigma)
        if (cost.min(1) > 0.5).mean() > 0.6:
            continue  # the hand was never near
        s = scorer.agreement(model, articulation, q.ravel(), np.repeat(frames, len(offsets)), _SIGMA)
        gain = float((np.maximum((s.reshape(q.shape) - _HAND_WEIGHT * cost).max(1), -0.5) - stays).sum()) / total
        if family not in best or gain > best[family].gain:
            best[family] = Hypothesis(panel, articulation, family, gain)
    return list(best.values())
