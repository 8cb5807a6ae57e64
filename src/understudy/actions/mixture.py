"""Mixtures of Gaussians over [phase, features]: learnt by EM, read out by Gaussian mixture regression (GMR).

GMR: Ghahramani and Jordan 1994; for demonstrations: Calinon et al. 2007. EM is scikit-learn's.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.errors import MissingExtraError, UnderstudyError

_ITERATIONS: Final = 100
_TOLERANCE: Final = 1e-3
_PATIENCE: Final = 2  # numbers of components without a better BIC, after which the search ends


@dataclass(frozen=True, eq=False)
class Regression:
    """What a mixture says about the features at t phases."""

    mean: Float[np.ndarray, "t d"]
    slope: Float[np.ndarray, "t d"]
    """derivative of the mean by the phase"""
    covariance: Float[np.ndarray, "t d d"]


@dataclass(frozen=True, eq=False)
class Mixture:
    """k Gaussians over 1 + d numbers; the first is the phase."""

    weights: Float[np.ndarray, " k"]
    """positive; their sum is 1"""
    means: Float[np.ndarray, "k n"]
    covariances: Float[np.ndarray, "k n n"]

    def __post_init__(self) -> None:
        k, n = self.means.shape
        if self.weights.shape != (k,) or self.covariances.shape != (k, n, n) or n < 2 or k < 1:
            raise UnderstudyError("a mixture needs weights (k,), means (k, 1 + d) and covariances (k, 1 + d, 1 + d)")
        if not (np.isfinite(self.means).all() and np.isfinite(self.covariances).all()):
            raise UnderstudyError("a mixture's means and covariances must be finite")
        if not ((self.weights > 0).all() and abs(float(self.weights.sum()) - 1) < 1e-6):
            raise UnderstudyError("a mixture's weights must be positive and their sum 1")
        if not (self.covariances[:, 0, 0] > 0).all():
            raise UnderstudyError("a mixture's variance of the phase must be positive")

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def gains(self) -> Float[np.ndarray, "k d"]:
        """Slope of the features over the phase within each component."""
        return np.asarray(self.covariances[:, 1:, 0] / self.covariances[:, :1, 0])

    @property
    def residuals(self) -> Float[np.ndarray, "k d d"]:
        """Covariance of the features within each component once the phase is known."""
        gain, cross = self.gains, self.covariances[:, 0, 1:]
        C = self.covariances[:, 1:, 1:] - gain[:, :, None] * cross[:, None]
        return np.asarray((C + C.swapaxes(1, 2)) / 2)

    def shares(self, phase: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t k"]:
        """Probability of each component, given the phase."""
        variance = self.covariances[:, 0, 0]
        ahead = np.asarray(phase, np.float64)[:, None] - self.means[:, 0]
        score = np.log(self.weights) - 0.5 * np.log(variance) - 0.5 * ahead**2 / variance
        share = np.exp(score - score.max(axis=1, keepdims=True))
        return np.asarray(share / share.sum(axis=1, keepdims=True))

    def regress(self, phase: Float[np.ndarray, " t"]) -> Regression:
        """Mean, slope and covariance of the features, given the phase: all phases at once."""
        phase = np.asarray(phase, np.float64)
        gain, variance = self.gains, self.covariances[:, 0, 0]
        ahead = phase[:, None] - self.means[:, 0]
        share = self.shares(phase)
        local = self.means[:, 1:] + ahead[..., None] * gain
        mean = np.einsum("tk,tkd->td", share, local)
        away = local - mean[:, None]
        pull = -ahead / variance
        turn = share * (pull - (share * pull).sum(axis=1, keepdims=True))
        slope = share @ gain + np.einsum("tk,tkd->td", turn, away)
        weighted = share[..., None] * away
        covariance = np.tensordot(share, self.residuals, axes=1) + weighted.swapaxes(1, 2) @ away
        return Regression(mean, slope, (covariance + covariance.swapaxes(1, 2)) / 2)

    def mapped(self, A: Float[np.ndarray, "d d"]) -> Mixture:
        """The mixture of A y, where y are the features of this one."""
        full = np.eye(len(A) + 1)
        full[1:, 1:] = A
        return Mixture(self.weights, self.means @ full.T, full @ self.covariances @ full.T)

    def softened(self, factor: float) -> Mixture:
        """The same lines, each over a phase that is wider by a factor: less sudden changes from one to the next."""
        gain, C, S = self.gains, self.residuals, self.covariances.copy()
        variance = factor**2 * S[:, :1, 0]
        S[:, 0, 0] = variance[:, 0]
        S[:, 1:, 0] = S[:, 0, 1:] = gain * variance
        S[:, 1:, 1:] = C + gain[:, :, None] * gain[:, None] * variance[..., None]
        return Mixture(self.weights, self.means, S)

    def with_residuals(self, C: Float[np.ndarray, "k d d"]) -> Mixture:
        """Other covariances once the phase is known. Means over the phase stay the same."""
        covariances = self.covariances.copy()
        gain = self.gains
        covariances[:, 1:, 1:] = C + gain[:, :, None] * gain[:, None] * self.covariances[:, :1, :1]
        return Mixture(self.weights, self.means, covariances)


def fit_mixture(
    samples: Float[np.ndarray, "m n"],
    floor: Float[np.ndarray, " n"],
    most: int = 12,
    seed: int = 0,
    restarts: int = 3,
    components: int | None = None,
) -> Mixture:
    """Learns a mixture with full covariances.

    samples: rows of [phase, features]. floor: standard deviations, in the units of each column, that are added to every
    component: what no component may be narrower than. components: None: the number with the least BIC, up to `most`.
    Starts are cuts of the samples by phase: even ones first, then `restarts` random ones for the chosen number.
    Raises UnderstudyError for samples that are too few or not finite; MissingExtraError without scikit-learn.
    """
    samples, floor = np.asarray(samples, np.float64), np.asarray(floor, np.float64)
    m, n = samples.shape
    if not np.isfinite(samples).all():
        raise UnderstudyError("a mixture cannot be learnt from samples that are not finite")
    if floor.shape != (n,) or not (floor > 0).all():
        raise UnderstudyError(f"floor must be {n} positive numbers")
    most = min(most, m // 4)
    if most < 1 or not (components is None or 1 <= components <= m // 2):
        raise UnderstudyError(f"{m} samples are too few for a mixture of {components or 1} components")
    x = samples / floor
    order = np.argsort(x[:, 0], kind="stable")
    best = _by_bic(x, order, most) if components is None else _em(x, order, _even_cuts(m, components))
    k, rng = len(best.weights_), np.random.default_rng(seed)
    for _ in range(restarts if k > 1 else 0):
        shares = rng.dirichlet(np.full(k, 4.0))
        other = _em(x, order, np.cumsum(shares)[:-1] * m)
        if other.lower_bound_ > best.lower_bound_:
            best = other
    return Mixture(best.weights_ / best.weights_.sum(), best.means_ * floor, best.covariances_ * np.outer(floor, floor))


def mixture_of_paths(paths: Float[np.ndarray, "p m n"], floor: Float[np.ndarray, " n"], **fit: Any) -> Mixture:
    """Learns a mixture from p paths of [phase, features] at the same m phases.

    EM and BIC divide the phases by the shape of the mean path; then one M step takes in all paths. EM on all samples at
    once would divide the demonstrators as well: samples of one path are no independent ones, so that a component for
    some of the paths pays for itself, and where it ends the spread between paths is lost.
    fit: passed on to `fit_mixture`.
    """
    share = fit_mixture(paths.mean(axis=0), floor, **fit)
    r = share.shares(paths[0, :, 0])
    total = r.sum(axis=0)
    means = np.einsum("mk,mn->kn", r, paths.mean(axis=0)) / total[:, None]
    away = paths[:, None] - means[:, None]
    covariances = np.einsum("mk,pkmi,pkmj->kij", r, away, away, optimize=True) / (len(paths) * total[:, None, None])
    covariances = (covariances + covariances.swapaxes(1, 2)) / 2 + np.diag(floor**2)
    return Mixture(total / total.sum(), means, covariances)


def _by_bic(x: np.ndarray, order: np.ndarray, most: int) -> Any:
    """The fitted scikit-learn mixture with the least BIC, of 1, 2, ... components."""
    best, least, worse = None, np.inf, 0
    for k in range(1, most + 1):
        model = _em(x, order, _even_cuts(len(x), k))
        bic = float(model.bic(x))
        best, least, worse = (model, bic, 0) if bic < least else (best, least, worse + 1)
        if worse >= _PATIENCE:
            break
    return best


def _even_cuts(m: int, k: int) -> np.ndarray:
    return np.linspace(0, m, k + 1)[1:-1]


def _em(x: np.ndarray, order: np.ndarray, cuts: np.ndarray) -> Any:
    """EM from components that are cuts of the samples (in units of the floors) by their order in phase."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.mixture import GaussianMixture
    except ImportError as e:
        raise MissingExtraError("learning an action model", "robot") from e
    n = x.shape[1]
    parts = [part for part in np.split(order, np.round(cuts).astype(int)) if len(part)]
    covariances = [np.cov(x[part].T, bias=True).reshape(n, n) + np.eye(n) for part in parts]
    model = GaussianMixture(
        len(parts),
        tol=_TOLERANCE,
        max_iter=_ITERATIONS,
        reg_covar=1.0,  # the floors: x is in their units
        means_init=np.array([x[part].mean(axis=0) for part in parts]),
        weights_init=np.array([len(part) for part in parts]) / len(x),
        precisions_init=np.linalg.inv(np.array(covariances)),
        init_params="random_from_data",  # not used, but k-means would run in vain
        random_state=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a few steps short of the optimum is good enough
        return model.fit(x)
