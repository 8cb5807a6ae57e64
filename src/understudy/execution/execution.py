"""Runs a skill on a robot (or its simulation): plan, approach, take hold, move, let go; closed loop on the handle."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions import ActionModel, RobotPose
from understudy.adaptation.platform import Platform
from understudy.execution.candidates import APPROACH_M, pivoted
from understudy.execution.config import TICK_S, Config
from understudy.execution.control import Arm, HandleEstimate
from understudy.execution.driver import Driver
from understudy.execution.outcome import Outcome, Reason, Stopped
from understudy.execution.planning import Plan, make_plan
from understudy.execution.surroundings import Observed
from understudy.geometry import inverse
from understudy.objects.articulation import REVOLUTE, Articulation
from understudy.robot.model import Robot
from understudy.robot.simulator import Simulator


@runtime_checkable
class Perception(Protocol):
    """How the robot comes to know an object: a measured handle -> the object with its surroundings.

    opened: how far the part is open already, as far as is known.
    """

    def __call__(self, T_world_object: Float[np.ndarray, "4 4"], opened: float) -> Observed: ...


@runtime_checkable
class Planner(Protocol):
    """How a skill becomes a motion: `planning.make_plan`, or a baseline. Raises Stopped(NO_PLAN)."""

    def __call__(
        self,
        model: ActionModel,
        robot: Robot,
        platform: Platform,
        observed: Observed,
        start: RobotPose,
        q_start: Float[np.ndarray, " j"],
        q_goal: float | None = None,
    ) -> Plan: ...


class Execution:
    """A skill, on a robot, with an object as perceived."""

    def __init__(
        self,
        model: ActionModel,
        robot: Robot,
        platform: Platform,
        perception: Perception,
        *,
        q_goal: float | None = None,
        config: Config | None = None,
        planner: Planner = make_plan,
    ):
        """q_goal: how far to open; None: as far as was demonstrated, or as the object opens."""
        self.model, self.robot, self.platform, self.perception = model, robot, platform, perception
        self.planner = planner
        self.q_goal, self.config = q_goal, config or Config()

    def run(self, simulator: Simulator) -> Outcome:
        """The whole action. Never raises for what can go wrong with it: the outcome says what did."""
        return _Run(self, simulator).outcome()


class _Run:
    """One run's state."""

    def __init__(self, execution: Execution, simulator: Simulator):
        self.execution, self.config, self.sim = execution, execution.config, simulator
        self.robot = execution.robot
        self.drive = Driver(simulator, execution.robot, execution.config, self.came_back)
        self.retries, self.planning_s = 0, 0.0
        self.opened_start = simulator.opened
        self.released = False
        self.goal = execution.q_goal
        self.share = 0.0

    def outcome(self) -> Outcome:
        """Attempts, until one succeeds or there are no more."""
        began = self.sim.state().time_s
        known = 0.0
        reason, detail = Reason.NOT_FAR_ENOUGH, ""
        while True:
            try:
                self.attempt(known)
                reason, detail = self.judged()
                break
            except Stopped as stopped:
                reason, detail = stopped.reason, stopped.detail
                self.drive.course.append(f"{self.sim.state().time_s:.1f} s: {stopped}")
                again = reason in (Reason.LOST, Reason.MISSED, Reason.OUT_OF_REACH, Reason.BLOCKED)
                if not again or self.retries >= self.config.retries:
                    self.drive.stop()
                    break
                self.retries += 1
                try:
                    self.drive.back_off(self.widest)
                except Stopped as stuck:
                    reason, detail = stuck.reason, stuck.detail
                    self.drive.course.append(f"{self.sim.state().time_s:.1f} s, backing off: {stuck}")
                    self.drive.stop()
                    break
                if self.drive.handle is not None:  # what was let go may have moved since
                    known = max(0.0, self.drive.handle.position(self.sim.measured_handle_pose(near=True)))
        return Outcome(
            success=reason == Reason.OPENED,
            reason=reason,
            detail=detail,
            opened_share=self.share if self.released else self.opened_share(),
            retries=self.retries,
            max_force=self.drive.touched.force,
            course=tuple(self.drive.course),
            collisions=tuple(sorted(self.drive.touched.unwanted)),
            excused=tuple(sorted(self.drive.excused)),
            duration_s=self.sim.state().time_s - began,
            planning_s=self.planning_s,
            trajectory=self.drive.log.trajectory(),
        )

    widest: float = 0.0
    q_held: float = 0.0
    held_at: Float[np.ndarray, "4 4"] | None = None
    """T_object_tool when the fingers had closed"""

    def attempt(self, known: float) -> None:
        """From where the robot is to having let go. known: how far the part is open already."""
        observed = self.execution.perception(self.sim.measured_handle_pose(near=self.retries > 0), known)
        state = self.sim.state()
        start = RobotPose(state.T_world_tool, state.base, state.torso)
        plan = self.execution.planner(
            self.execution.model, self.robot, self.execution.platform, observed, start, self.drive.targets.q, self.goal
        )
        self.planning_s += plan.processor_s
        self.goal = plan.q_goal
        self.drive.handle = HandleEstimate(plan.articulation)
        q0 = float(plan.articulation.position(observed.T_world_object[None])[0])
        self.drive.handle.q = q0
        most = self.robot.description.gripper.opening_m
        self.widest = min(most, 2 * observed.handle.radius_m + self.config.clearance_m)
        self.moved_by = np.zeros(3)
        self.drive.phase = "reach"
        self.reach(plan)
        self.drive.phase = "approach"
        self.take(plan, observed.handle.radius_m, q0)
        self.drive.phase = "manipulate"
        self.move(plan, observed.handle.radius_m)
        self.drive.phase = "release"
        self.release(plan)

    def reach(self, plan: Plan) -> None:
        """Open-loop to before the handle, opening the fingers meanwhile."""
        for t in np.arange(TICK_S, plan.approach_s + TICK_S, TICK_S):
            self.drive.opening += float(np.clip(self.widest - self.drive.opening, -0.05 * TICK_S, 0.05 * TICK_S))
            x, v = plan.timed.at(np.array([min(t, plan.approach_s)]))
            self.drive.send(x[0, :3], v[0, :3], x[0, 3], v[0, 3], x[0, 4:-1], v[0, 4:-1])
        self.drive.arm = Arm(self.robot, self.drive.targets.q)

    def take(self, plan: Plan, radius: float, q0: float) -> None:
        """Measures the handle from close by, goes onto it, closes the fingers."""
        c, handle = self.config, self.drive.handle
        assert handle is not None
        handle.restart()
        self.T_given, self.held_at = np.eye(4), None
        ticks = round(c.settle_s / TICK_S)
        for k in range(ticks):
            self.measure(q0)
            # what the far measurement was wrong by is made up for while the gripper is clear of the handle, by the base
            # as well: then all of the robot is as far from door frames and cabinets as was planned
            self.moved_by = (k + 1) / ticks * handle.correction_on_floor(q0)
            self.follow(plan, plan.approach_s, q0, share=(k + 1) / ticks)
        for t in np.arange(plan.approach_s, plan.grasp_s, TICK_S):
            self.measure(q0)
            self.follow(plan, float(t), q0)
        self.close(plan, radius, q0)

    def close(self, plan: Plan, radius: float, q0: float) -> None:
        """Closes the fingers, and sees what they hold."""
        c = self.config
        pressing = -0.04  # beyond closed: the servo presses with all that its limit allows
        for _ in range(round((c.closing_s + c.settle_s) / TICK_S)):
            self.drive.opening = max(pressing, self.drive.opening - 0.13 / c.closing_s * TICK_S)
            self.measure(q0)
            self.follow(plan, plan.grasp_s, q0)
            self.give_way(np.array([0.0, 1, 0, 0, 0, 0]))  # the fingers centre themselves on the handle
        self.check_held(radius, Reason.MISSED)
        assert self.drive.handle is not None
        # from now on the handle is where it is in the hand: no force to begin with
        self.q_held = q0
        self.held_at = inverse(self.drive.handle.pose(q0)) @ self.sim.state().T_world_tool
        self.T_object_tool, self.T_given = self.held_at, np.eye(4)

    def move(self, plan: Plan, radius: float) -> None:
        """Along with the handle as measured; slower when it lags behind."""
        c, handle = self.config, self.drive.handle
        assert handle is not None
        handle.restart()
        per = _metres(plan.articulation)
        t, rate, waited, q_from = plan.grasp_s, 1.0, 0.0, handle.q
        while t < plan.release_s:
            x, v = plan.timed.at(np.array([t]))
            lag = per * abs(float(x[0, -1]) - handle.q)
            most = c.sticking_m if per * abs(handle.q - q_from) > c.moved_m else c.stop_m
            wanted = float(np.clip((most - lag) / (most - c.slow_m), 0, 1))
            rate += float(np.clip(wanted - rate, -8 * TICK_S, 2 * TICK_S))
            waited = waited + TICK_S if rate < 0.05 else 0.0
            if waited > c.patience_s and handle.q - q_from >= c.at_end * (plan.q_goal - q_from):
                break  # as far as it goes: the goal is off by what the observation was off
            if waited > c.patience_s:
                way = 100 * per * abs(handle.q - q_from)
                raise Stopped(Reason.BLOCKED, f"it stands still after {way:.1f} cm, {100 * lag:.1f} cm behind the plan")
            t = min(t + rate * TICK_S, plan.release_s)
            handle.moved(rate * float(v[0, -1]) * TICK_S)
            self.measure(None)
            self.follow(plan, t, None, rate=rate, held=True)
            self.give_way(self.across(plan, handle.q))
            self.check_held(radius, Reason.LOST, plan)
            self.check_reach()

    def across(self, plan: Plan, q: float) -> Float[np.ndarray, "6"]:
        """Along which axes of the tool to give way: not along the handle's way, or nothing would move."""
        a, b = (self.drive.handle.pose(q + d) for d in (0.0, 0.01))  # type: ignore[union-attr]
        way = self.sim.state().T_world_tool[:3, :3].T @ (b - a)[:3, 3]
        way = way / np.linalg.norm(way)
        return np.append(1 - way**2, np.ones(3))

    def give_way(self, share: Float[np.ndarray, "6"]) -> None:
        """Moves the set point towards where the handle holds the tool, so that forces do not build up.

        share: of the tool's axes, translation and rotation. Within bounds, for a handle that slips is not to be
        followed.
        """
        away = lie.se3_log(inverse(self.wanted) @ self.sim.state().T_world_tool)
        step = TICK_S / self.config.give_way_s * share * away
        given = lie.se3_log(self.T_given) + step
        bound = np.repeat([self.config.given_m, self.config.given_rad], 3)
        T_given = lie.se3_exp(np.clip(given, -bound, bound))
        if self.held_at is not None:
            self.T_object_tool = self.held_at @ T_given
        self.T_given = T_given

    def release(self, plan: Plan) -> None:
        """Opens the fingers and goes straight back off the handle: done."""
        self.share = self.opened_share()
        self.released = True
        widest = self.widest
        assert self.drive.handle is not None
        q_end = self.drive.handle.q
        held = self.drive.handle.pose(q_end) @ self.pivoted(plan, q_end) @ self.T_object_tool
        x, _ = self.planned(plan, plan.release_s)
        while self.drive.opening < widest:
            self.drive.opening = min(widest, max(self.drive.opening, 0.0) + 0.1 * TICK_S)
            self.drive.track(held, x[0])
        for u in np.linspace(0, 1, round(1.2 / TICK_S)):
            offset = np.eye(4)
            offset[0, 3] = -APPROACH_M * u**2 * (3 - 2 * u)
            self.drive.track(held @ offset, x[0])

    def follow(
        self, plan: Plan, t: float, q: float | None, share: float = 1.0, rate: float = 1.0, held: bool = False
    ) -> None:
        """One tick: base and torso as planned, the tool where the handle wants it. q: None: as planned."""
        assert self.drive.handle is not None
        x, v = self.planned(plan, t)
        part = float(x[0, -1]) if q is None else q
        if held:
            T = self.drive.handle.pose(part) @ self.pivoted(plan, part) @ self.T_object_tool
        else:
            x_far = plan.timed.at(np.array([t]))[0]
            planned = lie.se2_to_se3(x_far[:, :3])[0] @ self.robot.forward(x_far[:, 4:-1], x_far[:, 3])[0]
            T = lie.se3_exp(share * lie.se3_log(self.drive.handle.T_correct)) @ planned @ self.T_given
        self.wanted = T
        self.drive.track(T, x[0], rate * v[0])

    moved_by: Float[np.ndarray, "3"]
    """of the base's plan, world: x, y, yaw about the origin"""

    def planned(self, plan: Plan, t: float) -> tuple[Float[np.ndarray, "1 k"], Float[np.ndarray, "1 k"]]:
        """The plan at a moment, and its rates; the base's where the handle turned out to be."""
        x, v = plan.timed.at(np.array([t]))
        T = lie.se2_to_se3(self.moved_by[None])[0]
        x[0, :2] = T[:2, :2] @ x[0, :2] + T[:2, 3]
        x[0, 2] += self.moved_by[2]
        v[0, :2] = T[:2, :2] @ v[0, :2]
        return x, v

    _measured_s: float = -1.0

    def measure(self, q: float | None) -> None:
        """A measurement of the handle from close by, when the next one is due."""
        now = self.sim.state().time_s
        if now - self._measured_s >= self.config.measure_s:
            self._measured_s = now
            assert self.drive.handle is not None
            self.drive.handle.add(self.sim.measured_handle_pose(near=True), q)

    def pivoted(self, plan: Plan, q: float) -> Float[np.ndarray, "4 4"]:
        """How far the tool has turned about the handle since it took hold, as planned."""
        return np.asarray(pivoted(plan.pivot, np.array([q - self.q_held]))[0])

    def check_held(self, radius: float, reason: Reason, plan: Plan | None = None) -> None:
        """Raises Stopped when the fingers hold nothing, or the handle is not where it was between them."""
        opening = self.sim.state().opening_m
        if opening < self.config.held_share * 2 * radius:
            raise Stopped(
                reason, f"the fingers are {1000 * opening:.0f} mm apart, the handle is {2000 * radius:.0f} mm"
            )
        if plan is not None:
            assert self.drive.handle is not None
            expected = self.drive.handle.pose(self.drive.handle.q) @ self.T_object_tool  # turned or not: the same place
            away = float(np.linalg.norm(expected[:3, 3] - self.sim.state().T_world_tool[:3, 3]))
            if away > self.config.slipped_m:
                raise Stopped(reason, f"the handle is {100 * away:.1f} cm from where it was in the hand")

    def check_reach(self) -> None:
        """Raises Stopped when the arm cannot be where it should."""
        if self.drive.arm.error[0] > self.config.missed_m:
            raise Stopped(
                Reason.OUT_OF_REACH, f"the tool is {100 * self.drive.arm.error[0]:.1f} cm from where it should be"
            )

    def came_back(self) -> bool:
        """Whether a part that was let go has closed again: a spring did that."""
        return self.released and self.opened_share() < self.share - self.config.came_back

    def opened_share(self) -> float:
        """True position of the part over the goal."""
        if self.goal is None or self.goal == self.opened_start:
            return 0.0
        return (self.sim.opened - self.opened_start) / (self.goal - self.opened_start)

    def judged(self) -> tuple[Reason, str]:
        """After the gripper let go."""
        if self.share < self.config.enough:
            return Reason.NOT_FAR_ENOUGH, f"{100 * self.share:.0f} % of the goal"
        if self.drive.touched.unwanted:
            pairs = ", ".join(f"{a} on {b}" for a, b in sorted(self.drive.touched.unwanted)[:4])
            return Reason.COLLISION, pairs
        return Reason.OPENED, f"{100 * self.share:.0f} % of the goal"


def _metres(articulation: Articulation) -> float:
    """Of the handle's way over the part's position."""
    return articulation.radius_m if articulation.kind == REVOLUTE else 1.0
