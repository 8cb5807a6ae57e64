"""The likeliest articulation of one kind: random starts, then reweighted least squares with the noise's scale."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.geometry import rigid
from understudy.objects.articulation import FIXED, REVOLUTE, Articulation
from understudy.objects.candidates import candidates
from understudy.objects.likelihood import UNKNOWNS, Fitted, cost, inliers, position_sigma, projected, squares, weights
from understudy.objects.motion import Hypotheses, Measured, residuals, slope, solve_positions, stepped, whiten

_FREEDOM: Final = 5.0  # that starts are judged with, also where the fit is not robust
_LEAST_SCALE: Final = 0.02  # of the noise where no covariance is given; where it is, 1: it may promise too much only
_LARGEST_SCALE: Final = 1e3
_RESCALED: Final = 2  # times after each step
_SETTLED: Final = 0.01  # relative change of the scale
_NOTHING: Final = 1e-4  # gain of log likelihood that is not worth a further step
_REFINED: Final = 2  # of the candidates
_SAMPLE: Final = 50  # poses, evenly over the track, that candidates are judged by
_UNSCALED: Final = 3  # first steps, that do not trust their residuals yet
_EARLY_STEPS: Final = 6  # of candidates
_STEPS: Final = 40  # at most
_INLIERS: Final = 5  # with fewer, there are no outliers


@dataclass(frozen=True, eq=False)
class _State:
    """Hypotheses, what they leave over, and the scales of noise at which that was judged."""

    h: Hypotheses
    q: Float[np.ndarray, "b n"]
    e: Float[np.ndarray, "b n 6"]
    scale: Float[np.ndarray, "b 2"]


def fit_kind(kind: str, m: Measured, free: bool, freedom: float, random: np.random.Generator) -> Fitted:
    """The likeliest articulation of one kind; it rests at q = 0 where the track starts, and opening is positive.

    free: whether the noise may be less than the covariance says. freedom: degrees of Student's t.
    """
    starts = candidates(kind, m, random)
    sample = m.part(np.unique(np.linspace(0, len(m) - 1, min(len(m), _SAMPLE)).astype(int)))
    e = residuals(starts, solve_positions(starts, sample, steps=1), sample)
    costs = cost(squares(whiten(sample, e)), sample.dimensions, _FREEDOM)
    few = starts.part(np.argsort(costs, kind="stable")[:_REFINED])
    early = _refined(few, sample, free, freedom, _EARLY_STEPS)
    best = [int(np.argmin(_scaled_cost(early, sample, freedom)))]
    state = _refined(early.h.part(best), m, free, freedom, _STEPS, early.scale[best])
    h = state.h.part(0)
    raw = Articulation(kind, rigid(h.R, h.p), h.direction / np.linalg.norm(h.direction), h.point, (0.0, 0.0))
    return _rested(Fitted(raw, state.q[0], state.scale[0]), m)


def _scaled_cost(state: _State, m: Measured, freedom: float) -> Float[np.ndarray, " b"]:
    """Minus the log likelihood at each one's own scale of noise, without constants."""
    r2 = squares(whiten(m.scaled(state.scale), state.e))
    entropy = 3 * np.log(state.scale) @ [float(len(m)), float(m.oriented.sum())]
    return np.asarray(cost(r2, m.dimensions, freedom) + entropy)


def _refined(
    start: Hypotheses,
    m: Measured,
    free: bool,
    freedom: float,
    steps: int,
    scale: Float[np.ndarray, "b 2"] | None = None,
) -> _State:
    """Levenberg-Marquardt on each hypothesis, the scale of its noise following from step to step."""
    b, rough = len(start.p), scale is None
    damping, gain = np.full(b, 1e-4), np.zeros(b)
    scale = np.ones((b, 2)) if scale is None else scale
    q = solve_positions(start, m)
    state = _State(start, q, residuals(start, q, m), scale)
    for k in range(steps):
        state, gain, damping = _step(state, m.scaled(scale), freedom, damping)
        if k + 1 >= _UNSCALED or not rough:
            scale = _rescaled(state, m, free, freedom)
            change = np.abs(np.log(scale / state.scale)).max(axis=1)
            state = replace(state, scale=scale)
            if ((change < _SETTLED) & (gain < _NOTHING)).all():
                break
    return state


def _step(
    state: _State, m: Measured, freedom: float, damping: Float[np.ndarray, " b"]
) -> tuple[_State, Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
    """One step of each hypothesis where it helps, what it gained, and the next damping."""
    h, d = state.h, m.dimensions
    r = whiten(m, state.e)
    r2 = squares(r)
    J = projected(h, state.q, state.e, m)
    columns = J.reshape(len(J), -1, J.shape[-1])
    weighted = (weights(r2, d, freedom)[..., None, None] * J).reshape(columns.shape).swapaxes(1, 2)
    H, g = weighted @ columns, weighted @ r.reshape(len(r), -1, 1)
    # what does not change the motion (a rest pose elsewhere along it) has no curvature: damp it
    size = np.diagonal(H, axis1=1, axis2=2) + 1e-9 * np.trace(H, axis1=1, axis2=2)[:, None]
    damped = H + (damping[:, None] * size)[..., None] * np.eye(H.shape[-1])
    trial = stepped(h, -np.linalg.solve(damped, g)[..., 0])
    q = solve_positions(trial, m, state.q, steps=2)
    e = residuals(trial, q, m)
    gain = cost(r2, d, freedom) - cost(squares(whiten(m, e)), d, freedom)
    better = gain > 0
    row = better[:, None]
    taken = _State(trial.where(better, h), np.where(row, q, state.q), np.where(row[..., None], e, state.e), state.scale)
    return taken, np.maximum(gain, 0.0), np.where(better, np.maximum(damping / 10, 1e-9), damping * 30)


def _rescaled(state: _State, m: Measured, free: bool, freedom: float) -> Float[np.ndarray, "b 2"]:
    """Scales of noise that explain what is left over; that of unknown rotations does not fall below positions'."""
    scale, oriented = state.scale, m.oriented[:, None]
    scaled = m.scaled(scale)
    j2 = whiten(scaled, slope(state.h, state.q)) ** 2
    # each q takes one dimension, shared as positions and rotations can see it
    share = j2 / np.maximum(j2.sum(axis=-1, keepdims=True), 1e-12)
    used = 1 - UNKNOWNS[state.h.kind][0] / max(float(m.dimensions.sum()), 12.0)
    expected = _both((1 - share) * np.where(np.arange(6) < 3, True, oriented)) * used
    r = whiten(scaled, state.e)
    for _ in range(_RESCALED):
        r2 = r**2
        left = _both(weights(r2.sum(axis=-1), m.dimensions, freedom)[..., None] * r2)
        factor = np.sqrt(np.maximum(left / np.maximum(expected, 1e-12), 1e-6))
        before, scale = scale, scale * np.where(expected > 0, factor, 1.0)
        scale = np.clip(scale, _LEAST_SCALE if free else 1.0, _LARGEST_SCALE)
        if free:
            scale[:, 1] = scale.max(axis=1)
        r = r / np.repeat(scale / before, 3, axis=1)[:, None]
    return scale


def _both(rows: np.ndarray) -> np.ndarray:
    """Sums over all poses (b, n, 6), of positions and of rotations (b, 2)."""
    total = rows.sum(axis=1)
    return np.stack([total[:, :3].sum(axis=1), total[:, 3:].sum(axis=1)], axis=1)


def _rested(fit: Fitted, m: Measured) -> Fitted:
    """q = 0 where the track starts, and positive where it goes; the range of the inliers."""
    a, q = fit.articulation, fit.q
    if a.kind == FIXED:
        return replace(fit, articulation=replace(a, point=a.T_rest[:3, 3].copy()))
    inlier = inliers(fit, m)
    inlier = inlier if inlier.sum() >= _INLIERS else np.ones(len(m), bool)
    if a.kind == REVOLUTE:  # the circle is cut opposite to where the motion is
        middle = float(np.angle(np.exp(1j * q[inlier]).mean()))
        q = middle + np.pi - (middle + np.pi - q) % (2 * np.pi)
    sigma, first = position_sigma(fit, m), np.flatnonzero(inlier)
    q0 = float(np.median(q[first[:3]]))
    gone = np.abs(q[first] - q0) > 3 * sigma[first]
    rest = first[: max(int(np.argmax(gone)) if gone.any() else len(first), 1)]
    q0 = float(np.median(q[rest]))
    moved = q - q0
    sign = 1.0 if moved[inlier].max() + moved[inlier].min() >= 0 else -1.0
    T_rest = a.pose(np.array([q0]))[0]
    point = T_rest[:3, 3].copy()
    if a.kind == REVOLUTE:
        point = a.point + a.direction * (a.direction @ (point - a.point))
    low, high = float((sign * moved[inlier]).min()), float((sign * moved[inlier]).max())
    rested = Articulation(a.kind, T_rest, sign * a.direction, point, (low, high))
    return replace(fit, articulation=rested, q=sign * moved)
