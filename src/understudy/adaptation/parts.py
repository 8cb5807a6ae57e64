"""The moving part: where it goes, its outline from above, to which side it swings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy import lie
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.fields import half_planes
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.scene_map import HEIGHTS
from understudy.objects.articulation import PRISMATIC, REVOLUTE

_PANEL_SPACING_M: Final = 0.08
_BEYOND_HANDLE_M: Final = 0.08  # a door goes on behind its handle
_FRONT_HALF_M: Final = 0.2  # half width of a drawer's front; the data does not give it
_UPRIGHT: Final = 0.9  # cosine: an axis that counts as vertical
_TURNING: Final = np.radians(15)  # of the part about its bar, from the grasp to the release: less is none


def object_path(demonstration: Demonstration) -> Float[np.ndarray, "t 4 4"]:
    """The object's poses at all samples: where they are not known, on the articulation, q interpolated."""
    d = demonstration
    T, known = d.object.T_world_x.copy(), d.object.known
    if not known.any():
        raise InfeasibleError(f"demonstration of {d.task!r}: the object's pose is not known at any sample")
    if not known.all():
        q = d.articulation.position(T[known])
        T[~known] = d.articulation.pose(np.interp(d.times_s[~known], d.times_s[known], q))
    return T


def panel_path(demonstration: Demonstration, T_object: Float[np.ndarray, "t 4 4"]) -> Float[np.ndarray, "t m 2"]:
    """Points of the moving part from above, for the base to keep clear of: those that were seen, thinned out.

    Where none were seen: of a door about an upright axis, a thin plate from the axis to a little beyond the handle; of
    a part that slides out (drawer), a front of 40 cm; of others nothing.
    """
    if len(_in_the_way(demonstration)):
        return _seen_panel(demonstration, T_object)
    a, t = demonstration.articulation, len(T_object)
    out = T_object[:, :3, 0]
    front = T_object[:, :3, 3] - demonstration.handle.standoff_m * out
    along = np.column_stack([-out[:, 1], out[:, 0]])  # level, in the front
    if a.kind == REVOLUTE and abs(a.direction[2]) > _UPRIGHT:
        axis = a.point[:2]
        way = front[:, :2] - axis
        length = np.linalg.norm(way, axis=1, keepdims=True)
        end = 1 + _BEYOND_HANDLE_M / np.maximum(length, 1e-6)
        n = max(2, int(np.ceil(length.max() / _PANEL_SPACING_M)) + 1)
        shares = np.linspace(0, 1, n)[None, :, None] * end[:, None]
        return axis + shares * way[:, None]
    if a.kind == PRISMATIC and abs(float(a.direction @ out[0])) > np.sqrt(0.5):
        n = int(np.ceil(2 * _FRONT_HALF_M / _PANEL_SPACING_M)) + 1
        places = np.linspace(-_FRONT_HALF_M, _FRONT_HALF_M, n)
        return front[:, None, :2] + places[None, :, None] * along[:, None]
    return np.full((t, 1, 2), np.nan)


def _in_the_way(demonstration: Demonstration) -> Float[np.ndarray, "n 3"]:
    """The part's points at heights that count for a map, too: what hangs above or lies below is in no base's way."""
    part = demonstration.part.astype(np.float64)
    T = demonstration.articulation.T_rest
    height = part @ T[2, :3] + T[2, 3]
    return np.asarray(part[(height > HEIGHTS[0]) & (height < HEIGHTS[1])])


def _seen_panel(demonstration: Demonstration, T_object: Float[np.ndarray, "t 4 4"]) -> Float[np.ndarray, "t m 2"]:
    """One point per cell of a grid, seen from above with the part at rest."""
    part = _in_the_way(demonstration)
    rest = part @ demonstration.articulation.T_rest[:2, :3].T
    _, first = np.unique(np.round(rest / _PANEL_SPACING_M), axis=0, return_index=True)
    R, p = T_object[:, :2, :3], T_object[:, None, :2, 3]
    return p + part[first] @ np.swapaxes(R, 1, 2)


def beside_part(
    panel: Float[np.ndarray, "t m 2"], polygon: Float[np.ndarray, "k 2"], base: Float[np.ndarray, "t 3"]
) -> Bool[np.ndarray, " t"]:
    """Whether no point of the moving part (world, from above; NaN: none) is above the footprint, exactly."""
    inverse = lie.se3_inverse(lie.se2_to_se3(base))
    local = panel @ np.swapaxes(inverse[:, :2, :2], 1, 2) + inverse[:, None, :2, 3]
    normals, offsets = half_planes(polygon)
    return np.asarray(~((local @ normals.T - offsets).max(axis=2) < 0).any(axis=1))


def mirrored_sides(demonstrations: Sequence[Demonstration]) -> Bool[np.ndarray, " d"]:
    """Which demonstrations are of a part that turns about its bar the other way than in the first that turns.

    A door that is hung on the other side is the mirror image of the first: so is the way to hold it.
    """
    turns = np.zeros(len(demonstrations))
    for i, d in enumerate(demonstrations):
        T = object_path(d)
        turn = lie.so3_log(T[d.segments.grasp, :3, :3].T @ T[d.segments.release - 1, :3, :3])
        if abs(turn[2]) > max(_TURNING, np.linalg.norm(turn[:2])):
            turns[i] = np.sign(turn[2])
    first = next((t for t in turns if t), 0.0)
    return np.asarray(turns * first < 0)


def front_heading(demonstration: Demonstration) -> float:
    """Radians, world: straight towards the object's front where the hand takes hold of it."""
    out = object_path(demonstration)[demonstration.segments.grasp, :2, 0]
    return float(np.arctan2(-out[1], -out[0]))
