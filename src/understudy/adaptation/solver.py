"""Levenberg-Marquardt on a chain of unknowns with a border: banded Cholesky, time linear in the number of steps.

Each step has 10 unknowns, interleaved: gripper (6), base (3), torso height (1). An edge touches up to three steps in a
row, and possibly the border: 6 unknowns that all steps share (the grasp). The border is eliminated by its Schur
complement, so it does not widen the band. All assembly is vectorised over steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

WIDTH: Final = 10
"""unknowns per step"""
BORDER: Final = 6
"""unknowns that all steps share"""
SPAN: Final = 3
"""greatest number of steps in a row that an edge touches"""

_BANDS: Final = WIDTH * SPAN
_FIRST_DAMPING: Final = 1e-3
_LARGEST_DAMPING: Final = 1e9
_GROWTH: Final = 4.0
_LEAST_DIAGONAL: Final = 1e-6
_STALLS: Final = 2  # steps in a row with next to no gain: converged

State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Linear:
    """Edges of one kind, linearised and whitened; n edges with k residuals each. At most one edge per first step."""

    kind: str
    cost: Float[np.ndarray, " n"]
    """robust, per edge"""
    steps: Int[np.ndarray, " n"]
    """first step that the edge touches"""
    residual: Float[np.ndarray, "n k"]
    """times the square root of the robust weight; so are the Jacobians"""
    parts: Sequence[tuple[int, slice, Float[np.ndarray, "n k _"]]]
    """(steps after the first, columns among the step's unknowns, Jacobian), ordered by step"""
    border: Float[np.ndarray, "n k 6"] | None = None


@dataclass(frozen=True)
class Iteration:
    """What one iteration of the solver found."""

    stage: int
    cost: float
    costs: dict[str, float]
    """by kind of edge"""
    damping: float
    accepted: bool


@dataclass(frozen=True, eq=False)
class Convergence:
    """The solver's course. Costs of different stages are not comparable: the weights differ."""

    iterations: tuple[Iteration, ...]
    converged: bool
    """the last stage stopped because nothing was to be gained"""
    seconds: float
    """wall time of all rounds, with the exact checks in between"""
    process_seconds: float
    """processor time of the same"""

    def table(self) -> str:
        """Costs per kind of edge at every accepted iteration, for people."""
        kinds = sorted({kind for i in self.iterations for kind in i.costs})
        lines = ["stage  " + "  ".join(f"{kind:>12}" for kind in ["total", *kinds])]
        for i in (i for i in self.iterations if i.accepted):
            values = [i.cost, *(i.costs.get(kind, 0.0) for kind in kinds)]
            lines.append(f"{i.stage:>5}  " + "  ".join(f"{v:12.5g}" for v in values))
        return "\n".join(lines)


@dataclass(eq=False)
class _Normal:
    """Normal equations in blocks."""

    n: int
    blocks: list[np.ndarray] = field(init=False)
    """[s][t]: between steps t and t + s"""

    def __post_init__(self) -> None:
        self.blocks = [np.zeros((self.n, WIDTH, WIDTH)) for _ in range(SPAN)]
        self.gradient = np.zeros((self.n, WIDTH))
        self.across = np.zeros((self.n, WIDTH, BORDER))
        self.corner = np.zeros((BORDER, BORDER))
        self.border_gradient = np.zeros(BORDER)

    def add(self, edges: Linear) -> None:
        """Adds J' J and J' r."""
        for i, (first, rows, A) in enumerate(edges.parts):
            At = np.ascontiguousarray(np.swapaxes(A, 1, 2))
            self.gradient[edges.steps + first, rows] += (At @ edges.residual[..., None])[..., 0]
            for second, columns, B in edges.parts[i:]:
                product = At @ B
                self.blocks[second - first][edges.steps + first, rows, columns] += product
                if second == first and rows != columns:
                    self.blocks[0][edges.steps + first, columns, rows] += np.swapaxes(product, 1, 2)
            if edges.border is not None:
                self.across[edges.steps + first, rows] += At @ edges.border
        if edges.border is not None:
            flat = edges.border.reshape(-1, BORDER)
            self.corner += flat.T @ flat
            self.border_gradient += flat.T @ edges.residual.reshape(-1)

    def diagonals(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the chain (n, 10) and of the border (6)."""
        return np.diagonal(self.blocks[0], axis1=1, axis2=2), np.diagonal(self.corner)

    def band(self, extra: np.ndarray) -> np.ndarray:
        """Lower band (30, 10 n) for LAPACK, in its order, with `extra` (n, 10) added to the diagonal."""
        a, b = np.meshgrid(np.arange(WIDTH), np.arange(WIDTH), indexing="ij")
        ab = np.zeros((self.n, WIDTH, _BANDS))  # [t, column, row - column]: the transpose is what LAPACK wants
        for s, block in enumerate(self.blocks):
            keep = (a >= b) if s == 0 else np.ones_like(a, bool)
            source = block if s == 0 else np.swapaxes(block, 1, 2)  # [row in step t + s, column in step t]
            ab[:, b[keep], WIDTH * s + a[keep] - b[keep]] = source[:, a[keep], b[keep]]
        ab[:, :, 0] += extra
        return ab.reshape(-1, _BANDS).T

    def solve(
        self, chain_extra: np.ndarray, border_extra: np.ndarray, free_border: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Steps (n, 10) and (6) that minimise the damped quadratic model. Raises LinAlgError when it is not convex."""
        factor = cholesky_banded(self.band(chain_extra), overwrite_ab=True, lower=True, check_finite=False)
        right = np.column_stack([-self.gradient.reshape(-1), self.across.reshape(-1, BORDER)])
        if not free_border:
            chain = cho_solve_banded((factor, True), right[:, 0], overwrite_b=True, check_finite=False)
            return chain.reshape(self.n, WIDTH), np.zeros(BORDER)
        solved = cho_solve_banded((factor, True), right, check_finite=False)
        schur = self.corner + np.diag(border_extra) - right[:, 1:].T @ solved[:, 1:]
        border = np.linalg.solve(schur, -self.border_gradient - right[:, 1:].T @ solved[:, 0])
        return (solved[:, 0] - solved[:, 1:] @ border).reshape(self.n, WIDTH), border


@dataclass(frozen=True)
class Stop:
    """When to stop."""

    tolerance: float = 1e-6
    """relative decrease of the cost that counts as none"""
    iterations: int = 60


class Chain(Generic[State]):
    """What the solver needs of a problem; `graph.Graph` is the one of the adaptation."""

    def __init__(
        self,
        n: int,
        linearise: Callable[[State], Sequence[Linear]],
        retract: Callable[[State, Any, Any], State],
        free_border: bool = True,
    ):
        self.n, self.linearise, self.retract, self.free_border = n, linearise, retract, free_border


def minimise(chain: Chain[State], state: State, stop: Stop, stage: int = 0) -> tuple[State, list[Iteration], bool]:
    """Levenberg-Marquardt with Nielsen's damping. Returns the state, the course, and whether it converged."""
    edges = chain.linearise(state)
    cost, course = _cost(edges), []
    course.append(Iteration(stage, cost, costs_by_kind(edges), _FIRST_DAMPING, True))
    normal = _assembled(chain.n, edges)
    damping, growth, stalls = _FIRST_DAMPING, _GROWTH, 0
    for _ in range(stop.iterations):
        diagonal, corner = (np.maximum(d, _LEAST_DIAGONAL) for d in normal.diagonals())
        try:
            step, shared = normal.solve(damping * diagonal, damping * corner, chain.free_border)
        except LinAlgError:
            damping, growth = damping * growth, growth * 2
            if damping > _LARGEST_DAMPING:
                return state, course, False
            continue
        trial = chain.retract(state, step, shared)
        trial_edges = chain.linearise(trial)
        trial_cost = _cost(trial_edges)
        predicted = float(
            np.sum(step * (damping * diagonal * step - normal.gradient))
            + np.sum(shared * (damping * corner * shared - normal.border_gradient))
        )
        gain = (cost - trial_cost) / max(predicted, 1e-300)
        accepted = bool(np.isfinite(trial_cost) and gain > 0)
        course.append(Iteration(stage, trial_cost, costs_by_kind(trial_edges), damping, accepted))
        if accepted:
            stalls = stalls + 1 if cost - trial_cost <= stop.tolerance * cost else 0
            state, edges, cost = trial, trial_edges, trial_cost
            normal = _assembled(chain.n, edges)
            damping, growth = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 1e-12), _GROWTH
        else:
            damping, growth = damping * growth, growth * 2
        if stalls == _STALLS or predicted <= 0.01 * stop.tolerance * cost:
            return state, course, True
        if damping > _LARGEST_DAMPING:
            return state, course, False
    return state, course, False


class Stopwatch:
    """Wall and processor time since it was made."""

    def __init__(self) -> None:
        self._wall, self._process = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Seconds: wall, processor."""
        return time.perf_counter() - self._wall, time.process_time() - self._process


def costs_by_kind(edges: Sequence[Linear]) -> dict[str, float]:
    """Sum of the costs of each kind of edge."""
    costs: dict[str, float] = {}
    for e in edges:
        costs[e.kind] = costs.get(e.kind, 0.0) + float(e.cost.sum())
    return costs


def _cost(edges: Sequence[Linear]) -> float:
    return float(sum(e.cost.sum() for e in edges))


def _assembled(n: int, edges: Sequence[Linear]) -> _Normal:
    normal = _Normal(n)
    for e in edges:
        normal.add(e)
    return normal
