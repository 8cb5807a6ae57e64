"""The manipulated object as a demonstration needs it: where its handle is over time, how it moves, how it looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError
from understudy.objects.articulation import FIXED, Articulation, Handle
from understudy.objects.fit import fit_articulation
from understudy.objects.motion import position_of
from understudy.objects.moving_part import HandHint, find_moving_part
from understudy.trajectories import PoseTrack
from understudy.types import Person, RegisteredFrame

USUAL_HANDLE: Final = Handle(length_m=0.12, radius_m=0.008, standoff_m=0.035)
"""Of an object that is followed by markers, which say nothing about its shape."""

_LEAST_SEEN = 8  # samples
_AWAY = 0.25  # metres of a hand from the handle: it does not hold it
_MOVED = 0.03  # metres of the handle from where it rested
_ROUGH = 1e-6  # of a covariance, relative: keeps it invertible


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """The object over time, world."""

    track: PoseTrack
    """of the handle's frame"""
    articulation: Articulation
    handle: Handle
    part: Float[np.ndarray, "n 3"]
    """points of the moving part, handle's frame; none where only markers are known"""
    evidence: float
    """how strongly the images speak for it: to compare tracks of one recording"""


def by_depth(
    frames: Sequence[RegisteredFrame],
    people: Sequence[Sequence[Person]],
    T_world_cam: Float[np.ndarray, "4 4"],
    hint: HandHint,
) -> ObjectTrack:
    """Without markers (`objects.moving_part`). Raises UnderstudyError when nothing moves."""
    found = find_moving_part(frames, people, T_world_cam, hint)
    if found.articulation.kind == FIXED:
        raise UnderstudyError("nothing that the hand was at has moved: no door, no drawer, no sliding front")
    return ObjectTrack(
        found.track, found.articulation, found.handle, found.part_points, found.quality.get("evidence_m2", 0.0)
    )


def by_markers(measured: PoseTrack) -> ObjectTrack:
    """From the track of a marker on the moving part: its articulation is fitted, and its poses are put onto it.

    Raises UnderstudyError when the marker was hardly seen, or does not move.
    """
    seen = np.flatnonzero(measured.observed)
    if len(seen) < _LEAST_SEEN:
        raise UnderstudyError(f"the object's marker was seen in {len(seen)} frames; {_LEAST_SEEN} are needed")
    fit = fit_articulation(measured.T_world_x, np.where(np.isfinite(measured.covariance), measured.covariance, 0.0))
    articulation = fit.articulation
    if articulation.kind == FIXED:
        raise UnderstudyError("the object's marker does not move")
    keep = seen[fit.inlier[seen]]
    q, sigma = position_of(articulation, measured.T_world_x[keep], measured.covariance[keep])
    n = len(measured)
    T, covariance = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.nan)
    T[keep] = articulation.pose(q)
    covariance[keep] = _along(articulation, q, sigma) + _ROUGH * np.eye(6)
    observed = np.zeros(n, bool)
    observed[keep] = True
    return ObjectTrack(
        PoseTrack(T, covariance, observed, observed.copy()), articulation, USUAL_HANDLE, np.zeros((0, 3)), len(keep)
    )


def untouched(object: PoseTrack, hand: PoseTrack) -> PoseTrack:
    """The object's track with its pose at rest where it was not seen before the hand came to it: nothing else moves it.

    Up to the last sample at which a hand was seen away from it, before one is seen at it or the object has moved.
    """
    known = object.known
    if not known.any():
        return object
    first = int(np.argmax(known))
    rest = object.T_world_x[first]
    away = np.linalg.norm(hand.positions - rest[:3, 3], axis=1) > _AWAY
    moved = known & (np.linalg.norm(object.positions - rest[:3, 3], axis=1) > _MOVED)
    touched = np.logical_or.accumulate(moved | (hand.observed & ~away))
    still = np.flatnonzero(hand.observed & away & ~touched)
    last = int(still[-1]) if len(still) else -1
    fill = ~known & (np.arange(len(known)) <= last)
    T, covariance = object.T_world_x.copy(), object.covariance.copy()
    T[fill], covariance[fill] = rest, object.covariance[first]
    return PoseTrack(T, covariance, object.observed, object.oriented)


def _along(
    articulation: Articulation, q: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of poses whose only uncertainty is where along the articulation they are."""
    step = 1e-4
    a, b = articulation.pose(q - step), articulation.pose(q + step)
    J = np.zeros((len(q), 6))
    J[:, :3] = (b[:, :3, 3] - a[:, :3, 3]) / (2 * step)
    if articulation.radius_m > 0:
        J[:, 3:] = articulation.direction
    return np.asarray(sigma[:, None, None] ** 2 * J[:, :, None] * J[:, None, :])
