"""The shape of a part whose motion is known (from markers): what stays in its place as seen from the part.

Without markers shape and motion are found together (`objects.moving_part`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from understudy.demonstration.scene_map import VOXEL, View, Votes, seen_through, stays, votes, without_specks
from understudy.geometry import inverse, transform_points

_MOVED: Final = 2.5 * VOXEL  # metres of a place from where it was at rest: enough to tell it from what stands still
_LOOKS: Final = 2  # that must have found it when it had moved
_LEFT: Final = 0.5  # share of these looks that found it where nothing stands still
_APART: Final = 3 * VOXEL  # metres between pieces
_FARTHEST: Final = 1.6  # metres from the handle that a part goes on


def part_points(
    views: Sequence[View], T_world_cam: Float[np.ndarray, "4 4"], T_world_part: Float[np.ndarray, "k 4 4"]
) -> Float[np.ndarray, "n 3"]:
    """Points of the part in its own frame, one for each voxel.

    T_world_part: at each view, NaN where it is not known; the first that is known is where it rests. A place belongs to
    the part when most looks at it found a surface, also most of those after it had moved, and when nothing that stands
    still explains that: it was found where nothing does, or where it rested the view is open since. (A door that was
    opened once stands still like a wall, where nobody could look before; but it is not where it was.) Of a front
    that slides along its own plane, what covers its old place looks the same from both, and is left out.
    """
    known = np.isfinite(T_world_part).all(axis=(1, 2))
    T = T_world_part[known]
    if len(T) < _LOOKS + 1:
        return np.zeros((0, 3))
    looks = [view for view, use in zip(views, known, strict=True) if use]
    seen = _near(votes(looks, np.stack([inverse(t) for t in T]) @ T_world_cam))
    places = np.stack([transform_points(t, seen.center) for t in T], axis=1)
    moved = np.linalg.norm(places - places[:, :1], axis=2) > _MOVED
    found = seen.hit & moved
    world = votes(views, np.broadcast_to(T_world_cam, (len(views), 4, 4)))
    left = found & ~_beside(world.center[world.stays], places)
    own = seen.stays & stays(found, seen.through & moved)
    elsewhere = left.sum(axis=1) >= _LEFT * found.sum(axis=1)
    own &= (found.sum(axis=1) >= _LOOKS) & (elsewhere | _gone(looks, T_world_cam, seen.hit, places[:, 0], moved))
    return _largest(without_specks(seen.center[own]))


def _gone(
    looks: Sequence[View],
    T_world_cam: Float[np.ndarray, "4 4"],
    hit: Bool[np.ndarray, "n k"],
    rest: Float[np.ndarray, "n 3"],
    moved: Bool[np.ndarray, "n k"],
) -> Bool[np.ndarray, " n"]:
    """Which of n places were found at rest (`rest`: there, world), where looks went through when they had moved."""
    own = transform_points(inverse(T_world_cam), rest)
    through = np.stack([seen_through(view.depth, own) for view in looks], axis=1)
    return np.asarray((hit & ~moved).any(axis=1) & ((through & moved).sum(axis=1) >= _LOOKS))


def _largest(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The largest of the pieces that are apart."""
    if not len(points):
        return points
    pairs = cKDTree(points).query_pairs(_APART, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    piece = connected_components(linked, directed=False)[1]
    return np.asarray(points[piece == np.argmax(np.bincount(piece))])


def _near(seen: Votes) -> Votes:
    """Those voxels that are not too far from the handle."""
    near = np.linalg.norm(seen.center, axis=1) < _FARTHEST
    return Votes(seen.center[near], seen.hit[near], seen.through[near])


def _beside(still: Float[np.ndarray, "m 3"], places: Float[np.ndarray, "n k 3"]) -> Bool[np.ndarray, "n k"]:
    """Which places are where something stands still."""
    if not len(still):
        return np.zeros(places.shape[:2], bool)
    away = cKDTree(still).query(places.reshape(-1, 3), distance_upper_bound=VOXEL)[0]
    return np.asarray(away < VOXEL).reshape(places.shape[:2])
