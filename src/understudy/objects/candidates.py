"""Articulations through a few poses of a track: the random starts of a robust fit (RANSAC, Fischler & Bolles 1981)."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE
from understudy.objects.motion import Hypotheses, Measured

_DRAWS: Final = 30  # with 40 % of the poses outliers, 30 draws of three all miss with a chance of 6e-4
_LEAST_TURN: Final = 0.02  # radians: below, the axis of a rotation is noise
_PAIRS: Final = np.array([[0, 1], [0, 2], [1, 2]])  # of three


def candidates(kind: str, m: Measured, random: np.random.Generator) -> Hypotheses:
    """Articulations of one kind; at least one."""
    n = len(m)
    nowhere = _through(kind, m, np.zeros(1, int), np.array([[1.0, 0, 0]]), m.p[:1])
    if kind == FIXED:
        picks = random.choice(n, min(n, _DRAWS), replace=False)
        return _through(kind, m, picks, np.tile([1.0, 0, 0], (len(picks), 1)), m.p[picks])
    three = np.stack([random.choice(n, 3, replace=False) for _ in range(_DRAWS)])
    found = [_lines(m, three)] if kind == PRISMATIC else [_hinges(m, three), _circles(m, three)]
    some = [h for h in found if len(h.p)]
    return _joined(some) if some else nowhere


def _through(
    kind: str,
    m: Measured,
    i: Int[np.ndarray, " b"],
    direction: Float[np.ndarray, "b 3"],
    point: Float[np.ndarray, "b 3"],
) -> Hypotheses:
    return Hypotheses(kind, m.R[i], m.p[i], direction, point)


def _joined(all: list[Hypotheses]) -> Hypotheses:
    R, p, direction, point = (np.concatenate([getattr(h, x) for h in all]) for x in ("R", "p", "direction", "point"))
    return Hypotheses(all[0].kind, R, p, direction, point)


def _longest(
    ways: Float[np.ndarray, "b 3 3"], three: Int[np.ndarray, "b 3"], least: float
) -> tuple[Int[np.ndarray, "c 2"], Float[np.ndarray, "c 3"], Float[np.ndarray, " c"]]:
    """Of the ways between the pairs of three poses the longest, if it is no shorter than the least: both poses, unit
    vector and length.
    """
    lengths = np.linalg.norm(ways, axis=2)
    draw, pair = np.arange(len(three)), lengths.argmax(axis=1)
    good = lengths[draw, pair] >= least
    draw, pair = draw[good], pair[good]
    length = lengths[draw, pair]
    return three[draw[:, None], _PAIRS[pair]], ways[draw, pair] / length[:, None], length


def _lines(m: Measured, three: Int[np.ndarray, "b 3"]) -> Hypotheses:
    """Through two positions, the two of three that lie farthest apart."""
    pairs = three[:, _PAIRS]
    ends, direction, _ = _longest(m.p[pairs[..., 1]] - m.p[pairs[..., 0]], three, 1e-6)
    return _through(PRISMATIC, m, ends[:, 0], direction, m.p[ends[:, 0]])


def _hinges(m: Measured, three: Int[np.ndarray, "b 3"]) -> Hypotheses:
    """The screw axis between two poses, of three those with the greatest turn; the way along it is left out."""
    pairs = three[:, _PAIRS]
    turns = Rotation.from_matrix((m.R[pairs[..., 1]] @ m.R[pairs[..., 0]].swapaxes(-1, -2)).reshape(-1, 3, 3))
    vectors = turns.as_rotvec().reshape(-1, 3, 3) * m.oriented[pairs].all(axis=2)[..., None]
    ends, a, angle = _longest(vectors, three, _LEAST_TURN)
    first, second = m.p[ends.T]
    chord = second - first
    chord = chord - a * (a * chord).sum(axis=1, keepdims=True)
    point = first + chord / 2 + np.cross(a, chord) / (2 * np.tan(angle / 2))[:, None]
    return _through(REVOLUTE, m, ends[:, 0], a, point)


def _circles(m: Measured, three: Int[np.ndarray, "b 3"]) -> Hypotheses:
    """Through three positions."""
    a, b, c = m.p[three.T]
    u, v = b - a, c - a
    u2, v2 = ((x**2).sum(axis=1, keepdims=True) for x in (u, v))
    normal = np.cross(u, v)
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    good = (size >= 1e-6 * np.maximum(u2, 1e-12))[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = a + (np.cross(normal, u) * v2 - np.cross(normal, v) * u2) / (2 * size**2)
        direction = normal / size  # either way round: the sign is settled later
    return _through(REVOLUTE, m, three[good, 0], direction[good], centre[good])
