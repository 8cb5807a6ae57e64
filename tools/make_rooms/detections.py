"""Simulated 2D detections: what a good detector finds of people whose truth is known."""

from __future__ import annotations

from typing import Any

import common  # noqa: F401
import numpy as np
from common import Array, Rng
from numpy.typing import NDArray

# Jitter of seen joints in torso lengths.
SPREAD = np.array(
    [
        0.017,  # nose
        0.024,  # neck
        0.027,
        0.030,
        0.036,
        0.027,
        0.030,
        0.036,
        0.042,
        0.030,
        0.038,
        0.042,
        0.030,
        0.038,
        0.015,
        0.015,
        0.020,
        0.020,
    ]
)
MIRROR = np.array([0, 1, 5, 6, 7, 2, 3, 4, 11, 12, 13, 8, 9, 10, 15, 14, 17, 16])
LIMB_PAIRS = (((3, 6), (4, 7)), ((9, 12), (10, 13)))


def _scores(rng: Rng, error: Array, high: float) -> Array:
    return np.clip(rng.normal(high, 0.07, len(error)) - 0.9 * error, 0.08, 0.99)


def detect_person(
    uv: Array,
    seen: NDArray[np.bool_],
    inside: NDArray[np.bool_],
    torso: float,
    back: bool,
    others: list[Array],
    rng: Rng,
) -> Array | None:
    """Rows [u, v, score] of one person, or None where it is not found.

    `seen`: in the image and not hidden; `inside`: in the image; `torso`: neck to hips in pixels.
    """
    visible = int(seen.sum())
    if visible < 4 or (visible < 7 and rng.random() < 0.25):
        return None
    spread = SPREAD * np.exp(rng.normal(0.0, 0.22)) + 0.6 / torso
    heavy = rng.standard_t(5, size=(18, 2)) / np.sqrt(5 / 3)
    offset = heavy * spread[:, None]
    offset[[8, 11]] += rng.normal(0.0, 0.02, 2)  # where this detector puts this person's hips
    gross = rng.random(18) < 0.007
    offset[gross] += rng.normal(0.0, 0.25, (int(gross.sum()), 2))
    score = _scores(rng, np.linalg.norm(offset, axis=1), rng.uniform(0.78, 0.92))
    found = rng.random(18) > 0.012

    hidden = ~seen
    guess = rng.normal(size=(18, 2)) * rng.uniform(0.07, 0.145, (18, 1))  # 0.10 to 0.20 in length
    offset = np.where(hidden[:, None], guess, offset)
    sure = rng.random(18) < 0.22
    low = np.where(sure, rng.uniform(0.5, 0.88, 18), rng.uniform(0.12, 0.5, 18))
    score = np.where(hidden, low, score)
    lost = np.full(18, 0.5)
    lost[[0, 14, 15]] = 0.85
    found &= ~(hidden & (rng.random(18) < lost))
    out = uv + offset * torso
    for other in others:  # a hidden joint drawn to the same joint of someone near
        near = hidden & (np.linalg.norm(other - uv, axis=1) < 1.0 * torso) & (rng.random(18) < 0.08)
        out[near] = other[near] + rng.normal(0, 0.04, (int(near.sum()), 2)) * torso
    if seen[2] and seen[5] and found[2] and found[5]:  # the neck goes with the shoulders
        out[1] = 0.5 * (out[1] + 0.5 * (out[2] + out[5]))

    if back and rng.random() < 0.03:
        out, score, found = out[MIRROR], score[MIRROR], found[MIRROR]
        inside = inside[MIRROR]
    else:
        for pairs in LIMB_PAIRS:
            if rng.random() < 0.02:
                for a, b in pairs:
                    out[[a, b]], score[[a, b]], found[[a, b]] = out[[b, a]], score[[b, a]], found[[b, a]]
                    inside = inside.copy()
                    inside[[a, b]] = inside[[b, a]]
    rows = np.concatenate([out, score[:, None]], 1)
    rows[~(found & inside)] = 0.0
    return rows


def detect_frame(people: list[dict[str, Any]], k: Array, size: tuple[int, int], rng: Rng) -> list[dict[str, Any]]:
    """The entry of one frame in keypoints2d.json, people in any order."""
    places, found = [], []
    for p in people:
        xyz = np.array(p["keypoints"])
        uvw = xyz @ k.T
        places.append(uvw[:, :2] / np.where(np.abs(uvw[:, 2:]) < 0.05, 0.05, uvw[:, 2:]))
    for i, p in enumerate(people):
        xyz = np.array(p["keypoints"])
        inside = np.array(p["in_view"])
        seen = inside & ~np.array(p["occluded"])
        hips = 0.5 * (xyz[8] + xyz[11])
        length = float(np.linalg.norm(xyz[1] - hips))
        flat = float(np.linalg.norm(places[i][1] - 0.5 * (places[i][8] + places[i][11])))
        torso = max(flat, 0.6 * k[0, 0] * length / max(float(hips[2]), 0.4))
        torso = min(torso, 1.4 * k[0, 0] * length / max(float(hips[2]), 0.4))
        back = bool(places[i][2, 0] > places[i][5, 0])
        others = [q for j, q in enumerate(places) if j != i]
        rows = detect_person(places[i], seen, inside, torso, back, others, rng)
        if rows is None or (rows[:, 2] > 0).sum() < 3:
            continue
        ok = (rows[:, :2] >= -0.5).all(1) & (rows[:, 0] < size[0] - 0.5) & (rows[:, 1] < size[1] - 0.5)
        rows[~ok] = 0.0
        found.append({"keypoints": [[round(float(u), 2), round(float(v), 2), round(float(c), 3)] for u, v, c in rows]})
    order = rng.permutation(len(found))
    return [found[j] for j in order]
