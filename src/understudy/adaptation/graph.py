"""The adaptation graph: every edge of all demonstrations of one task, weighted, as one chain for the solver."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation import edges
from understudy.adaptation.clock import base_motion, gripper_motion, joined
from understudy.adaptation.fields import half_planes
from understudy.adaptation.platform import Platform
from understudy.adaptation.problem import BASE, GRIPPER, TORSO, Problem, State, Surroundings
from understudy.adaptation.solver import Linear
from understudy.adaptation.weights import Limits, Margins, Stage, Weights
from understudy.adaptation.whitening import Rates, active, inverse_root, limited, rates, scaled, six, three, weighted

__all__ = [
    "BASE",
    "GRIPPER",
    "GRIPPER_POINTS",
    "GRIPPER_RADIUS_M",
    "TORSO",
    "Graph",
    "Problem",
    "Stage",
    "State",
    "Surroundings",
]

GRIPPER_POINTS: Final = np.array([[-0.12, 0, 0], [-0.20, 0, 0], [-0.28, 0, 0], [-0.36, 0, 0]])
"""Middle line of palm, wrist and the forearm's end, tool frame, metres: kept clear of the scene's points."""
GRIPPER_RADIUS_M: Final = 0.06


class Graph:
    """A problem on a platform, ready to be linearised."""

    def __init__(
        self,
        problem: Problem,
        platform: Platform,
        weights: Weights | None = None,
        margins: Margins | None = None,
        limits: Limits | None = None,
    ):
        self.problem, self.platform = problem, platform
        self.weights, self.margins, self.limits = weights or Weights(), margins or Margins(), limits or Limits()
        self.reach_margin = np.full(len(problem.dt), self.margins.reach)
        self.obstacle_margin = self.margins.obstacle
        self.map_stiffness, self.part_stiffness, self.following = np.ones((3, len(problem.dt)))
        self._inradius = max(float(half_planes(platform.footprint)[1].min()), 0.0)
        self._hand = np.flatnonzero(np.isfinite(problem.hand).all(axis=(1, 2)))
        self._torso = np.flatnonzero(np.isfinite(problem.torso).all(axis=1))
        w = self.weights
        spread = np.where(problem.holding[:, None], six(w.hand_holding), six(w.hand)) ** 2
        self._hand_root = inverse_root(problem.hand_covariance[self._hand], spread[self._hand])
        t = np.array([w.torso[0], w.torso[0], w.torso[1]]) ** 2
        self._torso_root = inverse_root(problem.torso_covariance[self._torso], np.tile(t, (len(self._torso), 1)))
        self._pairs = np.flatnonzero(np.isfinite(problem.dt))
        free = np.isnan(problem.hand).any(axis=(1, 2)) & ~problem.holding
        self.resting = free
        linked = np.isfinite(problem.dt)
        self._triples = np.flatnonzero(linked[:-1] & linked[1:])
        self._holding = np.flatnonzero(problem.holding)
        self._approaching = np.flatnonzero(problem.approaching)
        self._near_panel = np.flatnonzero(np.isfinite(problem.panel).any(axis=(1, 2)))

    def with_grasp(self, grasp: Float[np.ndarray, "4 4"]) -> None:
        """Chooses another feasible grasp."""
        self.problem = replace(self.problem, grasp=grasp)

    def stretch(self, factor: Float[np.ndarray, " n"]) -> None:
        """Slows the clock down, per step."""
        self.problem = replace(self.problem, dt=factor * self.problem.dt)

    def rest_arm(self, steps: Bool[np.ndarray, " n"], share: float) -> None:
        """Where the part is not held: follow the hand less (times `share`), keep the arm's posture instead."""
        steps = steps & ~self.problem.holding
        self.following[steps] *= share
        self.resting = self.resting | steps

    def excess(self, state: State) -> Float[np.ndarray, " d"]:
        """Greatest velocity or acceleration of base, torso and gripper over its limit, per demonstration: 1 is just
        kept.
        """
        out = []
        for s in self.problem.surroundings:
            motion = joined(
                base_motion(self.platform, state.base[s.steps], state.torso[s.steps]),
                gripper_motion(self.limits, state.gripper[s.steps]),
            )
            speed, change = motion.shares(self.problem.dt[s.steps][:-1])
            out.append(max(speed.max(initial=0.0), change.max(initial=0.0)))
        return np.array(out)

    def missed(self, state: State) -> Float[np.ndarray, "d 2"]:
        """How far each grasp is off the chosen one: metres, radians."""
        k = self.problem.grasp_steps
        grasps, _ = self.problem.grasps(self.problem.grasp, k)
        off = edges.follow_pose(self.problem.object[k] @ grasps, state.gripper[k])[0]
        return np.column_stack([np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)])

    def linearise(self, state: State, stage: Stage) -> list[Linear]:
        """All edges at a state."""
        return [
            *self.observations(state, stage),
            *self.grasping(state, stage),
            *self.motion(state, stage),
            *self.constraints(state, stage),
        ]

    def observations(self, state: State, stage: Stage) -> list[Linear]:
        """Follow hand and torso; the torso's lift rests in the middle of its range."""
        p, w = self.problem, self.weights
        e, J = edges.follow_pose(p.hand[self._hand], state.gripper[self._hand])
        root = self.following[self._hand, None, None] * self._hand_root
        hand = weighted("hand", self._hand, e, [(0, GRIPPER, J)], root, stage.kernel, w.kernel_width)
        e, J = edges.follow_planar(p.torso[self._torso], state.base[self._torso])
        torso = weighted("torso", self._torso, e, [(0, BASE, J)], self._torso_root, stage.kernel, w.kernel_width)
        n = len(state.torso)
        rest = (state.torso - self.platform.torso_rest)[:, None]
        lift = scaled("torso lift", np.arange(n), rest, [(0, TORSO, np.ones((n, 1, 1)))], np.array([w.torso_rest]))
        return [hand, torso, lift]

    def grasping(self, state: State, stage: Stage) -> list[Linear]:
        """Take hold with the chosen grasp; keep hold with the shared one; come and go along the approach (x free)."""
        p, sigma = self.problem, six(self.weights.grasp) / stage.grasp
        k, h = p.grasp_steps, self._holding
        e, J = edges.follow_pose(p.object[k] @ p.grasps(p.grasp, k)[0], state.gripper[k])
        take = scaled("grasp", k, e, [(0, GRIPPER, J)], sigma)
        e, J, J_grasp = self._rigid(state, h)
        hold = scaled("rigid", h, e, [(0, GRIPPER, J)], sigma, J_grasp)
        a, sigma = self._approaching, six(self.weights.approach)[1:] / stage.grasp
        e, J, J_grasp = self._rigid(state, a)
        return [take, hold, scaled("approach", a, e[:, 1:], [(0, GRIPPER, J[:, 1:])], sigma, J_grasp[:, 1:])]

    def _rigid(self, state: State, steps: np.ndarray) -> Rates:
        grasps, signs = self.problem.grasps(state.grasp, steps)
        e, J, J_grasp = edges.rigid_grasp(grasps, self.problem.object[steps], state.gripper[steps])
        return e, J, J_grasp * signs[:, None]

    def motion(self, state: State, stage: Stage) -> list[Linear]:
        """Smoothness and limits of velocities and accelerations."""
        w, share, a = self.weights, self.margins.speed, self._pairs
        dt = self.problem.dt[a][:, None]
        limit = np.array([1.0, 1.0, 3.0]) * w.limit / stage.constraints
        v, Ja, Jb = rates(edges.between_poses(state.gripper[a], state.gripper[a + 1]), dt)
        u, Ka, Kb = rates(edges.between_planar(state.base[a], state.base[a + 1]), dt)
        lift = (state.torso[a + 1, None] - state.torso[a, None]) / dt
        one = (1 / dt)[..., None]
        gripper, base = [(0, GRIPPER, Ja), (1, GRIPPER, Jb)], [(0, BASE, Ka), (1, BASE, Kb)]
        torso = [(0, TORSO, -one), (1, TORSO, one)]
        out = [
            scaled("gripper speed", a, v, gripper, six(w.gripper_speed)),
            scaled("base speed", a, u, base, three(w.base_speed)),
            scaled("torso speed", a, lift, torso, np.array([w.torso_speed])),
        ]
        for columns, greatest, sigma in (
            (slice(0, 3), self.limits.speed, limit[0]),
            (slice(3, 6), self.limits.turning, limit[2]),
        ):
            e, along = edges.longer(v[:, columns], share * greatest)
            parts = [(s, c, along @ J[:, columns]) for s, c, J in gripper]
            out.append(active("limits", a, e, parts, np.array([sigma])))
        top = share * self.platform.base_velocity
        out.append(limited(a, u, base, -top, top, limit))
        top = np.array([share * self.platform.torso_velocity])
        out.append(limited(a, lift, torso, -top, top, limit[:1]))
        return [*out, *self._resting(state), *self._accelerations((v, Ja, Jb), (u, Ka, Kb), limit)]

    def _resting(self, state: State) -> list[Linear]:
        """Where no hand is followed the arm keeps its posture."""
        a = self._pairs[self.resting[self._pairs] & self.resting[self._pairs + 1]]
        if not len(a):
            return []
        b, dt = a + 1, self.problem.dt[a, None]
        e, before, after = edges.between_postures(state.gripper[a], state.base[a], state.gripper[b], state.base[b])
        parts = [
            (step, columns, J / dt[..., None])
            for step, both in enumerate((before, after))
            for columns, J in zip((GRIPPER, BASE), both, strict=True)
        ]
        return [scaled("posture", a, e / dt, parts, six(self.weights.posture))]

    def _accelerations(self, gripper: Rates, base: Rates, limit: np.ndarray) -> list[Linear]:
        w, dt = self.weights, self.problem.dt
        first = np.searchsorted(self._pairs, self._triples)
        at = 0.5 * (dt[self._triples] + dt[self._triples + 1])[:, None]
        out = []
        for name, columns, (v, Ja, Jb), sigma, size in (
            ("gripper acceleration", GRIPPER, gripper, w.gripper_acceleration, six),
            ("base acceleration", BASE, base, w.base_acceleration, three),
        ):
            if sigma is None:
                continue
            a = (v[first + 1] - v[first]) / at
            middle = (Ja[first + 1] - Jb[first]) / at[..., None]
            parts = [(0, columns, -Ja[first] / at[..., None]), (1, columns, middle)]
            parts.append((2, columns, Jb[first + 1] / at[..., None]))
            out.append(scaled(name, self._triples, a, parts, size(sigma)))
            if columns == BASE:
                top = self.margins.speed * self.platform.base_acceleration
                out.append(limited(self._triples, a, parts, -top, top, limit))
        return out

    def constraints(self, state: State, stage: Stage) -> list[Linear]:
        """Reachability, map, moving part, scene, the torso's range."""
        p, w, platform = self.problem, self.weights, self.platform
        n = len(state.torso)
        every = np.arange(n)
        e, J, J_base, J_torso = edges.reach(
            platform.reachability, state.gripper, state.base, state.torso, self.reach_margin
        )
        parts = [(0, GRIPPER, J), (0, BASE, J_base), (0, TORSO, J_torso)]
        out = [active("reach", every, e, parts, np.array([w.reach / stage.constraints]))]
        least, greatest = (np.array([x]) for x in platform.torso_limits)
        one = np.ones((n, 1, 1))
        limit = np.array([0.1 * w.limit / stage.constraints])
        out.append(limited(every, state.torso[:, None], [(0, TORSO, one)], least, greatest, limit))
        for s in p.surroundings:
            out.extend(self._clearances(state, s, w.obstacle / stage.constraints))
        near = self._near_panel
        if len(near):
            e, J = edges.panel_clearance(platform.footprint, p.panel[near], state.base[near], self.margins.panel)
            sigma, stiff = np.full(e.shape[1], w.obstacle / stage.constraints), self.part_stiffness[near, None]
            out.append(active("moving part", near, stiff * e, [(0, BASE, stiff[..., None] * J)], sigma))
        return out

    def _clearances(self, state: State, around: Surroundings, sigma: float) -> list[Linear]:
        steps = np.arange(around.steps.start, around.steps.stop)
        base = state.base[around.steps]
        e, J = edges.map_clearance(around.map, around.obstacles, self.platform.footprint, base, self.obstacle_margin)
        stiff = self.map_stiffness[steps, None]
        out = [active("map", steps, stiff * e, [(0, BASE, stiff[..., None] * J)], np.full(e.shape[1], sigma))]
        if around.unknown is not None:
            e, J = edges.base_clearance(around.unknown, np.zeros((1, 2)), np.array([self._inradius]), base, 0.0)
            out.append(active("unknown", steps, e, [(0, BASE, J)], np.array([self.weights.unknown])))
        if around.scene is not None:
            e, J = edges.gripper_clearance(around.scene, GRIPPER_POINTS, GRIPPER_RADIUS_M, state.gripper[around.steps])
            out.append(active("scene", steps, e, [(0, GRIPPER, J)], np.full(e.shape[1], 3 * sigma)))
        return out
