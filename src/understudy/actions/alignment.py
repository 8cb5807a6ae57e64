"""Demonstrations warped onto one of them, so that what happens at one phase is alike (dynamic time warping)."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.actions.features import Chart
from understudy.actions.segments import SegmentPath

_GRID: Final = 60  # phases at which paths are compared
_BAND: Final = 0.3  # of the phase: how far a warp may go
_STEP: Final = 0.15  # of the mean cost, for every step that is not diagonal: warps without need are not worth it
_SMOOTH: Final = 0.06  # of the phase: width of the window that smooths a warp


def aligned(paths: list[SegmentPath]) -> list[SegmentPath]:
    """The same paths with other phases: those of the most central path at the moments that are most alike."""
    if len(paths) < 2:
        return paths
    grid = np.linspace(0, 1, _GRID)
    chart = Chart.at_mean([path.poses for path in paths])
    curves = np.array([_on_grid(path, chart, grid) for path in paths])
    curves /= np.maximum(curves.std(axis=(0, 1)), 1e-3)  # features that hardly change hardly count
    apart = np.linalg.norm(curves[:, None] - curves[None], axis=3).sum(axis=2)
    central = int(apart.sum(axis=1).argmin())
    out = []
    for i, path in enumerate(paths):
        warp = grid if i == central else _warp(curves[central], curves[i], grid)
        out.append(SegmentPath(path.poses, np.interp(path.phase, grid, warp), path.duration_s))
    return out


def _on_grid(path: SegmentPath, chart: Chart, grid: np.ndarray) -> Float[np.ndarray, "g 10"]:
    y = chart.features(path.poses)
    return np.column_stack([np.interp(grid, path.phase, column) for column in y.T])


def _warp(reference: np.ndarray, curve: np.ndarray, grid: np.ndarray) -> Float[np.ndarray, " g"]:
    """Phase of the reference at each phase of the curve: 0 to 1, never falling."""
    n = len(grid)
    # without offsets: of a path that runs beside another one, the moments side by side are alike
    cost = np.linalg.norm(_centred(curve)[:, None] - _centred(reference)[None], axis=2)
    cost[np.abs(grid[:, None] - grid) > _BAND] = np.inf
    extra = _STEP * float(cost[np.isfinite(cost)].mean())
    total = np.full((n + 1, n + 1), np.inf)
    total[0, 0] = 0.0
    for i in range(n):
        for j in range(n):
            total[i + 1, j + 1] = cost[i, j] + min(total[i, j], total[i, j + 1] + extra, total[i + 1, j] + extra)
    i = j = n
    matches: list[list[float]] = [[] for _ in range(n)]
    while i > 0 and j > 0:
        matches[i - 1].append(grid[j - 1])
        steps = (total[i - 1, j - 1], total[i - 1, j] + extra, total[i, j - 1] + extra)
        best = int(np.argmin(steps))
        i, j = i - (best != 2), j - (best != 1)
    ahead = np.array([np.mean(m) for m in matches]) - grid
    half = int(_SMOOTH * n)
    ahead = np.convolve(np.pad(ahead, half, mode="edge"), np.ones(2 * half + 1) / (2 * half + 1), mode="valid")
    warp = np.maximum.accumulate(np.clip(grid + ahead, 0, 1))
    warp = (warp - warp[0]) / (warp[-1] - warp[0])
    return np.asarray(warp)


def _centred(curve: np.ndarray) -> np.ndarray:
    """From the middle between its ends, which does not depend on when the curve is where, as its mean would."""
    return np.asarray(curve - (curve[0] + curve[-1]) / 2)
