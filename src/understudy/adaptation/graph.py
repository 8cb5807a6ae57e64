"""The adaptation graph: every edge of all demonstrations of one task, weighted, as one chain for the solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from understudy import lie
from understudy.adaptation import edges
from understudy.adaptation.fields import DistanceField, half_planes, outline
from understudy.adaptation.platform import Platform
from understudy.adaptation.solver import Linear
from understudy.adaptation.weights import Limits, Margins, Stage, Weights

GRIPPER, BASE, TORSO = slice(0, 6), slice(6, 9), slice(9, 10)
"""Columns among a step's unknowns."""

GRIPPER_POINTS: Final = np.array([[-0.12, 0, 0], [-0.20, 0, 0], [-0.28, 0, 0], [-0.36, 0, 0]])
"""Middle line of palm, wrist and the forearm's end, tool frame, metres: kept clear of the scene's points."""
GRIPPER_RADIUS_M: Final = 0.06

_SPACING_M: Final = 0.08  # of points on the footprint's outline


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns."""

    gripper: Float[np.ndarray, "n 4 4"]
    base: Float[np.ndarray, "n 3"]
    torso: Float[np.ndarray, " n"]
    grasp: Float[np.ndarray, "4 4"]
    """T_object_tool, shared"""

    def retract(self, step: Float[np.ndarray, "n 10"], shared: Float[np.ndarray, "6"]) -> State:
        """The state moved along a tangent step."""
        return State(
            self.gripper @ lie.se3_exp(step[:, GRIPPER]),
            lie.se2_compose(self.base, lie.se2_exp(step[:, BASE])),
            self.torso + step[:, 9],
            self.grasp @ lie.se3_exp(shared),
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Fields of one demonstration."""

    steps: slice
    """of the chain"""
    obstacles: DistanceField
    unknown: DistanceField | None
    scene: DistanceField | None


@dataclass(frozen=True, eq=False)
class Problem:
    """All data of the graph, stacked over the demonstrations of one task; n steps in all."""

    dt: Float[np.ndarray, " n"]
    """to the next step; NaN at each demonstration's last"""
    hand: Float[np.ndarray, "n 4 4"]
    """H X; NaN where there is none"""
    hand_covariance: Float[np.ndarray, "n 6 6"]
    """of H X, in its own tangent space"""
    torso: Float[np.ndarray, "n 3"]
    """P Y; NaN where there is none"""
    torso_covariance: Float[np.ndarray, "n 3 3"]
    object: Float[np.ndarray, "n 4 4"]
    """NaN where it does not matter"""
    holding: Bool[np.ndarray, " n"]
    approaching: Bool[np.ndarray, " n"]
    """just before taking hold or after letting go"""
    grasp_steps: Int[np.ndarray, " d"]
    """where each demonstration takes hold"""
    grasp: Float[np.ndarray, "4 4"]
    """the chosen feasible grasp g_k: T_object_tool"""
    panel: Float[np.ndarray, "n m 2"]
    """the moving part from above; NaN where there is none"""
    surroundings: tuple[Surroundings, ...]


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
        inradius = float(half_planes(platform.footprint)[1].min())
        points = outline(platform.footprint, _SPACING_M)
        radii = np.append(np.zeros(len(points)), max(inradius, 0.0))
        self.footprint_points = np.vstack([points, np.zeros((1, 2))]), radii
        """points of the base's outline and its middle (base frame), and the radius that each stands for"""
        self._hand = np.flatnonzero(np.isfinite(problem.hand).all(axis=(1, 2)))
        self._torso = np.flatnonzero(np.isfinite(problem.torso).all(axis=1))
        w = self.weights
        spread = np.where(problem.holding[:, None], _six(w.hand_holding), _six(w.hand)) ** 2
        self._hand_root = _inverse_root(problem.hand_covariance[self._hand], spread[self._hand])
        t = np.array([w.torso[0], w.torso[0], w.torso[1]]) ** 2
        self._torso_root = _inverse_root(problem.torso_covariance[self._torso], np.tile(t, (len(self._torso), 1)))
        self._pairs = np.flatnonzero(np.isfinite(problem.dt))
        linked = np.isfinite(problem.dt)
        self._triples = np.flatnonzero(linked[:-1] & linked[1:])
        self._holding = np.flatnonzero(problem.holding)
        self._approaching = np.flatnonzero(problem.approaching)
        self._near_panel = np.flatnonzero(np.isfinite(problem.panel).any(axis=(1, 2)))

    def with_grasp(self, grasp: Float[np.ndarray, "4 4"]) -> None:
        """Chooses another feasible grasp."""
        self.problem = replace(self.problem, grasp=grasp)

    def stretch(self, factor: float) -> None:
        """Slows the clock down."""
        self.problem = replace(self.problem, dt=factor * self.problem.dt)

    def excess(self, state: State) -> float:
        """Greatest velocity or acceleration over its limit, of base, torso and gripper: 1 is just kept."""
        a, t = self._pairs, self._triples
        dt = self.problem.dt[a][:, None]
        v = edges.between_poses(state.gripper[a], state.gripper[a + 1])[0] / dt
        u = edges.between_planar(state.base[a], state.base[a + 1])[0] / dt
        first = np.searchsorted(a, t)
        change = (u[first + 1] - u[first]) / (0.5 * (dt[first] + dt[first + 1]))
        lift = np.diff(state.torso)[a] / dt[:, 0]
        ratios = (
            np.linalg.norm(v[:, :3], axis=1) / self.limits.speed,
            np.linalg.norm(v[:, 3:], axis=1) / self.limits.turning,
            np.abs(u) / self.platform.base_velocity,
            np.abs(change) / self.platform.base_acceleration,
            np.abs(lift) / self.platform.torso_velocity,
        )
        return float(max(r.max(initial=0.0) for r in ratios))

    def missed(self, state: State) -> tuple[float, float]:
        """How far the worst grasp is off the chosen one: metres, radians."""
        k = self.problem.grasp_steps
        off = edges.follow_pose(self.problem.object[k] @ self.problem.grasp, state.gripper[k])[0]
        return float(np.linalg.norm(off[:, :3], axis=1).max()), float(np.linalg.norm(off[:, 3:], axis=1).max())

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
        hand = _weighted("hand", self._hand, e, [(0, GRIPPER, J)], self._hand_root, stage.kernel, w.kernel_width)
        e, J = edges.follow_planar(p.torso[self._torso], state.base[self._torso])
        torso = _weighted("torso", self._torso, e, [(0, BASE, J)], self._torso_root, stage.kernel, w.kernel_width)
        n = len(state.torso)
        rest = (state.torso - self.platform.torso_rest)[:, None]
        lift = _scaled("torso lift", np.arange(n), rest, [(0, TORSO, np.ones((n, 1, 1)))], np.array([w.torso_rest]))
        return [hand, torso, lift]

    def grasping(self, state: State, stage: Stage) -> list[Linear]:
        """Take hold with the chosen grasp; keep hold with the shared one; come and go along the approach (x free)."""
        p, sigma = self.problem, _six(self.weights.grasp) / stage.grasp
        k, h = p.grasp_steps, self._holding
        e, J = edges.follow_pose(p.object[k] @ p.grasp, state.gripper[k])
        take = _scaled("grasp", k, e, [(0, GRIPPER, J)], sigma)
        e, J, J_grasp = edges.rigid_grasp(state.grasp, p.object[h], state.gripper[h])
        hold = _scaled("rigid", h, e, [(0, GRIPPER, J)], sigma, J_grasp)
        a, sigma = self._approaching, _six(self.weights.approach)[1:] / stage.grasp
        e, J, J_grasp = edges.rigid_grasp(state.grasp, p.object[a], state.gripper[a])
        return [take, hold, _scaled("approach", a, e[:, 1:], [(0, GRIPPER, J[:, 1:])], sigma, J_grasp[:, 1:])]

    def motion(self, state: State, stage: Stage) -> list[Linear]:
        """Smoothness and limits of velocities and accelerations."""
        w, share, a = self.weights, self.margins.speed, self._pairs
        dt = self.problem.dt[a][:, None]
        limit = np.array([1.0, 1.0, 3.0]) * w.limit / stage.constraints
        v, Ja, Jb = _rates(edges.between_poses(state.gripper[a], state.gripper[a + 1]), dt)
        u, Ka, Kb = _rates(edges.between_planar(state.base[a], state.base[a + 1]), dt)
        lift = (state.torso[a + 1, None] - state.torso[a, None]) / dt
        one = (1 / dt)[..., None]
        gripper, base = [(0, GRIPPER, Ja), (1, GRIPPER, Jb)], [(0, BASE, Ka), (1, BASE, Kb)]
        torso = [(0, TORSO, -one), (1, TORSO, one)]
        out = [
            _scaled("gripper speed", a, v, gripper, _six(w.gripper_speed)),
            _scaled("base speed", a, u, base, _three(w.base_speed)),
            _scaled("torso speed", a, lift, torso, np.array([w.torso_speed])),
        ]
        for columns, greatest, sigma in (
            (slice(0, 3), self.limits.speed, limit[0]),
            (slice(3, 6), self.limits.turning, limit[2]),
        ):
            e, along = edges.longer(v[:, columns], share * greatest)
            parts = [(s, c, along @ J[:, columns]) for s, c, J in gripper]
            out.append(_active("limits", a, e, parts, np.array([sigma])))
        top = share * self.platform.base_velocity
        out.append(_limited(a, u, base, -top, top, limit))
        top = np.array([share * self.platform.torso_velocity])
        out.append(_limited(a, lift, torso, -top, top, limit[:1]))
        return [*out, *self._accelerations((v, Ja, Jb), (u, Ka, Kb), limit)]

    def _accelerations(self, gripper: _Rates, base: _Rates, limit: np.ndarray) -> list[Linear]:
        w, dt = self.weights, self.problem.dt
        first = np.searchsorted(self._pairs, self._triples)
        at = 0.5 * (dt[self._triples] + dt[self._triples + 1])[:, None]
        out = []
        for name, columns, (v, Ja, Jb), sigma, size in (
            ("gripper acceleration", GRIPPER, gripper, w.gripper_acceleration, _six),
            ("base acceleration", BASE, base, w.base_acceleration, _three),
        ):
            if sigma is None:
                continue
            a = (v[first + 1] - v[first]) / at
            middle = (Ja[first + 1] - Jb[first]) / at[..., None]
            parts = [(0, columns, -Ja[first] / at[..., None]), (1, columns, middle)]
            parts.append((2, columns, Jb[first + 1] / at[..., None]))
            out.append(_scaled(name, self._triples, a, parts, size(sigma)))
            if columns == BASE:
                top = self.margins.speed * self.platform.base_acceleration
                out.append(_limited(self._triples, a, parts, -top, top, limit))
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
        out = [_active("reach", every, e, parts, np.array([w.reach / stage.constraints]))]
        least, greatest = (np.array([x]) for x in platform.torso_limits)
        one = np.ones((n, 1, 1))
        limit = np.array([0.1 * w.limit / stage.constraints])
        out.append(_limited(every, state.torso[:, None], [(0, TORSO, one)], least, greatest, limit))
        for s in p.surroundings:
            out.extend(self._clearances(state, s, w.obstacle / stage.constraints))
        near = self._near_panel
        if len(near):
            e, J = edges.panel_clearance(platform.footprint, p.panel[near], state.base[near], self.margins.panel)
            sigma = np.full(e.shape[1], w.obstacle / stage.constraints)
            out.append(_active("moving part", near, e, [(0, BASE, J)], sigma))
        return out

    def _clearances(self, state: State, around: Surroundings, sigma: float) -> list[Linear]:
        steps = np.arange(around.steps.start, around.steps.stop)
        base = state.base[around.steps]
        points, radii = self.footprint_points
        e, J = edges.base_clearance(around.obstacles, points, radii, base, self.obstacle_margin)
        out = [_active("map", steps, e, [(0, BASE, J)], np.full(e.shape[1], sigma))]
        if around.unknown is not None:
            e, J = edges.base_clearance(around.unknown, points[-1:], radii[-1:], base, 0.0)
            out.append(_active("unknown", steps, e, [(0, BASE, J)], np.array([self.weights.unknown])))
        if around.scene is not None:
            e, J = edges.gripper_clearance(around.scene, GRIPPER_POINTS, GRIPPER_RADIUS_M, state.gripper[around.steps])
            out.append(_active("scene", steps, e, [(0, GRIPPER, J)], np.full(e.shape[1], 3 * sigma)))
        return out


_Rates = tuple[np.ndarray, np.ndarray, np.ndarray]
_Parts = Sequence[tuple[int, slice, np.ndarray]]


def _rates(between: _Rates, dt: np.ndarray) -> _Rates:
    e, Ja, Jb = between
    return e / dt, Ja / dt[..., None], Jb / dt[..., None]


def _six(pair: tuple[float, float]) -> Float[np.ndarray, "6"]:
    return np.repeat(np.array(pair), 3)


def _three(pair: tuple[float, float]) -> Float[np.ndarray, "3"]:
    return np.array([pair[0], pair[0], pair[1]])


def _inverse_root(covariance: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """A with A' A the inverse of covariance + diag(spread), per row."""
    k = covariance.shape[-1]
    total = covariance + spread[:, :, None] * np.eye(k)
    return np.linalg.inv(np.linalg.cholesky(total)) if len(total) else np.zeros((0, k, k))


def _weighted(
    kind: str, steps: np.ndarray, e: np.ndarray, parts: _Parts, root: np.ndarray, kernel: str, width: float
) -> Linear:
    """Edges with a full weight matrix each, and a robust kernel."""
    r = (root @ e[..., None])[..., 0]
    cost, weight = edges.robust(np.sum(r**2, axis=1), kernel, width)
    scale = np.sqrt(weight)[:, None]
    whitened = [(s, c, scale[..., None] * (root @ J)) for s, c, J in parts]
    return Linear(kind, cost, steps, scale * r, whitened)


def _scaled(
    kind: str,
    steps: np.ndarray,
    e: np.ndarray,
    parts: _Parts,
    sigma: Float[np.ndarray, " k"],
    border: np.ndarray | None = None,
) -> Linear:
    """Edges with one standard deviation per residual."""
    r = e / sigma
    whitened = [(s, c, J / sigma[:, None]) for s, c, J in parts]
    return Linear(kind, np.sum(r**2, axis=1), steps, r, whitened, None if border is None else border / sigma[:, None])


def _active(kind: str, steps: np.ndarray, e: np.ndarray, parts: _Parts, sigma: np.ndarray) -> Linear:
    """Hinges: only those that push."""
    on = np.flatnonzero((e > 0).any(axis=1))
    return _scaled(kind, steps[on], e[on], [(s, c, J[on]) for s, c, J in parts], sigma)


def _limited(
    steps: np.ndarray, x: np.ndarray, parts: _Parts, least: np.ndarray, greatest: np.ndarray, sigma: np.ndarray
) -> Linear:
    """Numbers that must stay in a range."""
    e, slope = edges.beyond(x, least, greatest)
    return _active("limits", steps, e, [(s, c, slope[..., None] * J) for s, c, J in parts], sigma)
