"""Poses of the handle's frame over time, from where the part is on its articulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation, Handle
from understudy.objects.moving_part.part import MovingPart
from understudy.trajectories import PoseTrack


def at_handle(a: Articulation, T_rest: np.ndarray, q: np.ndarray) -> Articulation:
    """The same motion of the handle's frame."""
    origin = T_rest[:3, 3]
    point = origin if a.kind == PRISMATIC else a.point + a.direction * ((origin - a.point) @ a.direction)
    return Articulation(a.kind, T_rest, a.direction, point, (float(q.min()), float(q.max())))


def reversed_(a: Articulation) -> Articulation:
    return replace(a, direction=-a.direction, range=(-a.range[1], -a.range[0]))


def pose_track(
    a: Articulation, q: np.ndarray, sigma_q: np.ndarray, observed: np.ndarray, handle_sigma_m: float
) -> PoseTrack:
    """Poses on the articulation; covariance from q along the motion, and of where the handle is on the part."""
    t = len(q)
    covariance = np.zeros((t, 6, 6))
    covariance[:, :3, :3] = np.eye(3) * (handle_sigma_m**2 + 0.003**2)
    covariance[:, 3:, 3:] = np.eye(3) * np.radians(1.0) ** 2
    T = a.pose(q)
    tangent = np.zeros((t, 6))
    if a.kind == PRISMATIC:
        tangent[:, :3] = a.direction
    elif a.kind == REVOLUTE:
        tangent[:, :3] = np.cross(a.direction, T[:, :3, 3] - a.point)
        tangent[:, 3:] = a.direction
    covariance += sigma_q[:, None, None] ** 2 * tangent[:, :, None] * tangent[:, None, :]
    return PoseTrack(T, covariance, observed, observed.copy())


def at_rest(T_rest: np.ndarray, handle: Handle, seen: bool, points: np.ndarray, usable: np.ndarray) -> MovingPart:
    """What nobody moves. seen: whether the handle was."""
    t = len(usable)
    articulation = Articulation(FIXED, T_rest, T_rest[:3, 0], T_rest[:3, 3], (0.0, 0.0))
    track = pose_track(articulation, np.zeros(t), np.zeros(t), usable.copy(), handle_sigma_m=0.01 if seen else 0.05)
    quality = {"agreement": 0.0, "evidence_m2": 0.0, "runner_up_m2": 0.0, "hand_spread_m": 0.0}
    return MovingPart(
        track, articulation, handle, np.zeros(t), np.zeros(t), (0, 0), points, quality | {"handle_seen": float(seen)}
    )
