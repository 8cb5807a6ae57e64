"""From a skill and an observed object to a motion that the robot can do.

The skill's motion is treated as a demonstration is in the adaptation: the same graph, with the same edges
(reachability, map, moving part, rigid grasp, smoothness, limits), bends it as little as necessary, starting from the
skill's own motion. Its covariance says where bending is cheap. Then exact inverse kinematics, and time scaling.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy import lie
from understudy.actions import ActionModel, Reproduction, RobotPose
from understudy.adaptation import prepare
from understudy.adaptation.around import Around, Surrounded
from understudy.adaptation.clearance import GuardedRobot
from understudy.adaptation.fields import collision_free
from understudy.adaptation.graph import Stage, State
from understudy.adaptation.platform import Platform
from understudy.adaptation.solver import Chain, Stop, minimise
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import UnderstudyError
from understudy.execution.candidates import APPROACH_S, ExecutionGraph, candidates
from understudy.execution.outcome import Reason, Stopped
from understudy.execution.surroundings import Observed
from understudy.execution.timing import Timed, time_scaled
from understudy.objects.articulation import Articulation
from understudy.robot.ik_bridge import bridged
from understudy.robot.ik_path import IKPath, solve_ik_path
from understudy.robot.model import Robot
from understudy.trajectories import PlanarTrack, PoseTrack

RATE_HZ: Final = 10.0
BASE_SPEED: Final = 0.5
"""share of the base's greatest velocities that is used near furniture"""
ARM_SPEED: Final = 0.5

_SCHEDULE: Final = (
    Stage(constraints=0.2, grasp=0.3, kernel="cauchy", tolerance=1e-2, iterations=10),
    Stage(constraints=1.0, grasp=1.0, kernel="cauchy", tolerance=1e-3, iterations=25),
)
_ROUNDS, _ROUNDS_LATER = 3, 2  # with larger margins: of the first candidate, of others
_REACH_STEP, _OBSTACLE_STEP = 0.015, 0.015  # metres by which margins grow where exact checks fail
_AROUND: Final = 3
_NEAR: Final = 0.6  # share of the way to the handle from which on the arm must be clear of everything
_TRIED: Final = 3  # candidates that the graph is solved for, without and with pivoting
_FEW: Final = 3  # samples that may fail an exact check
_NOWHERE: Final = 0.8  # share of failing samples
_SPARE_M: Final = (
    0.02,
    0.0,
)  # of the arm to what is around, the first that is possible: the closed loop bends the plan
_HOPELESS: Final = 8  # samples that fail after a round with larger margins: no further round


@dataclass(frozen=True, eq=False)
class Plan:
    """A feasible motion of the whole body."""

    timed: Timed
    """x, y, yaw of the base, torso, arm joints, and position of the part; over the plan's seconds"""
    approach_s: float
    """when the gripper is before the handle"""
    grasp_s: float
    release_s: float
    grasp: Float[np.ndarray, "4 4"]
    """T_object_tool"""
    pivot: float
    """radians by which the tool turns about the handle's z, against its grasp, per unit of the part's way"""
    articulation: Articulation
    q_goal: float
    processor_s: float

    @property
    def duration_s(self) -> float:
        """Seconds."""
        return self.timed.duration_s


def make_plan(
    model: ActionModel,
    robot: Robot,
    platform: Platform,
    observed: Observed,
    start: RobotPose,
    q_start: Float[np.ndarray, " j"],
    q_goal: float | None = None,
) -> Plan:
    """Plans the whole action from where the robot is. Raises Stopped(NO_PLAN), which says what stands in the way."""
    began = time.process_time()
    try:
        motion = model.reproduce(observed.T_world_object, observed.articulation, q_goal, RATE_HZ, start)
        motion = motion.until(float(motion.times_s[motion.segments.release]) + APPROACH_S)  # done when off the handle
        task = _as_demonstration(motion, observed)
        graph, state, path = _first_solved(task, motion, robot, platform, observed, start)
    except Stopped:
        raise
    except UnderstudyError as e:
        raise Stopped(Reason.NO_PLAN, str(e)) from e
    moments = _arrived(task), task.segments.grasp, task.segments.release
    timed, at = scaled(robot, motion.times_s, state.base, path, q_start, motion.q, moments)
    spent = time.process_time() - began
    return Plan(timed, *at, graph.problem.grasp, graph.pivot, observed.articulation, float(motion.q[-1]), spent)


def scaled(
    robot: Robot,
    times_s: Float[np.ndarray, " t"],
    base: Float[np.ndarray, "t 3"],
    path: IKPath,
    q_start: Float[np.ndarray, " j"],
    opened: Float[np.ndarray, " t"],
    moments: tuple[int, int, int],
) -> tuple[Timed, tuple[float, float, float]]:
    """A motion of the whole body within the robot's limits, at rest at three samples: before the handle, where it
    takes hold and where it lets go; and when these are. opened: position of the part.
    """
    x = np.column_stack([base, path.torso, _from(path, q_start, moments[0]), opened])
    stops = times_s[list(moments)]
    timed = time_scaled(times_s, x, _velocities(robot), _accelerations(robot), stops=stops)
    approach, grasp, release = (timed.time_of(float(s)) for s in stops)
    return timed, (approach, grasp, release)


def _velocities(robot: Robot) -> Float[np.ndarray, " k"]:
    """Of base, torso, arm; the part's position has none."""
    limits = robot.description.limits
    arm = ARM_SPEED * robot.velocity
    return np.concatenate([BASE_SPEED * limits.base_velocity, [limits.torso_velocity], arm, [1e3]])


def _accelerations(robot: Robot) -> Float[np.ndarray, " k"]:
    limits = robot.description.limits
    arm = ARM_SPEED * limits.arm_acceleration
    return np.concatenate([limits.base_acceleration, [limits.torso_acceleration], arm, [1e4]])


def _from(path: IKPath, q_start: Float[np.ndarray, " j"], arrived: int) -> Float[np.ndarray, "t j"]:
    """The joint path, begun where the arm is. Until the last break before the handle the arm waits for what follows:
    far from the furniture it need not follow the tool's path.
    """
    q = path.q.copy()
    broken = [i for i in {*path.jumps, *(np.flatnonzero(~path.success) + 1).tolist()} if i <= arrived]
    first = max(broken, default=0)
    q[:first] = q[first]
    away = q_start - q[0]
    u = np.clip(np.arange(len(q)) / max(first, _NEAR * arrived, 1), 0, 1)
    fade = 1 - u**3 * (10 - 15 * u + 6 * u**2)
    return np.asarray(q + fade[:, None] * away)


def _as_demonstration(motion: Reproduction, observed: Observed) -> Demonstration:
    """The skill's motion with its covariance, as if somebody had shown it here."""
    t = len(motion)
    every = np.ones(t, bool)
    nothing = np.zeros((t, 6, 6))
    return Demonstration(
        task="skill",
        times_s=motion.times_s,
        acting="right",
        hand=PoseTrack(motion.T_world_tool, motion.covariance[:, :6, :6], every, every),
        torso=PlanarTrack(motion.xy_yaw, motion.covariance[:, 6:9, 6:9], every),
        object=PoseTrack(motion.T_world_object, nothing, every, every),
        articulation=observed.articulation,
        handle=observed.handle,
        segments=motion.segments,
        map=observed.map,
        scene=observed.scene,
        T_world_cam=np.eye(4),
        joints=np.full((t, 18, 3), np.nan),
        part=observed.part,
    )


def _first_solved(
    task: Demonstration, motion: Reproduction, robot: Robot, platform: Platform, observed: Observed, start: RobotPose
) -> tuple[ExecutionGraph, State, IKPath]:
    """The first candidate that passes the exact checks; or, if none does, one that fails them at very few samples: the
    arm, which follows the handle in small steps, need not do what the planned path does there.
    """
    around = observed.around()
    tried: list[tuple[bool, int, int, ExecutionGraph, _Solution]] = []
    for pivoting in (False, True):
        choices = candidates(task, motion, platform, observed, start, pivoting)
        for candidate in choices[:_TRIED]:
            rounds = _ROUNDS_LATER if tried else _ROUNDS
            solution = _solve(candidate.graph, candidate.state, robot, around, task, _arrived(task), rounds)
            if not solution.failures:
                return candidate.graph, solution.state, solution.path
            if solution.failures > _NOWHERE * len(task):
                raise Stopped(Reason.NO_PLAN, solution.why)  # no other grasp helps
            tried.append((solution.hits, solution.failures, len(tried), candidate.graph, solution))
            if len(tried) >= 2 and min(tried)[1] <= _FEW and not pivoting:
                break
    hits, failures, _, graph, best = min(tried)
    if failures > _FEW or hits:
        raise Stopped(Reason.NO_PLAN, best.why)
    return graph, best.state, best.path


def _arrived(task: Demonstration) -> int:
    """The sample at which the gripper is before the handle."""
    grasp = task.times_s[task.segments.grasp]
    return int(np.searchsorted(task.times_s, max(grasp - APPROACH_S, task.times_s[1]) - 1e-9))


@dataclass(frozen=True, eq=False)
class _Solution:
    state: State
    path: IKPath
    failures: int
    """samples at which an exact check fails"""
    hits: bool
    """the base meets the map somewhere"""
    why: str


def _solve(
    graph: ExecutionGraph, state: State, robot: Robot, around: Around, task: Demonstration, arrived: int, rounds: int
) -> _Solution:
    """Solves; where exact checks fail, with larger margins again. The best of all rounds."""
    found: list[_Solution] = []
    for number, stage in enumerate([*_SCHEDULE, *[_SCHEDULE[-1]] * rounds]):
        state = _minimised(graph, state, stage, number)
        if number < len(_SCHEDULE) - 1:
            continue
        state = replace(state, torso=np.clip(state.torso, *robot.torso_limits))
        free = collision_free(task.map, _footprint(graph.platform, task), state.base)
        free[: int(np.argmax(free))] = True  # where the robot is, it is: it may have to get out of there
        path = _joints(robot, around, state, task, arrived)
        failed = ~path.success
        failed[list(path.jumps)] = True
        failed[:arrived] = False  # on the way there the arm need not follow (`_from`)
        count = int((failed | ~free).sum())
        found.append(_Solution(state, path, count, not free.all(), _why(task, free, failed, path)))
        again = number >= len(_SCHEDULE)
        hopeless = count > (_HOPELESS if again else len(task) // 3)
        if not count or hopeless or (again and count <= _FEW and free.all()):
            break
        graph.reach_margin[_widened(failed)] += _REACH_STEP
        if not free.all():
            graph.obstacle_margin += _OBSTACLE_STEP
    return min(found, key=lambda s: (s.hits, s.failures))


def _footprint(platform: Platform, task: Demonstration) -> Float[np.ndarray, "k 2"]:
    """Less half a cell: an occupied cell reaches up to that far beyond what occupies it."""
    inner = np.abs(platform.footprint).max()
    return np.asarray(platform.footprint * (1 - 0.5 * task.map.resolution_m / inner))


def _minimised(graph: ExecutionGraph, state: State, stage: Stage, number: int) -> State:
    chain: Chain[State] = Chain(
        len(state.torso), lambda s: graph.linearise(s, stage), lambda s, step, shared: s.retract(step, shared)
    )
    return minimise(chain, state, Stop(stage.tolerance, stage.iterations), number)[0]


def _joints(robot: Robot, around: Around, state: State, task: Demonstration, arrived: int) -> IKPath:
    """Exact, clear of the robot itself and, from before the handle on, of what is around."""
    T_base_tool = lie.se3_inverse(lie.se2_to_se3(state.base)) @ state.gripper
    guarded = np.arange(len(task)) >= _NEAR * arrived
    T_object = prepare.object_path(task)
    for spare in _SPARE_M:
        surrounded = Surrounded(around, state.base, T_object, spare)
        guard = GuardedRobot(robot, surrounded, T_base_tool, guarded, hand=True)
        path = bridged(guard, solve_ik_path(guard, T_base_tool, state.torso, task.times_s), T_base_tool)
        if path.success[arrived:].all() and not any(jump > arrived for jump in path.jumps):
            break
    return path


def _widened(failed: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return np.asarray(np.convolve(failed, np.ones(2 * _AROUND + 1), mode="same") > 0.5)


def _why(task: Demonstration, free: np.ndarray, failed: np.ndarray, path: IKPath) -> str:
    words = []
    for name, part in task.segments.slices(len(task)).items():
        if not free[part].all():
            words.append(f"{name}: the base meets the map at {int((~free[part]).sum())} samples")
        if failed[part].any():
            jumps = sum(part.start <= j < part.stop for j in path.jumps)
            words.append(f"{name}: {int(failed[part].sum())} samples out of reach ({jumps} jumps of the arm)")
    return "; ".join(words)
