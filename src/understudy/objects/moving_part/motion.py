"""Where the part is in every frame (one number, q), and the articulation that makes it fit best."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter1d
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from understudy.objects.articulation import REVOLUTE, Articulation
from understudy.objects.moving_part.scoring import PartModel, Scorer
from understudy.objects.moving_part.search import HandPath, hand_cost, hand_q, samples, step_m

_STEP: Final = 0.0125  # metres of the part's origin, of the coarse grid
_FASTEST: Final = 1.2  # metres per second
_STIFF: Final = 0.15  # cost of a way of 10 cm, in units of the agreement
_HAND_WEIGHT: Final = 0.5
_GRIP: Final = 4.0  # cost of taking hold and of letting go where the hand is not
_TAKE: Final = 0.1  # cost of taking hold and of letting go
_BEYOND, _FAR_BEYOND = 0.25, 0.6  # metres that the part may go farther than the hand; if that is not trusted
_LONGEST: Final = 1.8  # metres
_MOST: Final = 2.3  # radians either way
_CHUNK: Final = 50_000  # point comparisons at a time: temporaries stay in the cache
_FINE: Final = np.arange(-6, 7) * 0.003  # metres around the coarse grid's best


@dataclass(frozen=True, eq=False)
class Motion:
    """q of every frame."""

    q: Float[np.ndarray, " t"]
    agreement: Float[np.ndarray, " t"]
    """of the part's points with the depth image there; -1 to 1"""
    held: Bool[np.ndarray, " t"]
    """the hand is taken to hold the part"""
    curvature: Float[np.ndarray, " t"] | None = None
    """of the agreement over the way of the part's origin, 1/m^2: how sharply the depth says where the part is"""


def track(
    scorer: Scorer,
    model: PartModel,
    articulation: Articulation,
    hand: HandPath,
    times_s: Float[np.ndarray, " t"],
    rest_until: int,
    sigma_m: float = 0.01,
    trust: float = 1.0,
) -> Motion:
    """The likeliest course of q through all frames, at rest up to a given frame.

    A path through a grid of q with two states (Viterbi): either the hand holds the part, is near it, and the part may
    move; or the hand is elsewhere and the part stays where it is. trust: weight of where the hand is: little, once it
    is known what moves and how.
    """
    unit = 1 / step_m(articulation)
    near = hand_q(articulation, hand.positions)
    beyond = (_BEYOND if trust == 1 else _FAR_BEYOND) * unit
    low, high = near.min() - beyond, near.max() + beyond
    if articulation.kind == REVOLUTE:
        low, high = max(low, -_MOST), min(high, _MOST)
    low, high = max(min(low, -0.05 * unit), -_LONGEST * unit), min(max(high, 0.05 * unit), _LONGEST * unit)
    first, last = int(np.floor(low / (_STEP * unit))), int(np.ceil(high / (_STEP * unit)))
    grid = np.arange(first, last + 1) * _STEP * unit
    t, k = len(times_s), len(grid)
    places = np.tile(grid, (t, 1))
    score = agreement_on(scorer, model, articulation, places, np.arange(t), sigma_m)
    score[: rest_until + 1] -= 3.0 * (np.arange(k) != -first)
    cost = hand_cost(articulation, places, hand.positions, hand.sigma_m)
    grip = _TAKE + trust * _GRIP * minimum_filter1d(
        cost, samples(times_s, 0.4), axis=0, mode="nearest"
    )  # one bad position must not matter
    path, holds = _viterbi(score, score - trust * _HAND_WEIGHT * cost, grip, times_s)
    return Motion(grid[path], score[np.arange(t), path], holds)


def agreement_on(
    scorer: Scorer,
    model: PartModel,
    articulation: Articulation,
    q: Float[np.ndarray, "t k"],
    frames: Int[np.ndarray, " t"],
    sigma_m: float,
) -> Float[np.ndarray, "t k"]:
    """Agreement at k places in each of t frames."""
    t, k = q.shape
    out = np.zeros((t, k))
    size = max(1, _CHUNK // (k * len(model.points)))
    for start in range(0, t, size):
        s = slice(start, start + size)
        n = len(frames[s])
        out[s] = scorer.agreement(model, articulation, q[s].ravel(), np.repeat(frames[s], k), sigma_m).reshape(n, k)
    return out


def _viterbi(
    free: Float[np.ndarray, "t k"],
    held: Float[np.ndarray, "t k"],
    grip: Float[np.ndarray, "t k"],
    times_s: Float[np.ndarray, " t"],
) -> tuple[Int[np.ndarray, " t"], Bool[np.ndarray, " t"]]:
    """The path of the greatest sum and where it is held: it only moves while held, at a bounded speed.

    grip: cost of taking hold and of letting go.
    """
    t, k = free.shape
    columns = np.arange(k)
    total = np.stack([free[0], held[0] - grip[0]])  # (state, place)
    came = np.zeros((t, 2, k), np.int64)  # place before
    was = np.zeros((t, 2, k), np.int64)  # state before
    for i in range(1, t):
        reach = int(np.clip(np.ceil(_FASTEST * (times_s[i] - times_s[i - 1]) / _STEP), 2, k))
        shift = np.arange(-reach, reach + 1)
        source = columns[:, None] + shift
        inside = (source >= 0) & (source < k)
        value = np.where(inside, total[1][source.clip(0, k - 1)], -np.inf) - _STIFF * np.abs(shift) * _STEP / 0.1
        pick = value.argmax(1)
        moved, start = value[columns, pick], total[0] - grip[i]
        was[i, 1], came[i, 1] = moved >= start, np.where(moved >= start, source[columns, pick], columns)
        let_go = total[1] - grip[i]
        was[i, 0], came[i, 0] = let_go > total[0], columns
        total = np.stack([np.maximum(let_go, total[0]) + free[i], np.maximum(moved, start) + held[i]])
    path, state = np.zeros(t, np.int64), np.zeros(t, np.int64)
    state[-1], path[-1] = np.unravel_index(int(total.argmax()), total.shape)
    for i in range(t - 1, 0, -1):
        state[i - 1], path[i - 1] = was[i, state[i], path[i]], came[i, state[i], path[i]]
    return path, state.astype(bool)


def sharpen(
    scorer: Scorer, model: PartModel, articulation: Articulation, motion: Motion, sigma_m: float = 0.006
) -> Motion:
    """q to a fraction of a millimetre: the best of a fine grid around it, and the parabola through its neighbours."""
    unit = 1 / step_m(articulation)
    q = motion.q
    grid = q[:, None] + _FINE * unit
    s = agreement_on(scorer, model, articulation, grid, np.arange(len(q)), sigma_m)
    best = s.argmax(1).clip(1, len(_FINE) - 2)
    rows = np.arange(len(q))
    a, b, c = s[rows, best - 1], s[rows, best], s[rows, best + 1]
    bend = a - 2 * b + c
    curved = bend < -1e-4
    shift = np.where(curved, 0.5 * (a - c) / np.where(curved, bend, 1.0), 0.0).clip(-1, 1)
    fine = _FINE[1] - _FINE[0]
    blind = s.max(1) - s.min(1) < 0.02
    new = np.where(blind, q, grid[rows, best] + shift * fine * unit)
    # minus half of the second derivative of the mean score, per metre squared
    curvature = np.where(blind, 0.0, np.maximum(-bend, 0.0) / fine**2)
    return Motion(new, s.max(1), motion.held, curvature)


def perturbed(articulation: Articulation, x: Float[np.ndarray, " p"]) -> Articulation:
    """Tilted by x[0:2] radians about two lines across its direction; an axis also shifted by x[2:4] metres."""
    d = articulation.direction
    a = np.cross(d, np.eye(3)[int(np.abs(d).argmin())])
    a /= np.linalg.norm(a)
    b = np.cross(d, a)
    direction = Rotation.from_rotvec(x[0] * a + x[1] * b).apply(d)
    direction /= np.linalg.norm(direction)
    point = articulation.point
    if articulation.kind == REVOLUTE:
        point = point + x[2] * a + x[3] * b
        point = point + direction * ((articulation.T_rest[:3, 3] - point) @ direction)
    return replace(articulation, direction=direction, point=point)


def refine(
    scorer: Scorer,
    model: PartModel,
    articulation: Articulation,
    q: Float[np.ndarray, " t"],
    frames: Int[np.ndarray, " k"],
    sigma_m: float = 0.008,
    evaluations: int = 60,
) -> tuple[Articulation, float]:
    """Articulation (and thickness of the front) that agrees best with some frames, q being free near where it is.

    A weak preference for the start (1 degree) decides what the depth leaves open.
    """
    local = np.linspace(-0.02, 0.02, 7)
    near = q[frames]
    revolute = articulation.kind == REVOLUTE
    scale = np.array([0.03, 0.03, 0.015, 0.015, 0.01] if revolute else [0.03, 0.03])

    def cost(y: np.ndarray) -> float:
        x = y * scale
        a = perturbed(articulation, x)
        m = replace(model, thickness_m=float(np.clip(model.thickness_m + x[4], 0.0, 0.08))) if revolute else model
        grid = near[:, None] + local / step_m(articulation)
        s = agreement_on(scorer, m, a, grid, frames, sigma_m)
        return float(
            -s.max(1).mean() + 0.003 * ((x[:2] / 0.02) ** 2).sum() + 0.004 * ((m.thickness_m - 0.022) / 0.012) ** 2
        )

    n = len(scale)
    simplex = np.vstack([np.zeros(n), np.eye(n)])
    options: Any = {"maxfev": evaluations, "xatol": 0.02, "fatol": 1e-4, "initial_simplex": simplex}
    best = minimize(cost, np.zeros(n), method="Nelder-Mead", options=options)
    x = best.x * scale
    thickness = float(np.clip(model.thickness_m + x[4], 0.0, 0.08)) if revolute else model.thickness_m
    return perturbed(articulation, x), thickness


def spread_frames(q: Float[np.ndarray, " t"], usable: np.ndarray, n: int) -> Int[np.ndarray, " k"]:
    """Up to n usable frames: half spread over the range of q, the others over the time since it is not at rest."""
    index = np.flatnonzero(usable)
    order = index[np.argsort(q[index], kind="stable")]
    reach = np.linspace(q[order[0]], q[order[-1]], n - n // 2)
    picked = order[np.searchsorted(q[order], reach).clip(0, len(order) - 1)]
    later = index[index >= np.argmax(q != 0)] if (q[index] != 0).any() else index
    if not len(later):
        later = index
    return np.unique(np.concatenate([picked, later[np.linspace(0, len(later) - 1, n // 2).astype(int)], index[:1]]))
