"""Articulations through a few poses of a track: the random starts of a robust fit (RANSAC, Fischler & Bolles 1981)."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from understudy.geometry import rigid
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation
from understudy.objects.motion import Measured

_DRAWS: Final = 30  # with 40 % of the poses outliers, 30 draws of three all miss with a chance of 6e-4
_LEAST_TURN: Final = 0.02  # radians: below, the axis of a rotation is noise


def candidates(kind: str, m: Measured, random: np.random.Generator) -> list[Articulation]:
    """Articulations of one kind; at least one."""
    n = len(m)
    if kind == FIXED:
        picks = random.choice(n, min(n, _DRAWS), replace=False)
        return [_rest(kind, m, int(i), np.array([1.0, 0, 0])) for i in picks]
    found = []
    for _ in range(_DRAWS):
        picks = random.choice(n, 3, replace=False)
        found += [_line(m, picks)] if kind == PRISMATIC else [_hinge(m, picks), _circle(m, picks)]
    through = [a for a in found if a is not None]
    return through or [_rest(kind, m, 0, np.array([1.0, 0, 0]))]


def _rest(kind: str, m: Measured, i: int, direction: np.ndarray, point: np.ndarray | None = None) -> Articulation:
    return Articulation(kind, rigid(m.R[i], m.p[i]), direction, m.p[i] if point is None else point, (0.0, 0.0))


def _line(m: Measured, picks: np.ndarray) -> Articulation | None:
    """Through two positions, the two of three that lie farthest apart."""
    pairs = picks[[[0, 1], [0, 2], [1, 2]]]
    ways = m.p[pairs[:, 1]] - m.p[pairs[:, 0]]
    lengths = np.linalg.norm(ways, axis=1)
    longest = int(np.argmax(lengths))
    if lengths[longest] < 1e-6:
        return None
    return _rest(PRISMATIC, m, int(pairs[longest, 0]), ways[longest] / lengths[longest])


def _hinge(m: Measured, picks: np.ndarray) -> Articulation | None:
    """The screw axis between two poses, of three those with the greatest turn; the way along it is left out."""
    picks = picks[m.oriented[picks]]
    if len(picks) < 2:
        return None
    pairs = np.array([(i, j) for k, i in enumerate(picks) for j in picks[k + 1 :]])
    turns = Rotation.from_matrix(m.R[pairs[:, 1]] @ m.R[pairs[:, 0]].transpose(0, 2, 1)).as_rotvec()
    angles = np.linalg.norm(turns, axis=1)
    most = int(np.argmax(angles))
    angle = float(angles[most])
    if angle < _LEAST_TURN:
        return None
    i, j = (int(x) for x in pairs[most])
    a = turns[most] / angle
    chord = m.p[j] - m.p[i]
    chord = chord - a * (a @ chord)
    point = m.p[i] + chord / 2 + np.cross(a, chord) / (2 * np.tan(angle / 2))
    return _rest(REVOLUTE, m, i, a, point)


def _circle(m: Measured, picks: np.ndarray) -> Articulation | None:
    """Through three positions."""
    a, b, c = m.p[picks]
    u, v = b - a, c - a
    normal = np.cross(u, v)
    size = float(np.linalg.norm(normal))
    if size < 1e-6 * max(float(u @ u), 1e-12):
        return None
    centre = a + (np.cross(normal, u) * (v @ v) - np.cross(normal, v) * (u @ u)) / (2 * size**2)
    # the greater angle, measured from the first, is positive: only a guess, the sign is settled later
    return _rest(REVOLUTE, m, int(picks[0]), normal / size, centre)
