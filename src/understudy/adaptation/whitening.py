"""Residuals and Jacobians of edges, divided by their standard deviations: what the solver takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from understudy.adaptation import edges
from understudy.adaptation.solver import Linear

Rates = tuple[np.ndarray, np.ndarray, np.ndarray]
Parts = Sequence[tuple[int, slice, np.ndarray]]


def rates(between: Rates, dt: np.ndarray) -> Rates:
    """Differences per second, with their Jacobians."""
    e, Ja, Jb = between
    return e / dt, Ja / dt[..., None], Jb / dt[..., None]


def six(pair: tuple[float, float]) -> Float[np.ndarray, "6"]:
    """Of translations and rotations."""
    return np.repeat(np.array(pair), 3)


def three(pair: tuple[float, float]) -> Float[np.ndarray, "3"]:
    """Of x, y and yaw."""
    return np.array([pair[0], pair[0], pair[1]])


def inverse_root(covariance: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """A with A' A the inverse of covariance + diag(spread), per row."""
    k = covariance.shape[-1]
    total = covariance + spread[:, :, None] * np.eye(k)
    return np.linalg.inv(np.linalg.cholesky(total)) if len(total) else np.zeros((0, k, k))


def weighted(
    kind: str, steps: np.ndarray, e: np.ndarray, parts: Parts, root: np.ndarray, kernel: str, width: float
) -> Linear:
    """Edges with a full weight matrix each, and a robust kernel."""
    r = (root @ e[..., None])[..., 0]
    cost, weight = edges.robust(np.sum(r**2, axis=1), kernel, width)
    scale = np.sqrt(weight)[:, None]
    whitened = [(s, c, scale[..., None] * (root @ J)) for s, c, J in parts]
    return Linear(kind, cost, steps, scale * r, whitened)


def scaled(
    kind: str,
    steps: np.ndarray,
    e: np.ndarray,
    parts: Parts,
    sigma: Float[np.ndarray, " k"],
    border: np.ndarray | None = None,
) -> Linear:
    """Edges with one standard deviation per residual."""
    r = e / sigma
    whitened = [(s, c, J / sigma[:, None]) for s, c, J in parts]
    return Linear(kind, np.sum(r**2, axis=1), steps, r, whitened, None if border is None else border / sigma[:, None])


def active(kind: str, steps: np.ndarray, e: np.ndarray, parts: Parts, sigma: np.ndarray) -> Linear:
    """Hinges: only those that push."""
    on = np.flatnonzero((e > 0).any(axis=1))
    return scaled(kind, steps[on], e[on], [(s, c, J[on]) for s, c, J in parts], sigma)


def limited(
    steps: np.ndarray, x: np.ndarray, parts: Parts, least: np.ndarray, greatest: np.ndarray, sigma: np.ndarray
) -> Linear:
    """Numbers that must stay in a range."""
    e, slope = edges.beyond(x, least, greatest)
    return active("limits", steps, e, [(s, c, slope[..., None] * J) for s, c, J in parts], sigma)
