"""Lofts: rings of superellipses along a straight axis with rounded ends, of many bodies at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

COLUMNS = 28
"""Vertices around a ring."""

CAP = np.linspace(0, np.pi / 2, 6)
"""Angles of the rings of a rounded end."""

ROWS = 18
"""Rings between the ends."""


@dataclass(frozen=True)
class Part:
    """A loft of N bodies. Its own frame: columns (width, depth, axis) in the body frame."""

    segment: str
    start: Float[Tensor, "n 3"]
    frame: Float[Tensor, "n 3 3"]
    length: Float[Tensor, " n"]
    at: tuple[float, ...]
    """knots along the axis, 0..1"""
    width: Float[Tensor, "n k"]
    """half, at the knots, metres"""
    depth: Float[Tensor, "n k"]
    shift: Float[Tensor, "n k"]
    """of the ring's centre in the direction of depth"""
    caps: tuple[float, float] = (1.0, 1.0)
    """length of the rounded ends, as a share of the rings' mean half axis there"""
    power: float = 2.0
    """2: ellipse, larger: towards a box"""

    def rings(self, values: Tensor) -> Tensor:
        """(N, ROWS) values at the rings, from those at the knots."""
        t = np.linspace(0, 1, ROWS)
        matrix = np.stack([np.interp(t, self.at, row) for row in np.eye(len(self.at))], 1)
        soft = np.eye(ROWS)
        inner = np.arange(1, ROWS - 1)
        for shift, share in ((-1, 0.25), (0, 0.5), (1, 0.25)):
            soft[inner, inner + shift] = share
        return values @ torch.from_numpy(soft @ soft @ matrix).to(values).T

    def axis_positions(self) -> Float[Tensor, "n r"]:
        """Positions of all rings along the axis, in shares of the length; outside 0..1 in the rounded ends."""
        w, d = self.width, self.depth
        first, last = (
            (w[:, k] + d[:, k])[:, None] / 2 * c / self.length[:, None] for k, c in zip((0, -1), self.caps, strict=True)
        )
        inner = torch.linspace(0, 1, ROWS).expand(len(w), ROWS)
        cos = torch.from_numpy(np.cos(CAP[:-1])).to(w)
        return torch.cat([-first * cos, inner, 1 + last * cos.flip(0)], 1)

    def vertices(self) -> Float[Tensor, "n v 3"]:
        """Ring by ring."""
        sin = torch.from_numpy(np.sin(CAP[:-1])).to(self.width)

        def all_rings(values: Tensor, taper: bool) -> Tensor:
            mid = self.rings(values)
            k = sin if taper else torch.ones_like(sin)
            return torch.cat([mid[:, :1] * k, mid, mid[:, -1:] * k.flip(0)], 1)

        a, b = all_rings(self.width, True), all_rings(self.depth, True)
        phi = torch.linspace(0, 2 * torch.pi, COLUMNS + 1)[:-1]
        c, s = phi.cos(), phi.sin()
        c, s = (v.sign() * v.abs() ** (2 / self.power) for v in (c, s))
        local = torch.stack(
            [
                a[..., None] * c,
                b[..., None] * s + all_rings(self.shift, False)[..., None],
                (self.axis_positions() * self.length[:, None])[..., None].expand(-1, -1, COLUMNS),
            ],
            3,
        ).flatten(1, 2)
        return self.start[:, None] + local @ self.frame.mT

    def contains(self, points: Float[Tensor, "m 3"], margin: float) -> Tensor:
        """(M,) whether points lie inside the mean body's part, deeper than about `margin` metres."""
        frame = self.frame.mean(0)
        local = (points - self.start.mean(0)) @ frame
        t = (local[:, 2] / self.length.mean()).numpy()
        where = np.linspace(0, 1, ROWS)
        a, b, c = (
            torch.from_numpy(np.interp(t, where, self.rings(v).mean(0).numpy())).to(points)
            for v in (self.width, self.depth, self.shift)
        )
        u = (local[:, 0] / (a - margin).clamp_min(1e-3)).abs() ** self.power
        v = ((local[:, 1] - c) / (b - margin).clamp_min(1e-3)).abs() ** self.power
        return (u + v < 1) & torch.from_numpy((t > 0) & (t < 1))


def loft_faces() -> np.ndarray:
    """(F, 3) triangles of a loft, counter-clockwise seen from outside."""
    rows = ROWS + 2 * (len(CAP) - 1)
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(COLUMNS), indexing="ij")
    a, b = r * COLUMNS + c, r * COLUMNS + (c + 1) % COLUMNS
    quads = np.stack([a, b, b + COLUMNS, a + COLUMNS], -1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
