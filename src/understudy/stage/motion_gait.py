"""Where feet step while a body moves along a path: they stand still, or swing to where they will be needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.stage.body import SIDES, SOLE, Skeleton
from understudy.stage.kinematics import STRETCH
from understudy.stage.kinematics_body import Foot
from understudy.stage.motion_profiles import ease

Place = Float[np.ndarray, "3"]  # x, y, yaw

_STEP_S: Final = 0.48  # seconds that a foot is in the air
_LIFT_M: Final = 0.07
_TOLERANCE: Final = (0.10, 0.35)  # metres and radians that a standing foot may be away from its place below the hips
_TURN_OUT: Final = 0.14  # radians
_TICK: Final = 0.05  # seconds between decisions


@dataclass(frozen=True, eq=False)
class Step:
    """One foot's way from a standing place to the next. Places: x, y, yaw of the ankle on the floor."""

    start_s: float
    end_s: float
    source: Place
    target: Place


def plan_steps(
    path: Callable[[float], Place], duration_s: float, half_width: float, first: str
) -> dict[str, tuple[Place, list[Step]]]:
    """Footsteps under a path of the hips; one foot swings at a time, the one that is farther from its place.

    path: time -> x, y, yaw of the hips. Returns side -> first place and steps.
    """

    def wanted(side: str, time: float) -> Place:
        x, y, yaw = path(min(max(time, 0.0), duration_s))
        out = half_width if side == "left" else -half_width
        return np.array([x - out * np.sin(yaw), y + out * np.cos(yaw), yaw + np.sign(out) * _TURN_OUT])

    stands = {side: wanted(side, 0.0) for side in SIDES}
    begin = dict(stands)
    steps: dict[str, list[Step]] = {side: [] for side in SIDES}
    time, last = 0.0, "left" if first == "right" else "right"
    while time < duration_s - _STEP_S:
        other = "left" if last == "right" else "right"
        # when it lands, the body goes on for half a step before the next foot takes over
        targets = {side: wanted(side, time + 1.5 * _STEP_S) for side in SIDES}
        away = {side: _away(stands[side], targets[side]) for side in SIDES}
        side = other if away[other] > 0.6 * away[last] else last
        if away[side] < 1.0:
            time += _TICK
            continue
        steps[side].append(Step(time, time + _STEP_S, stands[side], targets[side]))
        stands[side], last = targets[side], side
        time += _STEP_S
    return {side: (begin[side], steps[side]) for side in SIDES}


def _away(place: Place, target: Place) -> float:
    """How far a foot is from where it should be; 1 is worth a step."""
    offset = target - place
    angle = (offset[2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.hypot(offset[0], offset[1]) / _TOLERANCE[0] + abs(angle) / _TOLERANCE[1])


def foot_at(begin: Place, steps: list[Step], times: Float[np.ndarray, " t"], skeleton: Skeleton, side: str) -> Foot:
    """The foot at any times: flat on the floor between steps; heel first up, toes first down."""
    n = len(times)
    place, lift, pitch = np.tile(begin, (n, 1)), np.zeros(n), np.zeros(n)
    for step in steps:
        place[times >= step.end_s] = step.target
        swings = (times >= step.start_s) & (times < step.end_s)
        s = (times[swings] - step.start_s) / (step.end_s - step.start_s)
        turn = (step.target[2] - step.source[2] + np.pi) % (2 * np.pi) - np.pi
        way = np.array([*(step.target[:2] - step.source[:2]), turn])
        place[swings] = step.source + ease(s)[:, None] * way
        length = float(np.hypot(way[0], way[1]))
        size = min(1.0, length / 0.35)
        lift[swings] = (0.35 + 0.65 * size) * _LIFT_M * np.sin(np.pi * s) ** 2
        ahead = np.cos(step.source[2]) * way[0] + np.sin(step.source[2]) * way[1]
        pitch[swings] = 0.45 * np.clip(ahead / 0.5, -0.3, 1.0) * np.sin(2 * np.pi * s) * np.where(s < 0.5, 1, 0.4)
    ankle_height = float(skeleton.head("foot", side)[2]) + SOLE
    # the foot turns about its ball when the heel is up, so the ankle rises
    reach = float(skeleton.head("toe2-1", side)[0] - skeleton.head("foot", side)[0])
    rise = reach * np.sin(np.maximum(pitch, 0.0)) + 0.05 * np.sin(np.maximum(-pitch, 0.0))
    ankle = np.column_stack([place[:, :2], ankle_height + lift + rise])
    return Foot(ankle, place[:, 2], pitch)


def hip_limit(
    skeleton: Skeleton, hips_xy: Float[np.ndarray, "t 2"], yaw: Float[np.ndarray, " t"], feet: dict[str, Foot]
) -> Float[np.ndarray, " t"]:
    """Greatest height of the hips at which both legs reach the floor."""
    limits = []
    for side in SIDES:
        out = float(skeleton.head("upperleg01", side)[1])
        hip = hips_xy + np.column_stack([-np.sin(yaw), np.cos(yaw)]) * out
        leg = skeleton.length("upperleg01", "lowerleg01", side) + skeleton.length("lowerleg01", "foot", side)
        level = np.sum((hip - feet[side].ankle[:, :2]) ** 2, 1)
        limits.append(feet[side].ankle[:, 2] + np.sqrt(np.maximum((STRETCH * leg) ** 2 - level, 0.3**2)))
    return np.minimum(*limits)
