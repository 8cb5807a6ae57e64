"""The axis of a hinge from the planes that a leaf has been in: registration of all frames at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from understudy.objects.articulation import Articulation
from understudy.objects.moving_part.motion import perturbed
from understudy.objects.moving_part.scoring import PartModel, Scorer, motions

_ITERATIONS: Final = 15
_WIDE: Final = 0.03  # metres
_STEP: Final = 1e-5
_REACH: Final = 4.0  # sigmas beyond which a point is not the leaf's
_LEAST: Final = 12.0  # weight of points below which a frame says nothing
_WORTH: Final = 20.0  # independent measurements in a frame: neighbours err together
_TILT: Final = 0.05  # radians that hinges lean: upright, or level for flaps
_SHIFT: Final = 0.3  # metres by which the start may be off
_THICKNESS: Final = (0.022, 0.012)  # metres: usual, and its spread
_TURN: Final = 0.15  # radians by which a frame's start may be off
_SETTLED: Final = 1e-4


def fit_hinge(
    scorer: Scorer,
    model: PartModel,
    articulation: Articulation,
    q: Float[np.ndarray, " k"],
    frames: Int[np.ndarray, " k"],
    sigma_m: float,
) -> tuple[Articulation, float]:
    """Axis and thickness of a leaf, from its front's points in k frames; q: where it roughly is in them.

    Gauss-Newton on the distances between points and measured surface along the leaf's normal (Chen & Medioni 1992),
    with Welsch weights, over tilt (2), shift (2), thickness and every frame's q, which are eliminated. A leaf that is
    in the plane n_i at angle q_i tells (n_i - n_0) . c of a point c on its axis: two angles are enough.
    """
    flat = model.part(model.flat)
    x, q = np.zeros(5), q.copy()
    x[4] = model.thickness_m
    usual = np.array([0, 0, 0, 0, _THICKNESS[0]])
    prior = np.array([_TILT, _TILT, _SHIFT, _SHIFT, _THICKNESS[1]]) ** -2.0
    for i in range(_ITERATIONS):
        sigma = max(sigma_m, _WIDE * 0.5 ** (i // 3))  # wide at first: the start may be some centimetres off
        r, J, K, w = _linearised(scorer, replace(flat, thickness_m=float(x[4])), articulation, x, q, frames, sigma)
        H = np.einsum("nm,nmi,nmj->ij", w, J, J) + np.diag(prior)
        g = np.einsum("nm,nmi,nm->i", w, J, r) + prior * (x - usual)
        h = np.einsum("nm,nm,nm->n", w, K, K) + _TURN**-2
        cross = np.einsum("nm,nmi,nm->ni", w, J, K)
        gq = np.einsum("nm,nm,nm->n", w, K, r)
        dx = -np.linalg.solve(H - cross.T @ (cross / h[:, None]), g - cross.T @ (gq / h))
        dx *= min(1.0, 0.05 / float(np.abs(dx).max() + 1e-12))
        q += -(gq + cross @ dx) / h
        x += dx
        x[4] = np.clip(x[4], 0.0, 0.08)
        if sigma == sigma_m and np.abs(dx).max() < _SETTLED:
            break
    return perturbed(articulation, x), float(x[4])


def _linearised(
    scorer: Scorer,
    model: PartModel,
    start: Articulation,
    x: Float[np.ndarray, "5"],
    q: Float[np.ndarray, " n"],
    frames: Int[np.ndarray, " n"],
    sigma_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n, m), their derivatives by x (n, m, 5) and by q (n, m), and weights (n, m)."""
    articulation = perturbed(start, x)
    T = motions(articulation, q)
    c = scorer.compare(model, T, frames)
    gap = c.gap.astype(np.float64)
    use = c.seen & ~c.person & ~c.explained & (np.abs(gap) < _REACH * sigma_m)
    w = use * np.exp(-0.5 * (gap / (1.5 * sigma_m)) ** 2)
    total = w.sum(1, keepdims=True)
    w *= np.where(total > _LEAST, _WORTH / np.maximum(total, 1e-9), 0.0) / sigma_m**2
    normal = T[:, :3, :3] @ model.normal
    outwards = np.where(scorer.from_behind(model, T), 1.0, -1.0)[:, None] * normal  # of d gap / d point

    def by(changed: np.ndarray) -> np.ndarray:
        D = (changed - T) / _STEP
        return (
            np.einsum("nk,nkl,ml->nm", outwards, D[:, :3, :3], model.points)
            + np.einsum("nk,nk->n", outwards, D[:, :3, 3])[:, None]
        )

    J = np.zeros((*gap.shape, 5))
    for i in range(4):
        J[..., i] = by(motions(perturbed(start, x + _STEP * np.eye(5)[i]), q))
    J[..., 4] = -scorer.from_behind(model, T).astype(float)[:, None]
    return gap, J, by(motions(articulation, q + _STEP)), w
