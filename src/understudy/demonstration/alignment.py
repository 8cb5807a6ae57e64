"""Several demonstrations of one task on one time: the phase, which runs through reach, manipulate and release alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from understudy.demonstration.demonstration import Demonstration, Segments
from understudy.errors import UnderstudyError
from understudy.geometry import inverse

N_SEGMENTS = 3


def phase(times_s: Float[np.ndarray, " t"], segments: Segments) -> Float[np.ndarray, " t"]:
    """0 to 1 in reach, 1 to 2 in manipulate, 2 to 3 in release: linear in time within each."""
    borders = [times_s[0], times_s[segments.grasp], times_s[min(segments.release, len(times_s) - 1)], times_s[-1]]
    return np.asarray(np.interp(times_s, _increasing(borders), np.arange(N_SEGMENTS + 1.0)))


def _increasing(borders: Sequence[float]) -> Float[np.ndarray, " n"]:
    """An empty segment (a recording that begins at the grasp) gets no length, but keeps its place."""
    return np.maximum.accumulate(np.asarray(borders) + 1e-9 * np.arange(len(borders)))


@dataclass(frozen=True, eq=False)
class Aligned:
    """d demonstrations at p common phases, in the frame of the object at rest."""

    phase: Float[np.ndarray, " p"]
    T_rest_hand: Float[np.ndarray, "d p 4 4"]
    """NaN where the hand is not known"""
    torso: Float[np.ndarray, "d p 3"]
    """x, y (metres) and yaw (radians) in the floor frame below the object at rest: x as the handle's x, level"""
    way: Float[np.ndarray, "d p"]
    """how far the object is along its articulation: metres or radians"""
    durations_s: Float[np.ndarray, "d 3"]


def align(demonstrations: Sequence[Demonstration], samples_per_segment: int = 50) -> Aligned:
    """The demonstrations at common phases. Raises UnderstudyError if there is none."""
    if not demonstrations:
        raise UnderstudyError("align: needs at least one demonstration")
    at = np.linspace(0, N_SEGMENTS, N_SEGMENTS * samples_per_segment + 1)
    hands, torsos, ways, durations = [], [], [], []
    for demo in demonstrations:
        own = phase(demo.times_s, demo.segments)
        T_rest_world = inverse(demo.articulation.T_rest)
        hands.append(_interpolated(own, T_rest_world @ demo.hand.T_world_x, at))
        torsos.append(_columns(own, on_floor(demo.articulation.T_rest, demo.torso.xy_yaw), at))
        q = np.full(len(demo), np.nan)
        known = demo.object.known
        q[known] = demo.articulation.position(demo.object.T_world_x[known])
        ways.append(_columns(own, q[:, None], at)[:, 0])
        borders = np.interp(np.arange(N_SEGMENTS + 1.0), own, demo.times_s)
        durations.append(np.diff(borders))
    return Aligned(at, np.stack(hands), np.stack(torsos), np.stack(ways), np.stack(durations))


def floor_frame(T_world_handle: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """x, y and yaw of the frame on the floor below a handle, whose x is level and points as the handle's."""
    x = T_world_handle[:3, 0]
    return np.array([*T_world_handle[:2, 3], np.arctan2(x[1], x[0])])


def on_floor(T_world_handle: Float[np.ndarray, "4 4"], xy_yaw: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Planar poses (world) in the floor frame below a handle."""
    x, y, yaw = floor_frame(T_world_handle)
    c, s = np.cos(yaw), np.sin(yaw)
    dx, dy = xy_yaw[:, 0] - x, xy_yaw[:, 1] - y
    turned = xy_yaw[:, 2] - yaw
    finite = turned[np.isfinite(turned)]
    if len(finite):  # the whole track by full turns, so that demonstrations can be compared
        turned = turned - 2 * np.pi * np.round(finite[len(finite) // 2] / (2 * np.pi))
    return np.column_stack([c * dx + s * dy, -s * dx + c * dy, turned])


def _columns(own: Float[np.ndarray, " t"], values: Float[np.ndarray, "t k"], at: Float[np.ndarray, " p"]) -> np.ndarray:
    """Linear interpolation; NaN beyond the first and last known value."""
    out = np.full((len(at), values.shape[1]), np.nan)
    known = np.isfinite(values).all(axis=1)
    if known.any():
        for k in range(values.shape[1]):
            out[:, k] = np.interp(at, own[known], values[known, k], left=np.nan, right=np.nan)
    return out


def _interpolated(
    own: Float[np.ndarray, " t"], T: Float[np.ndarray, "t 4 4"], at: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "p 4 4"]:
    """Poses at other phases; NaN beyond the first and last known one."""
    out = np.full((len(at), 4, 4), np.nan)
    known = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)))
    known = known[np.concatenate([[True], np.diff(own[known]) > 0])] if len(known) else known
    if len(known) < 2:
        return out
    inside = (at >= own[known[0]]) & (at <= own[known[-1]])
    out[inside] = np.eye(4)
    out[inside, :3, :3] = Slerp(own[known], Rotation.from_matrix(T[known, :3, :3]))(at[inside]).as_matrix()
    out[inside, :3, 3] = _columns(own[known], T[known, :3, 3], at[inside])
    return out
