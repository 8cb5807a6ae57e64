"""The robot, tick by tick: set points go out, contacts come in. What an execution does is made of these."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.execution.candidates import APPROACH_M
from understudy.execution.config import TICK_S, Config
from understudy.execution.control import Arm, HandleEstimate
from understudy.execution.log import Log
from understudy.execution.outcome import Reason, Stopped
from understudy.robot.model import Robot
from understudy.robot.simulator import Simulator, Targets, Touch

_FOLDING: Final = 0.5
"""share of the arm's velocity limits at which it goes back to its posture"""


class Driver:
    """Commands of one execution, and what came of them."""

    phase: str = "reach"
    """for the record of contacts"""
    handle: HandleEstimate | None = None

    def __init__(self, simulator: Simulator, robot: Robot, config: Config, came_back: Callable[[], bool]):
        """came_back: whether the part has come back by itself after it was let go."""
        self.sim, self.robot, self.config, self._came_back = simulator, robot, config, came_back
        self.log, self.touched, self.course = Log(), Touch(), list[str]()
        self.excused: set[tuple[str, str]] = set()
        """(link, what it touched): a part that came back by itself"""
        state = simulator.state()
        self.targets = Targets(state.base, state.q, state.torso, state.opening_m)
        self.opening = 0.0
        """between the fingers, commanded; metres"""
        self.arm = Arm(robot, state.q)
        self._rested = state.q.copy()

    def track(
        self,
        T_world_tool: Float[np.ndarray, "4 4"],
        x: Float[np.ndarray, " k"],
        v: Float[np.ndarray, " k"] | None = None,
    ) -> None:
        """One tick: base and torso as given, the arm wherever it has to be."""
        v = np.zeros(len(x)) if v is None else v
        base = self.sim.state().base + TICK_S * v[:3]  # where it is, not where it should be
        T_base_tool = lie.se3_inverse(lie.se2_to_se3(base[None]))[0] @ T_world_tool
        q, dq = self.arm.follow(T_base_tool, float(x[3]), x[4:-1], TICK_S)
        self.send(x[:3], v[:3], float(x[3]), float(v[3]), q, dq)

    def send(
        self, base: np.ndarray, base_velocity: np.ndarray, torso: float, lift: float, q: np.ndarray, dq: np.ndarray
    ) -> None:
        """One tick of the world."""
        self.targets = Targets(base, q, float(torso), self.opening, base_velocity, dq, float(lift))
        touch = self.noted(self.sim.step(self.targets, TICK_S))
        state = self.sim.state()
        self.log.add(state, self.targets, 0.0 if self.handle is None else self.handle.q, touch.force)
        if touch.force > self.config.force_n:
            raise Stopped(Reason.FORCE, f"{touch.force:.0f} N between gripper and part")
        if state.time_s > self.config.longest_s:
            raise Stopped(Reason.TIMEOUT, f"not done after {state.time_s:.0f} s")

    def noted(self, touch: Touch) -> Touch:
        """Keeps what was touched. A self-closing door that comes back after it was let go is not the robot's fault."""
        came_back = self._came_back()
        excused = {pair for pair in touch.unwanted if came_back and self.sim.contacts.is_part(pair[1])}
        mine = touch.unwanted - excused
        self.excused |= excused
        now = self.sim.state().time_s
        for a, b in sorted(mine - self.touched.unwanted):
            self.course.append(f"{now:.1f} s, {self.phase}: {a} on {b}")
        kept = Touch(touch.pads, touch.force, touch.grip, mine)
        self.touched = self.touched.joined(kept)
        return kept

    def stop(self) -> None:
        """Stands still where it is, fingers open."""
        state = self.sim.state()
        self.opening = self.robot.description.gripper.opening_m
        self.targets = Targets(state.base, self.targets.q, state.torso, self.opening)
        self.noted(self.sim.step(self.targets, 0.5))

    def back_off(self, widest: float) -> None:
        """Opens the fingers (metres) and goes straight back, the base standing; then drives back."""
        state = self.sim.state()
        x = np.concatenate([state.base, [state.torso], self.targets.q, [0.0]])
        T = state.T_world_tool
        self.arm = Arm(self.robot, self.targets.q)
        self.opening = widest
        for _ in range(round(0.8 / TICK_S)):
            self.track(T, x)
        for u in np.linspace(0, 1, round(1.2 / TICK_S)):
            offset = np.eye(4)
            offset[0, 3] = -APPROACH_M * u**2 * (3 - 2 * u)
            self.track(T @ offset, x)
        self.drive_back(x)

    def drive_back(self, x: Float[np.ndarray, " k"]) -> None:
        """Away from the furniture, the way that the base came, then the arm as it was before the first attempt: from
        there a plan is free to begin.
        """
        q = self.targets.q.copy()
        came = [row for row in reversed(self.log.base) if np.linalg.norm(row[:2] - x[:2]) <= self.config.back_m]
        far = np.cumsum([0.0, *np.linalg.norm(np.diff(np.array(came), axis=0)[:, :2], axis=1)])
        steps = np.arange(0, far[-1], self.config.back_speed * TICK_S)
        base = np.column_stack([np.interp(steps, far, column) for column in np.array(came).T])
        for i, row in enumerate(base):
            velocity = (base[i + 1] - row) / TICK_S if i + 1 < len(base) else np.zeros(3)
            self.send(row, velocity, float(x[3]), 0.0, q, np.zeros(len(q)))
        self.fold(base[-1] if len(base) else x[:3], float(x[3]))

    def fold(self, base: Float[np.ndarray, "3"], torso: float) -> None:
        """The arm goes back to where it was at first, the base standing."""
        q = self.targets.q
        away = np.where(self.robot.continuous, lie.wrapped(self._rested - q), self._rested - q)
        seconds = max(1.0, float((2 * np.abs(away) / (_FOLDING * self.robot.velocity)).max()))
        u = np.linspace(0, 1, round(seconds / TICK_S))
        course = q + (u**2 * (3 - 2 * u))[:, None] * away
        for row, rate in zip(course, np.gradient(course, TICK_S, axis=0), strict=True):
            self.send(base, np.zeros(3), torso, 0.0, row, rate)
