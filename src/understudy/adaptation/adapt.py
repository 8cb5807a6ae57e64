"""Adapts demonstrations of a task to a robot: grasp, calibration, base placement, the graph, exact checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float

from understudy import lie
from understudy.adaptation import prepare
from understudy.adaptation.around import Surrounded
from understudy.adaptation.attempt import LOOSE, Attempt
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.checks import Checked, about_arm, at_ease
from understudy.adaptation.clock import Motion, arm_motion, base_motion, gripper_motion, joined, retimed
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.explain import conflicts, energies_over_time
from understudy.adaptation.fields import collision_free
from understudy.adaptation.graph import Graph, Problem, State
from understudy.adaptation.parts import beside_part, object_path, panel_path
from understudy.adaptation.platform import JointPath, Platform
from understudy.adaptation.result import AdaptationResult, Adapted, Report
from understudy.adaptation.solver import Chain, Convergence, Iteration, Stop, Stopwatch, minimise
from understudy.adaptation.start import Start, Starts
from understudy.adaptation.weights import SCHEDULE, Limits, Margins, Stage, Weights
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import UnderstudyError

if TYPE_CHECKING:
    from understudy.robot.model import Robot

_EXACT: Final = 0.0005  # metres and radians by which a good grasp may be missed
_NEARLY: Final = 0.93  # of a limit: where its edges begin to push
_SLOWER: Final = (1.15, 1.5)  # least and greatest factor by which the clock is slowed down at a time
_SLOWEST: Final = 5.0  # times the demonstration's clock: beyond, time is not what is short
_NOTED: Final = 1.005  # a clock that runs so many times as long is worth a note
_AROUND: Final = 3  # samples beside a failure whose margins are tightened, too
_REACH_STEP: Final = 0.015  # metres by which margins are tightened
_OBSTACLE_STEP: Final = 0.01
_STARTS: Final = 4  # that the graph is solved from, while exact checks fail
_EASED: Final = 6  # rounds for the sake of the arm's motion alone
_PATIENCE: Final = 4  # rounds without anything better
_LESS: Final = 0.5  # factor on how much a hand is followed where the arm is not at ease
_STIFFER: Final = 1.5  # factor on the map's edges where the base is not clear of it
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
        self.arounds = prepare.arounds(demonstrations, self.obstacles)
        self.objects = [object_path(d) for d in demonstrations]
        self.panels = [panel_path(d, T) for d, T in zip(demonstrations, self.objects, strict=True)]
        self.notes: list[str] = []
        self.slower = np.ones(len(demonstrations))

    def run(self) -> AdaptationResult:
        """The whole course."""
        starts = Starts(self.demonstrations, self.platform, self.config.calibration, self.obstacles)
        if not len(starts.hands()):
            self.notes.append("no hand was measured on the object: the grasp is a frontal one, X is the default")
        every = []
        for start in islice(starts.ranked(), _STARTS):
            every.append(self.attempt(start))
            if self.settled(every[-1].found):
                break
        best = min(every, key=lambda one: one.rank)
        graph, found = best.graph, best.found
        self.refuse(graph, found)
        if not best.convergence.converged:
            self.notes.append("the solver stopped at its limit of iterations")
        adapted = self.parts(graph, found)
        report = Report(best.convergence, best.rounds, tuple(self.notes))
        task, grasp = self.demonstrations[0].task, graph.problem.grasp
        return AdaptationResult(task, self.platform.name, adapted, grasp, best.start.calibration, report)

    def attempt(self, start: Start) -> Attempt:
        """The graph, solved from a start, with its exact checks."""
        config, watch = self.config, Stopwatch()
        self.slower = np.ones(len(self.demonstrations))
        graph = Graph(self.clocked(start.problem), self.platform, config.weights, config.margins, config.limits)
        state, course = start.state, list[Iteration]()
        converged = True
        for number, stage in enumerate(config.schedule):
            state, part, converged = _solve(graph, state, stage, number)
            course += part
            if number + 1 < len(config.schedule):
                graph.with_grasp(start.family.nearest(state.grasp))
        found, rounds, part, converged = self.tighten(graph, state, converged)
        convergence = Convergence((*course, *part), converged, *watch.read())
        return Attempt(start, graph, found, rounds, convergence)

    def settled(self, found: Checked) -> bool:
        """Nothing is left that another start could mend."""
        return bool(found.clear.all() and found.achieved.mean() >= self.config.target_achievable)

    def clocked(self, problem: Problem) -> Problem:
        """The problem, on clocks that are slow enough for the gripper to go with the part."""
        if self.config.slow_down:
            limits = self.config.margins.speed * np.array([self.config.limits.speed, self.config.limits.turning])
            self.slower = np.maximum(1.0, (prepare.needed_speeds(problem) / limits).max(axis=1))
        return replace(problem, dt=self.per_step(self.slower) * problem.dt)

    def per_step(self, values: Float[np.ndarray, " d"]) -> Float[np.ndarray, " n"]:
        """Values of demonstrations for each step of the chain."""
        return np.repeat(values, [len(d) for d in self.demonstrations])

    def tighten(self, graph: Graph, state: State, converged: bool) -> tuple[Checked, int, list[Iteration], bool]:
        """Larger margins where exact checks fail, the last stage again, until nothing fails; or the best of all. When
        only the arm is not at ease, a few times: an arm that is not stretched has choices.
        """
        course: list[Iteration] = []
        stage, every = self.config.schedule[-1], list[tuple[Checked, Problem, tuple[float, ...]]]()
        tightened = eased = best = 0
        while True:
            found = self.checked(state)
            sound = self.settled(found)
            found = self.eased(found) if sound else found
            late = self.late(graph, found)
            off = float(graph.missed(found.state).max())
            every.append((found, graph.problem, (off > LOOSE, *found.failures, off > _EXACT)))
            best = min(best, len(every) - 1, key=lambda i: every[i][2])
            done = eased >= _EASED or found.arm.all() if sound else tightened >= self.config.rounds
            if (done and (not sound or (late == 1).all())) or len(every) - 1 - best >= _PATIENCE:
                break
            eased, tightened = eased + sound, tightened + (not sound)
            self.slower = self.slower * late
            graph.stretch(self.per_step(late))
            self.harder(graph, found, sound)
            state, part, converged = _solve(graph, state, stage, len(self.config.schedule) + len(every) - 1)
            course += part
        found, graph.problem, _ = every[best]
        return found, len(every) - 1, course, converged

    def harder(self, graph: Graph, found: Checked, sound: bool) -> None:
        """Larger margins, stiffer edges around what fails; where only the arm does (sound), less of the hand, too."""
        strained = _widened(~found.arm) & sound
        graph.reach_margin[_widened(~found.achieved) | strained] += _REACH_STEP
        graph.rest_arm(strained, _LESS)
        graph.map_stiffness[_widened(~found.free)] *= _STIFFER
        graph.part_stiffness[_widened(~found.beside)] *= _STIFFER
        if not found.free.all() and graph.obstacle_margin < self.config.margins.obstacle + _MOST_OBSTACLE:
            graph.obstacle_margin += _OBSTACLE_STEP

    def eased(self, found: Checked) -> Checked:
        """The same with a thorough search for joints where the arm is not at ease yet."""
        joints = tuple(
            j if j is None or at_ease(j).all() else self.joints(found.state, number, thorough=True)
            for number, j in enumerate(found.joints)
        )
        return replace(found, joints=joints)

    def late(self, graph: Graph, found: Checked) -> Float[np.ndarray, " d"]:
        """By how much to slow down further: 1 where no grasp is missed and nothing is hit for lack of time."""
        over = graph.excess(found.state)
        failed = np.array([not found.clear[s].all() for s, _ in self.each()])
        failed |= graph.missed(found.state).max(axis=1) > _EXACT
        factor = np.minimum(np.clip(over, *_SLOWER), _SLOWEST / self.slower)
        return np.where(failed & (over > _NEARLY) & self.config.slow_down, np.maximum(factor, 1.0), 1.0)

    def checked(self, state: State) -> Checked:
        """Exact checks. A joint path proves what it goes through; only the rest is left to inverse kinematics."""
        state = replace(state, torso=np.clip(state.torso, *self.platform.torso_limits))  # to the last digit
        free = [collision_free(d.map, self.platform.footprint, state.base[s]) for s, d in self.each()]
        beside = [
            beside_part(panel, self.platform.footprint, state.base[s])
            for panel, (s, _) in zip(self.panels, self.each(), strict=True)
        ]
        seen = lie.se3_inverse(lie.se2_to_se3(state.base)) @ state.gripper
        joints = tuple(self.joints(state, number) for number in range(len(self.demonstrations)))
        achieved = np.concatenate(
            [np.zeros(len(d), bool) if j is None else j.exact for j, d in zip(joints, self.demonstrations, strict=True)]
        )
        rest = np.flatnonzero(~achieved)
        if len(rest):
            achieved[rest] = self.platform.achievable(seen[rest], state.torso[rest])
        sizes = tuple(len(d) for d in self.demonstrations)
        return Checked(state, np.concatenate(free), np.concatenate(beside), achieved, joints, sizes)

    def joints(self, state: State, number: int, thorough: bool = False) -> JointPath | None:
        """Of the arm, along one demonstration."""
        arm, (s, d) = self.platform.arm, self.each()[number]
        if arm is None:
            return None
        base = state.base[s]
        surrounded = Surrounded(self.arounds[number], base, self.objects[number])
        seen = lie.se3_inverse(lie.se2_to_se3(base)) @ state.gripper[s]
        return arm.path(seen, state.torso[s], d.times_s, surrounded=surrounded, thorough=thorough)

    def each(self) -> list[tuple[slice, Demonstration]]:
        """Demonstrations with their steps in the chain."""
        ends = np.cumsum([0, *(len(d) for d in self.demonstrations)])
        steps = [slice(int(a), int(b)) for a, b in pairwise(ends)]
        return list(zip(steps, self.demonstrations, strict=True))

    def parts(self, graph: Graph, found: Checked) -> tuple[Adapted, ...]:
        """The result of each demonstration, and notes about clocks and joints."""
        state, problem = found.state, graph.problem
        energies = energies_over_time(graph, state, self.config.schedule[-1])
        out = []
        for number, ((s, d), joints) in enumerate(zip(self.each(), found.joints, strict=True)):
            if joints is not None and not at_ease(joints).all():
                joints = self.joints(state, number, thorough=True)
            times = d.times_s
            if self.config.slow_down:  # the graph may have needed more time than its result
                times = retimed(self.motion(state, s, joints), d.times_s, _SLOWEST)
            grasp = problem.grasps(problem.grasp, np.array([s.start]))[0][0]
            costs = {kind: values[s] for kind, values in energies.items()}
            tool, base, torso = state.gripper[s], state.base[s], state.torso[s]
            out.append(Adapted(times, tool, base, torso, found.achieved[s], found.free[s], grasp, costs, joints))
        self.note(state, out)
        return tuple(out)

    def motion(self, state: State, steps: slice, joints: JointPath | None) -> Motion:
        """Of everything that has limits, in one demonstration."""
        parts = [
            base_motion(self.platform, state.base[steps], state.torso[steps]),
            gripper_motion(self.config.limits, state.gripper[steps]),
        ]
        return joined(*parts, *([] if joints is None else [arm_motion(self.platform, joints)]))

    def note(self, state: State, adapted: Sequence[Adapted]) -> None:
        """Says so where the robot is slower than the teacher, cannot keep up, or its arm has to change its posture."""
        name, several = self.platform.name, len(adapted) > 1
        slower = [np.ptp(a.times_s) / np.ptp(d.times_s) for a, d in zip(adapted, self.demonstrations, strict=True)]
        late = sorted(x for x in slower if x > _NOTED)
        if late:
            factor = f"{late[0]:.2f} to {late[-1]:.2f}" if late[-1] > _NOTED * late[0] else f"{late[-1]:.2f}"
            where = f" in {len(late)} of {len(adapted)} demonstrations" if several else ""
            self.notes.append(f"{name} is slower than the teacher: its clock runs {factor} times as long{where}")
        over = 0.0
        for i, ((s, _), a) in enumerate(zip(self.each(), adapted, strict=True)):
            over = max(over, *(x.max(initial=0.0) for x in self.motion(state, s, a.joints).shares(np.diff(a.times_s))))
            if a.joints is not None:
                which = f"demonstration {i}: " if several else ""
                self.notes += [which + words for words in about_arm(a.joints)]
        if over > 1:
            self.notes.append(f"up to {over:.2f} times as fast as {name} can go")

    def refuse(self, graph: Graph, found: Checked) -> None:
        """Raises InfeasibleError for a result that the robot cannot do; notes what it can nearly do."""
        clear, achieved = found.free, found.achieved
        off, turned = graph.missed(found.state).max(axis=0)
        held = max(off, turned) <= LOOSE
        if held and clear.all() and achieved.mean() >= self.config.least_achievable:
            if achieved.mean() < self.config.target_achievable:
                self.notes.append(f"{100 * achieved.mean():.2f} % of the samples are achievable")
            if not found.beside.all():
                # the map is measured; of the part, outline and depth are guessed where it was not seen
                self.notes.append(f"the base is where the moving part is at {int((~found.beside).sum())} samples")
            return
        good = clear & achieved
        failing = {i: int((~good[s]).sum()) for i, (s, _) in enumerate(self.each()) if not good[s].all()}
        raise InfeasibleError(
            f"{self.demonstrations[0].task}: no trajectory of {self.platform.name} keeps all constraints "
            f"(achievable {100 * achieved.mean():.1f} %, clear of the map {100 * found.free.mean():.1f} %, "
            f"of the moving part {100 * found.beside.mean():.1f} %, grasp missed by {100 * off:.2f} cm).\n"
            + conflicts(graph, found.state, self.config.schedule[-1], self.each(), found.free, found.beside, achieved),
            failing,
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
