"""Adapts demonstrations of a task to a robot: grasp, calibration, base placement, the graph, exact checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool

from understudy import lie
from understudy.adaptation import prepare
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.explain import conflicts, energies_over_time
from understudy.adaptation.fields import collision_free
from understudy.adaptation.graph import Graph, Problem, State
from understudy.adaptation.platform import Platform
from understudy.adaptation.result import AdaptationResult, Adapted, Report
from understudy.adaptation.solver import Chain, Convergence, Iteration, Stop, Stopwatch, minimise
from understudy.adaptation.start import Starts
from understudy.adaptation.weights import SCHEDULE, Limits, Margins, Stage, Weights
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import UnderstudyError

if TYPE_CHECKING:
    from understudy.robot.model import Robot

_LOOSE: Final = 0.002  # metres and radians: a grasp that is missed by more is none
_EXACT: Final = 0.0005  # the same, of a good one
_NEARLY: Final = 0.93  # of a limit: where its edges begin to push
_SLOWER: Final = 1.15  # least factor by which the clock is slowed down further
_SLOWEST: Final = 5.0  # times the demonstration's clock: beyond, time is not what is short
_AROUND: Final = 3  # samples beside a failure whose margins are tightened, too
_REACH_STEP: Final = 0.015  # metres by which margins are tightened
_OBSTACLE_STEP: Final = 0.01
_MOST_OBSTACLE: Final = 0.02  # in all: more would close doorways


@dataclass(frozen=True)
class AdaptConfig:
    """Options. The defaults are meant for all tasks."""

    weights: Weights = field(default_factory=Weights)
    margins: Margins = field(default_factory=Margins)
    limits: Limits = field(default_factory=Limits)
    schedule: tuple[Stage, ...] = SCHEDULE
    calibration: Calibration | None = None
    """X and Y; None: estimated from the demonstrations"""
    rounds: int = 8
    """how often margins may be tightened where exact checks fail"""
    target_achievable: float = 0.995
    """share of the samples for which exact inverse kinematics must succeed, for tightening to stop"""
    slow_down: bool = True
    """stretch the robot's clock where part or hand moved faster than the gripper may"""
    least_achievable: float = 0.95
    """below, the result is refused (InfeasibleError)"""


def adapt(
    demonstrations: Sequence[Demonstration], robot: Robot | Platform, *, config: AdaptConfig | None = None
) -> AdaptationResult:
    """Gripper and base trajectories that follow the demonstrations as closely as the robot can.

    All demonstrations are of one task, and share the grasp. One is enough. Raises InfeasibleError, which says what
    stands against what, when no grasp, no reachable place or no free path for the base is found; UnderstudyError
    for input that does not fit together.
    """
    if not demonstrations:
        raise UnderstudyError("adapt: needs at least one demonstration")
    tasks = sorted({d.task for d in demonstrations})
    if len(tasks) > 1:
        raise UnderstudyError(f"adapt: demonstrations of one task only, got {', '.join(map(repr, tasks))}")
    _check(demonstrations)
    if isinstance(robot, Platform):
        platform = robot
    else:
        from understudy.adaptation.robots import platform_of

        platform = platform_of(robot)
    return _Adaptation(tuple(demonstrations), platform, config or AdaptConfig()).run()


def _check(demonstrations: Sequence[Demonstration]) -> None:
    for i, d in enumerate(demonstrations):
        if len(d) < 3:
            raise UnderstudyError(f"adapt: demonstration {i} has {len(d)} samples; at least 3 are needed")
        if not (np.diff(d.times_s) > 0).all():
            raise UnderstudyError(f"adapt: demonstration {i}: times_s must increase")
        if not d.segments.grasp < len(d):
            raise UnderstudyError(f"adapt: demonstration {i}: the hand never takes hold (segments.grasp at the end)")


class _Adaptation:
    """One call of `adapt`."""

    def __init__(self, demonstrations: tuple[Demonstration, ...], platform: Platform, config: AdaptConfig):
        self.demonstrations, self.platform, self.config = demonstrations, platform, config
        self.obstacles = prepare.Obstacles(demonstrations)
        self.notes: list[str] = []
        self.slower = 1.0

    def run(self) -> AdaptationResult:
        """The whole course."""
        starts = Starts(self.demonstrations, self.platform, self.config.calibration, self.obstacles)
        if not len(starts.hands()):
            self.notes.append("no hand was measured on the object: the grasp is a frontal one, X is the default")
        start = starts.best()
        config, watch = self.config, Stopwatch()
        graph = Graph(self.clocked(start.problem), self.platform, config.weights, config.margins, config.limits)
        state, course = start.state, list[Iteration]()
        converged = True
        for number, stage in enumerate(self.config.schedule):
            state, part, converged = _solve(graph, state, stage, number)
            course += part
            if number + 1 < len(self.config.schedule):
                graph.with_grasp(start.family.nearest(state.grasp))
        state, rounds, part, converged = self.tighten(graph, state, converged)
        course += part
        state = self.tidied(state)
        free, achieved = self.free(state), self.achievable(state)
        self.refuse(graph, state, free, achieved)
        self.note_speeds(graph, state)
        if not converged:
            self.notes.append("the solver stopped at its limit of iterations")
        report = Report(Convergence(tuple(course), converged, *watch.read()), rounds, tuple(self.notes))
        adapted = self.parts(graph, state, free, achieved)
        first = self.demonstrations[0]
        return AdaptationResult(first.task, self.platform.name, adapted, graph.problem.grasp, start.calibration, report)

    def clocked(self, problem: Problem) -> Problem:
        """The problem, on a clock that is slow enough for the gripper to go with the part."""
        if self.config.slow_down:
            limits, share = self.config.limits, self.config.margins.speed
            speed, turning = prepare.needed_speeds(problem)
            self.slower = max(1.0, speed / (share * limits.speed), turning / (share * limits.turning))
        return replace(problem, dt=self.slower * problem.dt)

    def tighten(self, graph: Graph, state: State, converged: bool) -> tuple[State, int, list[Iteration], bool]:
        """Larger margins where exact checks fail, and the last stage again, until nothing fails."""
        course: list[Iteration] = []
        stage = self.config.schedule[-1]
        for round in range(self.config.rounds):
            tidy = self.tidied(state)
            free, achieved = self.free(tidy), self.achievable(tidy)
            good = free.all() and achieved.mean() >= self.config.target_achievable
            late = self.late(graph, tidy)
            if good and not late:
                return state, round, course, converged
            if late:
                self.slower *= late
                graph.stretch(late)
            graph.reach_margin[_widened(~achieved)] += _REACH_STEP
            if not free.all() and graph.obstacle_margin < self.config.margins.obstacle + _MOST_OBSTACLE:
                graph.obstacle_margin += _OBSTACLE_STEP
            state, part, converged = _solve(graph, state, stage, len(self.config.schedule) + round)
            course += part
        return state, self.config.rounds, course, converged

    def late(self, graph: Graph, state: State) -> float:
        """By how much to slow down further: 0 where the robot keeps up and does not miss its grasp for lack of time."""
        over = graph.excess(state)
        short_of_time = over > 1 or (over > _NEARLY and max(graph.missed(state)) > _EXACT)
        factor = min(max(over, _SLOWER), _SLOWEST / self.slower)
        return factor if self.config.slow_down and short_of_time and factor > 1 else 0.0

    def tidied(self, state: State) -> State:
        """The torso within its range to the last digit."""
        return replace(state, torso=np.clip(state.torso, *self.platform.torso_limits))

    def free(self, state: State) -> Bool[np.ndarray, " n"]:
        """Exactly clear of each demonstration's map."""
        return np.concatenate([collision_free(d.map, self.platform.footprint, state.base[s]) for s, d in self.each()])

    def achievable(self, state: State) -> Bool[np.ndarray, " n"]:
        """By exact inverse kinematics."""
        seen = lie.se3_inverse(lie.se2_to_se3(state.base)) @ state.gripper
        return self.platform.achievable(seen, state.torso)

    def each(self) -> list[tuple[slice, Demonstration]]:
        """Demonstrations with their steps in the chain."""
        ends = np.cumsum([0, *(len(d) for d in self.demonstrations)])
        steps = [slice(int(a), int(b)) for a, b in pairwise(ends)]
        return list(zip(steps, self.demonstrations, strict=True))

    def parts(self, graph: Graph, state: State, free: np.ndarray, achieved: np.ndarray) -> tuple[Adapted, ...]:
        """The result of each demonstration."""
        energies = energies_over_time(graph, state, self.config.schedule[-1])
        return tuple(
            Adapted(
                d.times_s[0] + self.slower * (d.times_s - d.times_s[0]),
                state.gripper[s],
                state.base[s],
                state.torso[s],
                achieved[s],
                free[s],
                graph.problem.grasps(graph.problem.grasp, np.array([s.start]))[0][0],
                {kind: values[s] for kind, values in energies.items()},
            )
            for s, d in self.each()
        )

    def note_speeds(self, graph: Graph, state: State) -> None:
        """Says so where the robot is slower than the teacher, or cannot keep up: holding on goes before limits."""
        name = self.platform.name
        if self.slower > 1:
            self.notes.append(f"the teacher moved too fast for {name}: its clock runs {self.slower:.2f} times as long")
        over = graph.excess(state)
        if over > 1:
            self.notes.append(f"up to {over:.2f} times as fast as {name} can go")

    def refuse(self, graph: Graph, state: State, free: np.ndarray, achieved: np.ndarray) -> None:
        """Raises InfeasibleError for a result that the robot cannot do; notes what it can nearly do."""
        off, turned = graph.missed(state)
        held = max(off, turned) <= _LOOSE
        if held and free.all() and achieved.mean() >= self.config.least_achievable:
            if achieved.mean() < self.config.target_achievable:
                self.notes.append(f"{100 * achieved.mean():.2f} % of the samples are achievable")
            return
        raise InfeasibleError(
            f"{self.demonstrations[0].task}: no trajectory of {self.platform.name} keeps all constraints "
            f"(achievable {100 * achieved.mean():.1f} %, clear of the map {100 * free.mean():.1f} %, "
            f"grasp missed by {100 * off:.2f} cm).\n"
            + conflicts(graph, state, self.config.schedule[-1], self.each(), free, achieved)
        )


def _solve(graph: Graph, state: State, stage: Stage, number: int) -> tuple[State, list[Iteration], bool]:
    chain: Chain[State] = Chain(
        len(state.torso),
        lambda s: graph.linearise(s, stage),
        lambda s, step, shared: s.retract(step, shared),
        free_border=bool(graph.problem.holding.any()),
    )
    return minimise(chain, state, Stop(stage.tolerance, stage.iterations), number)


def _widened(failed: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return np.asarray(np.convolve(failed, np.ones(2 * _AROUND + 1), mode="same") > 0.5)
