"""Where the graph starts from: a grasp that a base can serve, the calibration, a path of the base."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.adaptation import calibration as calibrations
from understudy.adaptation import grasps, parts, prepare
from understudy.adaptation.base_path import plan_path
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.placement import Search, estimate_torso_base, search_path
from understudy.adaptation.platform import Platform
from understudy.adaptation.problem import Problem, State, Surroundings
from understudy.demonstration.demonstration import Demonstration

_HEIGHTS: Final = (0.5, 0.85, 0.15)  # of the torso, shares of its range, in the order in which they are tried
_SERVED: Final = 0.3  # mean cost of reach and obstacles along a base path: below, the graph does the rest
_UNSERVED: Final = 3.0  # above, other families of grasps and other heights are tried
_HOPELESS: Final = 40.0  # above, neither a turned grasp nor a planned path helps
_SAME_M: Final = 0.01  # between grasps (a radian is 0.3 m)
_REFINED: Final = 2
_TIGHT_M: Final = 0.03  # margin of a planned path: doorways are narrow
_OTHER_M: Final = 5.0  # of a grasp from those that the hands show (a radian is 0.3 m) that costs 1

Grasp = tuple[grasps.GraspFamily, Float[np.ndarray, "4 4"]]


@dataclass(frozen=True, eq=False)
class Start:
    """A grasp with everything that follows from it before the graph is solved."""

    family: grasps.GraspFamily
    calibration: Calibration
    problem: Problem
    state: State
    cost: float
    """mean over the demonstrations of reach and obstacles along the base's path: 1 is a violation by 2 cm throughout"""


@dataclass(frozen=True, eq=False)
class Starts:
    """Finds a start for demonstrations of one task."""

    demonstrations: tuple[Demonstration, ...]
    platform: Platform
    calibration: Calibration | None
    """None: to be estimated"""
    obstacles: prepare.Obstacles

    def hands(self) -> Float[np.ndarray, "d 4 4"]:
        """Where a gripper would hold the object if it were the hand."""
        return calibrations.typical_tools(self.demonstrations, self.calibration or Calibration.default())

    def ranked(self) -> Iterator[Start]:
        """The grasp nearest to the hands of all demonstrations, if a base can serve it; otherwise the one that a base
        serves best, with how far it is from the hands. After it others, best first: for who finds that the first leads
        nowhere.
        """
        handle = grasps.common_handle([d.handle for d in self.demonstrations])
        hands = self.hands()
        ranked = grasps.ranked(handle, self.platform, hands)
        first, rest = ranked[0][0], self._candidates(ranked, hands)
        tried: list[tuple[float, Start]] = []
        least = np.inf
        for family, grasp in rest:
            if family is first and least > _HOPELESS and tried:
                continue
            tried.append(self._tried(family, grasp, hands))
            least = min(least, tried[-1][0])
            if tried[-1][1].cost <= _SERVED or (family is not first and least <= _UNSERVED):
                break
        best = min(tried, key=lambda one: one[0])
        yield self._settled(best[1])
        if best[1].cost > _HOPELESS:
            return
        tried += [self._tried(family, grasp, hands) for family, grasp in rest if family is best[1].family]
        given = [best[1].state.grasp]
        for _, start in sorted(tried, key=lambda one: one[0]):
            if grasps.distance(start.state.grasp, np.array(given)).min() > _SAME_M:
                given.append(start.state.grasp)
                yield self._settled(start)

    def _tried(
        self, family: grasps.GraspFamily, grasp: Float[np.ndarray, "4 4"], hands: Float[np.ndarray, "d 4 4"]
    ) -> tuple[float, Start]:
        """A start, and what it costs together with how far it is from the hands."""
        start = self.of(family, grasp, refined=False)
        return start.cost + (float(np.mean(grasps.distance(grasp, hands))) / _OTHER_M if len(hands) else 0.0), start

    def _settled(self, start: Start) -> Start:
        """With planned base paths where those near the torso do not serve and there is hope."""
        settled = start.cost <= _SERVED or start.cost > _HOPELESS
        return start if settled else self.of(start.family, start.state.grasp, refined=True)

    def _candidates(self, ranked: list[Grasp], hands: Float[np.ndarray, "d 4 4"]) -> Iterator[Grasp]:
        """The nearest grasp of each family; after the first, others of its family."""
        yield ranked[0]
        for family, grasp in ranked[:1]:
            yield from ((family, other) for other in grasps.turned(family, grasp, hands))
        yield from ranked[1:]

    def of(self, family: grasps.GraspFamily, grasp: Float[np.ndarray, "4 4"], refined: bool) -> Start:
        """Calibration, first guesses of gripper and base for a grasp. refined: base paths are planned on a lattice."""
        shown, platform = self.demonstrations, self.platform
        given = self.calibration
        if given is None:
            X, X_left = calibrations.estimate_hand_tools(shown, grasp)
            calibration = Calibration(X, calibrations.DEFAULT_TORSO_BASE, X_left)
        else:
            calibration = given
        problem = prepare.stacked(shown, calibration, grasp, self.obstacles)
        gripper = prepare.first_gripper(problem, grasp)
        search = Search(problem, platform, gripper, platform.torso_rest)
        if given is None:
            torso = [prepare.first_base(d, np.zeros(3)) for d in shown]
            Y = estimate_torso_base(search, torso, calibration.torso_base)
            calibration = replace(calibration, torso_base=Y)
            problem = prepare.stacked(shown, calibration, grasp, self.obstacles)
        base, height, cost = self._placed(replace(search, problem=problem), calibration, refined)
        return Start(family, calibration, problem, State(gripper, base, np.full(len(base), height), grasp), cost)

    def _placed(
        self, search: Search, calibration: Calibration, refined: bool
    ) -> tuple[Float[np.ndarray, "n 3"], float, float]:
        """Base paths of all demonstrations, the torso's height, and the cost.

        The torso is slow, so one height is sought for all: the middle of its range, others only where that fails.
        """
        low, high = self.platform.torso_limits
        fronts = [parts.front_heading(d) for d in self.demonstrations]
        best: tuple[np.ndarray, float, float] | None = None
        for share in _HEIGHTS:
            search = replace(search, torso=low + share * (high - low))
            found = [
                self._path(search, around, prepare.first_base(d, calibration.torso_base), front, refined)
                for around, d, front in zip(search.problem.surroundings, self.demonstrations, fronts, strict=True)
            ]
            cost = float(np.mean([c for _, c in found]))
            if best is None or cost < best[2]:
                best = np.concatenate([path for path, _ in found]), search.torso, cost
            if cost <= _UNSERVED:
                break
        assert best is not None
        return best

    def _path(
        self, search: Search, around: Surroundings, base: Float[np.ndarray, "t 3"], front: float, refined: bool
    ) -> tuple[Float[np.ndarray, "t 3"], float]:
        """Near the torso, if there is room; otherwise planned."""
        near, _ = search_path(search, around, base)
        cost = search.mean_cost(around, near)
        if cost <= _SERVED or not refined:
            return near, cost
        planned = plan_path(search, around, base, front)
        for _ in range(_REFINED):
            planned, _worst = search_path(replace(search, margin=_TIGHT_M), around, planned, fine=True)
        other = search.mean_cost(around, planned)
        return (planned, other) if other < cost else (near, cost)
