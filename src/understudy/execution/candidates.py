"""Grasps that an execution may use, best first, and the adaptation's graph made ready for each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions import Reproduction, RobotPose
from understudy.adaptation import edges, grasps, prepare
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.graph import BASE, GRIPPER, GRIPPER_POINTS, TORSO, Graph, Problem, Stage, State
from understudy.adaptation.placement import Search, search_path
from understudy.adaptation.platform import Platform
from understudy.adaptation.solver import Linear
from understudy.demonstration.demonstration import Demonstration
from understudy.execution.surroundings import Observed
from understudy.geometry import inverse
from understudy.objects.articulation import REVOLUTE

APPROACH_M: Final = 0.10
"""along the tool's x, straight onto the handle and back off it"""
APPROACH_S: Final = 1.5

_ANCHOR: Final = (0.002, 0.002, np.radians(0.2))
_STRAIGHT: Final = np.array([0.004] * 3 + [np.radians(1.5)] * 3)
_NEAREST: Final = 5  # grasps near the skill's that are compared
_SAME_M: Final = 0.02
_SAME_ROLL_M: Final = 0.4  # half a turn is 0.9 m away
_TURNS: Final = 5
_OTHER_M: Final = 0.15  # of a grasp from the skill's (a radian is 0.3 m) that costs 1
_NEAR_M: Final = 0.02  # too near to the scene that costs 1
_PIVOTS: Final = (0.5, 0.85)
_ALONG: Final = 0.95  # cosine between bar and axis
_BAR_M: Final = 0.05  # shorter ones are knobs
_HAND_POINTS: Final = np.array([[-0.02, 0, 0], [-0.07, 0, 0], *GRIPPER_POINTS])
_HAND_RADIUS_M: Final = 0.05


@dataclass(frozen=True, eq=False)
class Candidate:
    """A grasp, with where the graph starts from."""

    graph: ExecutionGraph
    state: State
    cost: float
    """of reach and clearance at the worst moment, about 1 per 2 cm squared; and of how far it is from the skill's"""


def candidates(
    task: Demonstration,
    motion: Reproduction,
    platform: Platform,
    observed: Observed,
    start: RobotPose,
    pivoting: bool,
) -> list[Candidate]:
    """Feasible grasps, best first: that the skill's nearest one is feasible elsewhere does not make it so here.

    pivoting: those in which a door's bar turns in the fingers.
    """
    g = task.segments.grasp
    shown = inverse(motion.T_world_object[g]) @ motion.T_world_tool[g]
    problem = prepare.stacked(
        [task], Calibration(np.eye(4), np.zeros(3)), np.eye(4), prepare.Obstacles([task])
    )  # fmt: skip
    problem = replace(problem, approaching=np.zeros(len(task), bool))

    def candidate(grasp: np.ndarray, share: float) -> Candidate:
        turned = replace(problem, object=problem.object @ pivoted(share, motion.q - motion.q[0]), grasp=grasp)
        return _candidate(turned, task, motion, platform, start, shown, share)

    several = _grasps(observed, platform, shown)
    if not pivoting:
        return sorted((candidate(grasp, 0.0) for grasp in several[:_NEAREST]), key=lambda c: c.cost)
    upright = [grasp for grasp in several if grasps.distance(several[0], grasp[None])[0] < _SAME_ROLL_M]
    return sorted((candidate(T, share) for T in upright for share in _pivots(observed)), key=lambda c: c.cost)


def _pivots(observed: Observed) -> list[float]:
    """A round bar along a door's axis can turn in the fingers, as it does in a hand: radians per radian of the door."""
    a, handle = observed.articulation, observed.handle
    along = float(a.direction @ observed.T_world_object[:3, 2])
    if a.kind != REVOLUTE or abs(along) < _ALONG or handle.length_m < _BAR_M:
        return []
    return [float(-np.sign(along) * share) for share in _PIVOTS]


def pivoted(pivot: float, q: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t 4 4"]:
    """Turns about z by pivot times q."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3] = lie.so3_exp((pivot * q)[:, None] * np.array([0, 0, 1.0]))
    return T


def _grasps(observed: Observed, platform: Platform, shown: Float[np.ndarray, "4 4"]) -> list[np.ndarray]:
    """The nearest grasp of each family; then turned about the bar."""
    out = []
    families = grasps.ranked(observed.handle, platform, shown[None])
    for family, nearest in families:
        out.append(nearest)
        if family.turn > 0:
            turns = family.members(np.linspace(-1, 1, _TURNS) * family.turn, np.zeros(_TURNS))
            turns[:, 2, 3] = nearest[2, 3]
            out += list(turns[np.argsort(grasps.distance(nearest, turns))])
    out[1:] = sorted(out[1:], key=lambda T: float(grasps.distance(shown, T[None])[0]))
    return [T for i, T in enumerate(out) if not i or grasps.distance(T, np.array(out[:i])).min() > _SAME_M]


def _candidate(
    problem: Problem,
    task: Demonstration,
    motion: Reproduction,
    platform: Platform,
    start: RobotPose,
    shown: Float[np.ndarray, "4 4"],
    pivot: float,
) -> Candidate:
    around = problem.surroundings[0]
    gripper = prepare.first_gripper(problem, problem.grasp)
    steps, straight = _straight(task, problem)
    gripper[steps] = straight
    base, cost = search_path(Search(problem, platform, gripper, start.torso_height), around, motion.xy_yaw)
    base = base + np.linspace(1, 0, len(base))[:, None] ** 4 * (motion.xy_yaw[0] - base[0])
    state = State(gripper, base, np.full(len(task), start.torso_height), problem.grasp)
    graph = ExecutionGraph(problem, platform, start, steps, straight, pivot)
    if around.scene is not None:
        busy = np.flatnonzero(problem.holding)
        near, _ = edges.gripper_clearance(around.scene, _HAND_POINTS, _HAND_RADIUS_M, gripper[busy])
        cost += float(((near / _NEAR_M) ** 2).max())
    other = float(grasps.distance(shown, problem.grasp[None])[0]) / _OTHER_M
    return Candidate(graph, state, cost + other**2 + abs(pivot))


def _straight(task: Demonstration, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Samples on the straight way onto the handle and off it, and the tool's pose there."""
    t, s = task.times_s, task.segments
    before, after = t[s.grasp] - t, t - t[s.release]
    steps = np.flatnonzero(((before > 0) & (before <= APPROACH_S)) | ((after > 0) & (after <= APPROACH_S)))
    u = np.minimum(np.abs(before[steps]), np.abs(after[steps])) / APPROACH_S
    offset = np.tile(np.eye(4), (len(steps), 1, 1))
    offset[:, 0, 3] = -APPROACH_M * u**2 * (3 - 2 * u)
    return steps, problem.object[steps] @ problem.grasp @ offset


class ExecutionGraph(Graph):
    """The adaptation's graph, with the robot's start, and the straight way onto the handle and off it."""

    def __init__(
        self,
        problem: Problem,
        platform: Platform,
        start: RobotPose,
        steps: np.ndarray,
        T_straight: Float[np.ndarray, "n 4 4"],
        pivot: float,
    ):
        super().__init__(problem, platform)
        self.pivot = pivot
        self._start, self._steps, self._straight = start, steps, T_straight

    def observations(self, state: State, stage: Stage) -> list[Linear]:
        """Those of the adaptation, and ours."""
        first = np.zeros(1, int)
        e, J = edges.follow_planar(self._start.xy_yaw[None], state.base[:1])
        out = [_linear("start", first, e, BASE, J, np.array(_ANCHOR))]
        lift = state.torso[:1, None] - self._start.torso_height
        out.append(_linear("start", first, lift, TORSO, np.ones((1, 1, 1)), np.array(_ANCHOR[:1])))
        e, J = edges.follow_pose(self._straight, state.gripper[self._steps])
        out.append(_linear("straight", self._steps, e, GRIPPER, J, _STRAIGHT))
        return [*super().observations(state, stage), *out]


def _linear(kind: str, steps: np.ndarray, e: np.ndarray, columns: slice, J: np.ndarray, sigma: np.ndarray) -> Linear:
    r = e / sigma
    return Linear(kind, np.sum(r**2, axis=1), steps, r, [(0, columns, J / sigma[:, None])])
