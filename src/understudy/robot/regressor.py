"""A small smooth network in plain numpy: one number from a few features, with its gradient, and how it is trained.

The activation is (x + sqrt(x^2 + 1)) / 2: smooth, cheap, and linear far out, so that values
keep growing beyond the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

Array = np.ndarray
_RATE: Final = 2.5e-2
Loss = Callable[[Array, slice | Array], tuple[float, Array]]
"""(values of a batch, its rows) -> (mean loss, its derivative by each value)"""


@dataclass(frozen=True, eq=False)
class Regressor:
    """Two hidden layers."""

    shift: Float[np.ndarray, " f"]
    scale: Float[np.ndarray, " f"]
    """features enter as (feature - shift) / scale"""
    weights: tuple[Array, ...]
    """W1 (f, h), b1, W2 (h, h), b2, w3 (h, 1), b3 (1,)"""

    def value(self, features: Float[np.ndarray, "n f"]) -> Float[np.ndarray, " n"]:
        """The value alone, in less than half of the time."""
        W1, b1, W2, b2, w3, b3 = self.weights
        value = np.empty(len(features))
        for start in range(0, len(features), 512):
            rows = slice(start, start + 512)
            x = (features[rows] - self.shift) / self.scale
            value[rows] = (_activated(_activated(x @ W1 + b1) @ W2 + b2) @ w3)[:, 0] + b3[0]
        return value

    def value_and_gradient(
        self, features: Float[np.ndarray, "n f"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n f"]]:
        """The value and its derivative by each feature, in blocks that stay in the processor's cache."""
        W1, _, W2, _, w3, _ = self.weights
        value, gradient = np.empty(len(features)), np.empty(features.shape)
        for start in range(0, len(features), 512):
            rows = slice(start, start + 512)
            value[rows], (_, d1, _, d2) = _run((features[rows] - self.shift) / self.scale, self.weights)
            d2 *= w3[:, 0]
            back = d2 @ W2.T
            back *= d1
            gradient[rows] = back @ W1.T / self.scale
        return value, gradient


def _activated(x: Array) -> Array:
    """The activation, written over x."""
    root = x * x
    root += 1
    np.sqrt(root, out=root)
    x += root
    x *= 0.5
    return x


def _activate(x: Array) -> tuple[Array, Array]:
    """Activation and its derivative."""
    root = np.sqrt(x * x + 1)
    return 0.5 * (x + root), 0.5 + 0.5 * x / root


def _run(x: Array, weights: Sequence[Array]) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    W1, b1, W2, b2, w3, b3 = weights
    a1, d1 = _activate(x @ W1 + b1)
    a2, d2 = _activate(a1 @ W2 + b2)
    return (a2 @ w3)[:, 0] + b3[0], (a1, d1, a2, d2)


def train(
    features: Float[np.ndarray, "n f"], loss: Loss, hidden: int, epochs: int, batch: int = 1024, seed: int = 0
) -> Regressor:
    """Adam (Kingma & Ba 2015) with a learning rate that rises, then falls to 0 as a cosine; deterministic by seed."""
    rng = np.random.default_rng(seed)
    shift, scale = features.mean(axis=0), features.std(axis=0) + 1e-6
    x = ((features - shift) / scale).astype(np.float32)
    n, f = x.shape
    shapes = [(f, hidden), (hidden,), (hidden, hidden), (hidden,), (hidden, 1), (1,)]
    weights = [
        (rng.normal(size=s) * (1.4 / np.sqrt(s[0])) if len(s) == 2 else np.zeros(s)).astype(np.float32) for s in shapes
    ]
    first, second = [np.zeros_like(w) for w in weights], [np.zeros_like(w) for w in weights]
    steps, step = epochs * (n // batch), 0
    for _ in range(epochs):
        order = rng.permutation(n)
        for start in range(0, n - batch + 1, batch):
            rows = order[start : start + batch]
            gradients = _gradients(x[rows], weights, loss, rows)
            step += 1
            rate = _RATE * min(1.0, step / 200) * 0.5 * (1 + np.cos(np.pi * step / steps))
            for w, g, m, v in zip(weights, gradients, first, second, strict=True):
                m += 0.1 * (g - m)
                v += 0.01 * (g * g - v)
                w -= rate * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-8)
    return Regressor(shift, scale, tuple(w.astype(float) for w in weights))


def _gradients(x: Array, weights: Sequence[Array], loss: Loss, rows: Array) -> list[Array]:
    _, _, W2, _, w3, _ = weights
    value, (a1, d1, a2, d2) = _run(x, weights)
    _, slope = loss(value, rows)
    g3 = slope.astype(np.float32)[:, None]
    g2 = (g3 * w3[:, 0]) * d2
    g1 = (g2 @ W2.T) * d1
    return [x.T @ g1, g1.sum(axis=0), a1.T @ g2, g2.sum(axis=0), a2.T @ g3, g3.sum(axis=0)]
