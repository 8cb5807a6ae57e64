"""From demonstrations to the data of the graph: targets with covariances, the object's path, obstacles around."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy import lie
from understudy.adaptation.around import Around, part_around, points_around
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.fields import DistanceField, obstacle_field, unknown_field
from understudy.adaptation.parts import mirrored_sides, object_path, panel_path
from understudy.adaptation.problem import Problem, Surroundings
from understudy.demonstration.demonstration import Demonstration, OccupancyMap

_UNORIENTED: Final = 1.5  # radians: of a rotation that was not measured
_SCENE_CELL_M: Final = 0.04
_SCENE_AROUND_M: Final = 0.7
_FLOOR_M: Final = 0.05  # points below are floor
_FAR_M: Final = 0.2  # from the running median: an outlier, for the first guess only
_APPROACH_S: Final = 0.5
_SPEED_S: Final = 0.15
_AROUND: Final = 5  # samples to either side


def hand_targets(
    demonstration: Demonstration, T_hand_tool: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "t 4 4"], Float[np.ndarray, "t 6 6"]]:
    """H X, NaN where the hand was not observed, and its covariance in the tangent space of H X.

    A track's covariance is of (dp, dr) along the world's axes, with R_true = Exp(dr) R. The tool lies off the hand's
    origin, so a rotation moves it: M = R_tool' [1, -hat(R_hand x); 0, 1].
    """
    hand = demonstration.hand
    use = hand.observed & hand.known
    H = np.where(use[:, None, None], hand.T_world_x, np.eye(4))
    T = H @ T_hand_tool
    covariance = np.where(use[:, None, None], hand.covariance, np.eye(6))
    blind = ~hand.oriented
    covariance[blind, :3, 3:] = covariance[blind, 3:, :3] = 0
    covariance[blind, 3:, 3:] = _UNORIENTED**2 * np.eye(3)
    back = np.swapaxes(T[:, :3, :3], 1, 2)
    M = np.zeros((len(T), 6, 6))
    M[:, :3, :3] = M[:, 3:, 3:] = back
    M[:, :3, 3:] = -back @ lie.hat((H[:, :3, :3] @ T_hand_tool[:3, 3:])[..., 0])
    T[~use] = np.nan
    return T, M @ covariance @ np.swapaxes(M, 1, 2)


def base_targets(
    demonstration: Demonstration, torso_base: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3 3"]]:
    """P Y, NaN where the torso was not observed, and its covariance in the tangent space of P Y."""
    torso = demonstration.torso
    use = torso.observed & torso.known
    P = np.where(use[:, None], torso.xy_yaw, 0.0)
    target = lie.se2_compose(P, np.broadcast_to(torso_base, P.shape))
    lever = target[:, :2] - P[:, :2]
    M = np.tile(np.eye(3), (len(P), 1, 1))
    M[:, 0, 2], M[:, 1, 2] = -lever[:, 1], lever[:, 0]
    c, s = np.cos(target[:, 2]), np.sin(target[:, 2])
    back = np.tile(np.eye(3), (len(P), 1, 1))
    back[:, 0, 0], back[:, 0, 1], back[:, 1, 0], back[:, 1, 1] = c, s, -s, c
    M = back @ M
    covariance = np.where(use[:, None, None], torso.covariance, np.eye(3))
    target[~use] = np.nan
    return target, M @ covariance @ np.swapaxes(M, 1, 2)


def scene_field(demonstration: Demonstration) -> DistanceField | None:
    """Distances to the scene's points around where the hand goes; None without points."""
    hand = demonstration.hand
    path = hand.positions[hand.known]
    points = demonstration.scene[demonstration.scene[:, 2] > _FLOOR_M].astype(np.float64)
    if not len(path) or not len(points):
        return None
    low, high = np.percentile(path, 2, axis=0) - _SCENE_AROUND_M, np.percentile(path, 98, axis=0) + _SCENE_AROUND_M
    return points_around(points, low, high, _SCENE_CELL_M)


def arounds(demonstrations: Sequence[Demonstration], obstacles: Obstacles) -> list[Around]:
    """What the arm should not touch in each demonstration."""
    return [
        Around(scene, part_around(d.part.astype(np.float64), _SCENE_CELL_M))
        for d, scene in zip(demonstrations, obstacles.scenes, strict=True)
    ]


class Obstacles:
    """Fields of maps and scenes, made once per map (demonstrations may share it)."""

    def __init__(self, demonstrations: Sequence[Demonstration]):
        fields: dict[int, tuple[DistanceField, DistanceField | None]] = {}
        for d in demonstrations:
            if id(d.map) not in fields:
                fields[id(d.map)] = obstacle_field(d.map), _unknown(d.map)
        self.maps = [fields[id(d.map)] for d in demonstrations]
        self.scenes = [scene_field(d) for d in demonstrations]


def _unknown(map: OccupancyMap) -> DistanceField | None:
    field = unknown_field(map)
    return field if (field.values < 0).any() else None


def stacked(
    demonstrations: Sequence[Demonstration],
    calibration: Calibration,
    grasp: Float[np.ndarray, "4 4"],
    obstacles: Obstacles,
) -> Problem:
    """The problem of all demonstrations of one task, one after the other."""
    hands = [hand_targets(d, calibration.hand_tool(d.acting)) for d in demonstrations]
    mirrored = mirrored_sides(demonstrations)
    bases = [base_targets(d, calibration.torso_base) for d in demonstrations]
    objects = [object_path(d) for d in demonstrations]
    panels = [panel_path(d, T) for d, T in zip(demonstrations, objects, strict=True)]
    m = max(p.shape[1] for p in panels)
    panels = [np.pad(p, ((0, 0), (0, m - p.shape[1]), (0, 0)), constant_values=np.nan) for p in panels]
    starts = np.cumsum([0, *(len(d) for d in demonstrations)])
    steps = [slice(int(a), int(b)) for a, b in pairwise(starts)]
    return Problem(
        dt=np.concatenate([np.append(np.diff(d.times_s), np.nan) for d in demonstrations]),
        hand=np.concatenate([T for T, _ in hands]),
        hand_covariance=np.concatenate([c for _, c in hands]),
        torso=np.concatenate([T for T, _ in bases]),
        torso_covariance=np.concatenate([c for _, c in bases]),
        object=np.concatenate(objects),
        holding=np.concatenate([holding(d) for d in demonstrations]),
        approaching=np.concatenate([approaching(d) for d in demonstrations]),
        grasp_steps=np.array([s.start + d.segments.grasp for s, d in zip(steps, demonstrations, strict=True)]),
        grasp=grasp,
        panel=np.concatenate(panels),
        surroundings=tuple(
            Surroundings(s, d.map, *maps, scene)
            for s, d, maps, scene in zip(steps, demonstrations, obstacles.maps, obstacles.scenes, strict=True)
        ),
        mirrored=np.repeat(mirrored, [len(d) for d in demonstrations]),
    )


def holding(demonstration: Demonstration) -> Bool[np.ndarray, " t"]:
    """The samples of the manipulation."""
    d = demonstration
    samples = np.arange(len(d))
    return np.asarray((samples >= d.segments.grasp) & (samples < d.segments.release))


def needed_speeds(problem: Problem) -> Float[np.ndarray, "d 2"]:
    """Speed (metres/s) and turning (radians/s) that the gripper needs in each demonstration.

    The greatest while it holds the object, which it must follow. Of the way to and from it, the speed that 95 % of
    the moments keep to (means over 0.15 s, so that noise does not count); how a hand seems to turn on its way is
    often wrong, and the graph may follow it less.
    """
    T = first_gripper(problem, problem.grasp)
    held = problem.holding[:-1] & problem.holding[1:] & np.isfinite(problem.dt[:-1])
    needed = np.zeros((len(problem.surroundings), 2))
    for row, s in zip(needed, problem.surroundings, strict=True):
        steps = s.steps.start + np.flatnonzero(held[s.steps.start : s.steps.stop - 1])
        row[:] = _speeds(T, problem.dt, steps, 1).max(axis=0, initial=0.0)
        k = max(1, round(_SPEED_S / float(np.nanmedian(problem.dt[s.steps]))))
        v = _speeds(T, problem.dt, np.arange(s.steps.start, s.steps.stop - k), k)[:, 0]
        if len(v):
            row[0] = max(row[0], np.percentile(v, 95))
    return needed


def _speeds(T: np.ndarray, dt: np.ndarray, first: np.ndarray, k: int) -> Float[np.ndarray, "n 2"]:
    """Mean speed and turning from each step to the k-th after it."""
    v = lie.se3_log(lie.se3_inverse(T[first]) @ T[first + k]) / (k * dt[first, None])
    return np.column_stack([np.linalg.norm(v[:, :3], axis=1), np.linalg.norm(v[:, 3:], axis=1)])


def approaching(demonstration: Demonstration) -> Bool[np.ndarray, " t"]:
    """The samples just before taking hold, and just after letting go: half a second, at most a third of the way."""
    d, seconds = demonstration, demonstration.times_s
    take, leave = seconds[d.segments.grasp], seconds[d.segments.release - 1]
    before, after = take - seconds, seconds - leave
    near = (before > 0) & (before <= min(_APPROACH_S, (take - seconds[0]) / 3))
    return np.asarray(near | ((after > 0) & (after <= min(_APPROACH_S, (seconds[-1] - leave) / 3))))


def first_gripper(problem: Problem, grasp: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Where the graph starts: on the object while holding; elsewhere H X without what is far from the running median,
    gaps bridged.
    """
    T = np.empty_like(problem.hand)
    held = problem.object @ problem.grasps(grasp, np.arange(len(T)))[0]
    for s in problem.surroundings:
        hold = problem.holding[s.steps]
        part = np.where(hold[:, None, None], held[s.steps], problem.hand[s.steps])
        good: Bool[np.ndarray, " t"] = np.asarray(np.isfinite(part).all(axis=(1, 2)))
        good[good] = hold[good] | _near_median(part[good, :3, 3])
        T[s.steps] = bridged(part, good)
    return T


def _near_median(p: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    padded = np.pad(p, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1, axis=0)
    return np.asarray(np.linalg.norm(p - np.median(windows, axis=-1), axis=1) < _FAR_M)


def bridged(T: Float[np.ndarray, "t 4 4"], good: Bool[np.ndarray, " t"]) -> Float[np.ndarray, "t 4 4"]:
    """Poses with the others filled in: geodesics between neighbours, constant at the ends."""
    at = np.flatnonzero(good)
    steps = np.arange(len(T))
    after = np.clip(np.searchsorted(at, steps), 0, len(at) - 1)
    before = np.clip(np.searchsorted(at, steps, side="right") - 1, 0, len(at) - 1)
    a, b = at[before], at[after]
    share = np.where(b > a, (steps - a) / np.maximum(b - a, 1), 0.0)
    return T[a] @ lie.se3_exp(share[:, None] * lie.se3_log(lie.se3_inverse(T[a]) @ T[b]))


def as_shown(
    d: Demonstration, calibration: Calibration, grasp: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "t 4 4"], Float[np.ndarray, "t 3"]]:
    """Gripper H X and base P Y, unadapted, gaps bridged. Where no hand was seen at all, the gripper stays on the object
    with T_object_tool = grasp.
    """
    target, _ = hand_targets(d, calibration.hand_tool(d.acting))
    seen = np.isfinite(target).all(axis=(1, 2))
    tool = bridged(target, seen) if seen.any() else object_path(d) @ grasp
    return tool, first_base(d, calibration.torso_base)


def first_base(demonstration: Demonstration, torso_base: Float[np.ndarray, "3"]) -> Float[np.ndarray, "t 3"]:
    """P Y with gaps bridged. Where no torso was seen at all: an arm's length before the object's front, facing it."""
    target, _ = base_targets(demonstration, torso_base)
    good = np.isfinite(target).all(axis=1)
    if good.any():
        t = np.arange(len(target))
        yaw = np.unwrap(target[good, 2])
        return np.column_stack([np.interp(t, t[good], column) for column in (*target[good, :2].T, yaw)])
    T = object_path(demonstration)
    out = T[:, :2, 0] / np.maximum(np.linalg.norm(T[:, :2, 0], axis=1, keepdims=True), 1e-6)
    yaw = np.unwrap(np.arctan2(-out[:, 1], -out[:, 0]))
    return np.column_stack([T[:, :2, 3] + 0.6 * out, yaw])
