"""Which colour image goes with which depth image, by their times."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from understudy.errors import RecordingError


def pair_nearest(
    a_s: Float[np.ndarray, " n"], b_s: Float[np.ndarray, " m"], tolerance_s: float
) -> list[tuple[int, int]]:
    """Pairs (i, j) of nearest times within a tolerance (seconds), each used once, nearest pairs first served.

    Both lists must ascend. The pairs come in the order of i.
    """
    first = np.searchsorted(b_s, a_s - tolerance_s, side="left")
    last = np.searchsorted(b_s, a_s + tolerance_s, side="right")
    candidates = sorted(
        (abs(float(a_s[i] - b_s[j])), i, j) for i in range(len(a_s)) for j in range(int(first[i]), int(last[i]))
    )
    free_a, free_b = np.ones(len(a_s), bool), np.ones(len(b_s), bool)
    pairs = []
    for _, i, j in candidates:
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return sorted(pairs)


def checked_times(times: object, n_frames: int, where: str) -> tuple[float, ...]:
    """A list of n ascending, finite numbers (seconds), or a RecordingError that names `where`."""
    if not isinstance(times, list) or any(isinstance(t, bool) or not isinstance(t, int | float) for t in times):
        raise RecordingError(f"{where} must be a list of numbers (seconds)")
    if len(times) != n_frames:
        raise RecordingError(f"{where} must have one number per frame: {len(times)} numbers, {n_frames} frames")
    if not np.isfinite(np.array(times, dtype=np.float64)).all():
        raise RecordingError(f"{where} must be finite")
    for i, (before, after) in enumerate(pairwise(times)):
        if not before < after:
            raise RecordingError(f"{where} must ascend: entry {i + 1} ({after:g}) is not after entry {i} ({before:g})")
    return tuple(float(t) for t in times)
