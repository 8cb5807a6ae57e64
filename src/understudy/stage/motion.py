"""The motion of a person who opens a piece of furniture: planned on the floor, fitted to the body, stepped, posed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from understudy.lie import wrapped
from understudy.objects.articulation import PRISMATIC
from understudy.stage.body import SIDES, Skeleton
from understudy.stage.furniture import Furniture
from understudy.stage.kinematics import about, forward, unit
from understudy.stage.kinematics_body import SPINE, Foot, Trunk, pose, root_of, solve_arm, trunk_rotations
from understudy.stage.motion_fit import KNOT_S, Wishes, fit, standing_height, trunk_of
from understudy.stage.motion_gait import Step, foot_at, hip_limit, plan_steps
from understudy.stage.motion_hand import Grip, acting_hand, draw_grip, finger_flex, hanging
from understudy.stage.motion_profiles import Clock, draw_clock, ramp
from understudy.stage.motion_space import DT, Space, floor_path

_SWAY_M: Final = 0.006
_FINE_S: Final = 0.02
_AIM: Final = 0.25  # radians that the chest turns away from the hand, so that the shoulder comes forward
_WRIST_MOST: Final = np.radians(62)
_SWING: Final = 0.55  # of the opposite foot's way


@dataclass(frozen=True, eq=False)
class Motion:
    """Where everything is at any time between 0 and clock.end."""

    skeleton: Skeleton
    furniture: Furniture
    clock: Clock
    acting: str
    grip: Grip
    knots: CubicSpline
    """(8) unknowns of `motion_fit` over time"""
    steps: dict[str, tuple[Float[np.ndarray, "3"], list[Step]]]
    sway: tuple[float, float]
    """phases of the idle sway"""
    comfort: float
    """cost per knot that the fit was left with"""

    def q(self, times: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
        """Position of the furniture's part."""
        return self.furniture.open_to * self.clock.progress(times)

    def held(self, times: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t 4 4"]:
        """T_world_hand of a hand that holds the handle."""
        return self.furniture.articulation.pose(self.q(times)) @ self.grip.T_handle_hand

    def at(self, times: Float[np.ndarray, " t"]) -> tuple[Float[np.ndarray, "t b 3 3"], Float[np.ndarray, "t b 3"]]:
        """World rotation (identity at rest) and place of every bone."""
        trunk = self._trunk(times)
        feet = self._feet(times)
        R = trunk_rotations(self.skeleton, trunk)
        root = root_of(self.skeleton, trunk, R[self.skeleton.bone("root")])
        place = forward(self.skeleton.parents, self.skeleton.heads, R, root)[1]
        hands, swivel, flex = {}, {}, {}
        hold = hold_weight(self.clock, times)
        for side in SIDES:
            shoulder = place[:, self.skeleton.bone("upperarm01", side)]
            other = feet["right" if side == "left" else "left"].ankle - trunk.hips
            ahead = other[:, 0] * np.cos(trunk.yaw) + other[:, 1] * np.sin(trunk.yaw)
            hands[side] = hanging(self.skeleton, side, trunk, shoulder, _SWING * ahead)
            swivel[side] = np.zeros(len(times))
            if side == self.acting:
                swivel[side] = self.knots(times)[:, 7] * hold
                hand = acting_hand(self.clock, times, hands[side], self.held(times))
                free = (times < self.clock.grasp) | (times > self.clock.release)
                chest = R[self.skeleton.bone(SPINE[-1])]
                hands[side] = _relieve(self.skeleton, side, chest, shoulder, hand, swivel[side], free)
            flex[side] = finger_flex(self.clock, times, self.grip, side == self.acting)
        return pose(self.skeleton, trunk, feet, hands, swivel, flex)

    def _feet(self, times: Float[np.ndarray, " t"]) -> dict[str, Foot]:
        return {side: foot_at(*self.steps[side], times, self.skeleton, side) for side in SIDES}

    def _trunk(self, times: Float[np.ndarray, " t"]) -> Trunk:
        v = self.knots(times)
        hold = hold_weight(self.clock, times)
        a, b = self.sway
        idle = _SWAY_M * (1 - hold)
        v[:, 0] += idle * np.sin(1.9 * times + a)
        v[:, 1] += idle * np.sin(1.4 * times + b)
        v[:, 4] += 2.0 * idle * np.sin(1.4 * times + a)
        v[:, 5] += 4.0 * idle * np.sin(0.9 * times + b)
        trunk = trunk_of(self.skeleton, v, self.acting, hold)
        trunk.hips[:, 2] = np.minimum(trunk.hips[:, 2], self._height(times))
        nod, turn = self._gaze(times).T
        return Trunk(
            trunk.hips, trunk.yaw, trunk.bend, trunk.lean, trunk.twist, nod, turn - 0.5 * trunk.twist, trunk.forth
        )

    @cached_property
    def _fine(self) -> Float[np.ndarray, " n"]:
        return np.arange(0.0, self.clock.end + _FINE_S, _FINE_S)

    @cached_property
    def _height(self) -> CubicSpline:
        """Of the hips, at most: both legs reach the floor, without a jerk."""
        times = self._fine
        v = self.knots(times)
        limit = hip_limit(self.skeleton, v[:, :2], v[:, 2], self._feet(times))
        limit = np.minimum(limit, standing_height(self.skeleton) - v[:, 6])
        low = minimum_filter1d(limit, int(0.16 / _FINE_S) | 1, mode="nearest")
        return CubicSpline(times, gaussian_filter1d(low, 0.05 / _FINE_S, mode="nearest"))

    @cached_property
    def _gaze(self) -> CubicSpline:
        """Nod and turn of the head: at the handle until it is let go, then ahead and about."""
        times = self._fine
        v = self.knots(times)
        handle = self.furniture.articulation.pose(self.q(times))[:, :3, 3]
        eyes = float(self.skeleton.face[1, 2])
        way = handle - np.column_stack([v[:, :2], np.full(len(v), eyes)])
        turn = np.arctan2(way[:, 1], way[:, 0]) - v[:, 2] - v[:, 5]
        turn = np.clip(wrapped(turn), -1.0, 1.0)
        nod = np.clip(np.arctan2(-way[:, 2], np.hypot(way[:, 0], way[:, 1])) - v[:, 3], -0.4, 0.55)
        looks = 1 - ramp(times, self.clock.release + 0.1, self.clock.release + 0.7)
        around = 0.25 * np.sin(1.3 * times + self.sway[0])
        both = np.column_stack([0.8 * nod * looks + 0.05, turn * looks + around * (1 - looks)])
        return CubicSpline(times, gaussian_filter1d(both, 0.15 / _FINE_S, axis=0, mode="nearest"))


def _relieve(
    skeleton: Skeleton,
    side: str,
    chest: Float[np.ndarray, "t 3 3"],
    shoulder: Float[np.ndarray, "t 3"],
    T_world_hand: Float[np.ndarray, "t 4 4"],
    swivel: Float[np.ndarray, " t"],
    free: Bool[np.ndarray, " t"],
) -> Float[np.ndarray, "t 4 4"]:
    """The same hands, but turned about their middle where a hand is free and its wrist would bend too far."""
    T = T_world_hand.copy()
    for _ in range(3):  # the forearm follows the hand, so once is not enough
        arm = solve_arm(skeleton, side, chest, shoulder, T, swivel)
        excess = np.where(free, np.maximum(arm.bend - _WRIST_MOST, 0.0), 0.0)
        axis = unit(np.cross(T[:, :3, 0], arm.wrist - arm.elbow))
        T[:, :3, :3] = about(axis, excess) @ T[:, :3, :3]
    return T


def hold_weight(clock: Clock, times: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """0 to 1: how much the body has to serve the hand on the handle."""
    return ramp(times, clock.grasp - 0.7, clock.grasp - 0.1) - ramp(times, clock.release + 0.1, clock.release + 0.8)


def plan_motion(skeleton: Skeleton, furniture: Furniture, seed: int) -> Motion:
    """A person's motion in front of (or through) a piece of furniture. Deterministic; about a second."""
    rng = np.random.default_rng([seed, 5])
    acting = _choose_hand(rng, furniture)
    level = bool(abs(furniture.articulation.T_rest[2, 2]) < 0.5)
    height = float(furniture.articulation.T_rest[2, 3])
    grip = draw_grip(rng, furniture.handle, height, level, acting, skeleton)
    start, goal, yaw0 = _ends(rng, furniture)
    way = furniture.articulation.pose(np.linspace(0, furniture.open_to, 50))[:, :3, 3]
    path_m = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    before = max(0.0, float(np.linalg.norm(start - way[0, :2])) - 0.5)
    after = max(0.0, float(np.linalg.norm(goal - way[-1, :2])) - 0.4)
    clock = draw_clock(rng, before, path_m, after)
    posture = np.array([0.0, 0.0, 0.0, rng.uniform(0.02, 0.10), 0.0, 0.0, 0.0, rng.normal(0, 0.15)])

    times = np.arange(0.0, clock.end + KNOT_S, KNOT_S)
    q = furniture.open_to * clock.progress(times)
    T_hand = furniture.articulation.pose(q) @ grip.T_handle_hand
    space = Space(furniture)
    hold = hold_weight(clock, times)
    xy = _body_path(space, clock, furniture, grip, start, goal)(times)
    yaw = _headings(clock, times, xy, T_hand[:, :2, 3], hold, acting, furniture, yaw0)
    knots, comfort = fit(skeleton, space, Wishes(xy, yaw, T_hand, hold, q, posture), acting)
    spline = CubicSpline(times, knots)

    def hips(time: float) -> Float[np.ndarray, "3"]:
        return np.asarray(spline(time)[:3])

    half = 0.85 * float(skeleton.head("upperleg01", "left")[1])
    steps = plan_steps(hips, float(times[-1]), half, str(rng.choice(SIDES)))
    sway = (float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0, 2 * np.pi)))
    return Motion(skeleton, furniture, clock, acting, grip, spline, steps, sway, comfort)


def _choose_hand(rng: np.random.Generator, furniture: Furniture) -> str:
    """A pulled door opens towards the hand's own side, a pushed one away from it: so the wrist follows the turn."""
    if furniture.articulation.kind != PRISMATIC:
        hinge = "left" if furniture.articulation.point[1] > 0 else "right"
        return hinge if not furniture.pushed else "right" if hinge == "left" else "left"
    if furniture.task == "drawer":
        return str(rng.choice(SIDES))
    towards = "left" if furniture.articulation.direction[1] > 0 else "right"
    return towards if rng.random() < 0.7 else "right" if towards == "left" else "left"


def _ends(
    rng: np.random.Generator, furniture: Furniture
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """Where the person starts and goes in the end, and the heading at the start."""
    start = np.array([-rng.uniform(1.2, 1.8), rng.uniform(-0.6, 0.6)])
    yaw = float(np.arctan2(-start[1], -start[0])) + rng.uniform(-0.3, 0.3)
    if furniture.pushed:
        goal = np.array([rng.uniform(1.0, 1.4), 0.42 * furniture.articulation.point[1] + rng.uniform(-0.05, 0.05)])
    else:
        end = furniture.articulation.pose(np.array([furniture.open_to]))[0, :2, 3]
        goal = np.array([min(-1.0, end[0] - 0.75) - rng.uniform(0.0, 0.4), end[1] + rng.uniform(-0.4, 0.4)])
    return start, goal, yaw


def _body_path(
    space: Space,
    clock: Clock,
    furniture: Furniture,
    grip: Grip,
    start: Float[np.ndarray, "2"],
    goal: Float[np.ndarray, "2"],
) -> CubicSpline:
    """The pelvis's way over the floor."""
    times = np.arange(0.0, clock.end + 2 * DT, DT)
    q = furniture.open_to * clock.progress(times)
    T = furniture.articulation.pose(q) @ grip.T_handle_hand
    hand = np.column_stack([T[:, :2, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    path = floor_path(space, q, hand, hold_weight(clock, times), start, goal, (clock.walk, clock.rest - 0.2))
    return CubicSpline(times, path)


def _headings(
    clock: Clock,
    times: Float[np.ndarray, " t"],
    xy: Float[np.ndarray, "t 2"],
    hand: Float[np.ndarray, "t 2"],
    hold: Float[np.ndarray, " t"],
    acting: str,
    furniture: Furniture,
    yaw0: float,
) -> Float[np.ndarray, " t"]:
    """Which way the pelvis faces: where it goes while walking there, the hand while it holds; unwrapped."""
    way = hand - xy
    aim = np.arctan2(way[:, 1], way[:, 0]) + (_AIM if acting == "right" else -_AIM)
    after = 0.0 if furniture.pushed else float(aim[np.searchsorted(times, clock.release)])
    ahead = ramp(times, clock.walk, clock.walk + 0.6)
    gone = ramp(times, clock.release, clock.release + 0.8)
    free = (1 - ahead)[:, None] * [np.cos(yaw0), np.sin(yaw0)]
    free = free + (ahead * (1 - gone))[:, None] * np.column_stack([np.cos(aim), np.sin(aim)])
    free = free + gone[:, None] * [np.cos(after), np.sin(after)]
    both = (1 - hold)[:, None] * free + hold[:, None] * np.column_stack([np.cos(aim), np.sin(aim)])
    both = gaussian_filter1d(both, 0.25 / KNOT_S, axis=0, mode="nearest")
    return np.unwrap(np.arctan2(both[:, 1], both[:, 0]))
