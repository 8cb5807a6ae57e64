"""How a body goes along with its hand: pelvis, trunk and elbow over the whole performance, by nonlinear least squares.

Unknown at every knot: x, y, yaw of the pelvis, bend, lean and twist of the trunk, how far the knees give way, and the
elbow's swivel. The hand on the handle has to be within reach with the wrist in its limits, the body clear of the
furniture, everything smooth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import spsolve

from understudy.stage.body import SIDES, SOLE, Skeleton
from understudy.stage.kinematics import Z, about, apply, forward
from understudy.stage.kinematics_body import SPINE, Trunk, root_of, solve_arm, trunk_rotations
from understudy.stage.motion_space import Space

KNOT_S: Final = 0.1
"""Seconds between knots."""
VARIABLES: Final = ("x", "y", "yaw", "bend", "lean", "twist", "crouch", "swivel")
_X, _Y, _YAW, _BEND, _LEAN, _TWIST, _CROUCH, _SWIVEL = range(8)
_ACCELERATION: Final = np.array([1.1, 1.1, 1.6, 1.0, 0.8, 1.6, 0.6, 3.0])  # usual, per second squared
_DELTA: Final = 1e-4
_ROUNDS: Final = 25
_STRAIGHT: Final = 0.997  # share of a leg's length that it stands
WRIST_LIMIT: Final = np.radians(55)
"""How far a wrist bends without a cost."""
_PRONATION: Final = np.radians(75)
_CHAIN: Final = (*SPINE, "clavicle", "shoulder01", "upperarm01", "neck01", "head")


@dataclass(frozen=True, eq=False)
class Wishes:
    """What the fit should do, at every knot."""

    xy: Float[np.ndarray, "n 2"]
    """the pelvis's place"""
    yaw: Float[np.ndarray, " n"]
    T_world_hand: Float[np.ndarray, "n 4 4"]
    """the acting hand, where it holds the handle"""
    hold: Float[np.ndarray, " n"]
    """0 to 1: how much it has to be there"""
    q: Float[np.ndarray, " n"]
    posture: Float[np.ndarray, "8"]
    """what pelvis and trunk do by themselves; its x, y and yaw are not used"""


def standing_height(skeleton: Skeleton) -> float:
    """Of the hips above the floor, knees almost straight, metres."""
    leg = skeleton.length("upperleg01", "lowerleg01", "left") + skeleton.length("lowerleg01", "foot", "left")
    return float(skeleton.head("foot", "left")[2]) + SOLE + _STRAIGHT * leg


def trunk_of(skeleton: Skeleton, knots: Float[np.ndarray, "n 8"], acting: str, hold: Float[np.ndarray, " n"]) -> Trunk:
    """The trunk that the unknowns describe; the head looks ahead."""
    zero = np.zeros(len(knots))
    hips = np.column_stack([knots[:, :2], standing_height(skeleton) - knots[:, _CROUCH]])
    forth = {side: hold if side == acting else zero for side in SIDES}
    return Trunk(hips, knots[:, _YAW], knots[:, _BEND], knots[:, _LEAN], knots[:, _TWIST], zero, zero, forth)


@dataclass(frozen=True, eq=False)
class _Problem:
    skeleton: Skeleton
    part: _Part
    space: Space
    wishes: Wishes
    acting: str

    def residuals(self, v: Float[np.ndarray, "n 8"]) -> Float[np.ndarray, "n r"]:
        """All but smoothness, each divided by what is usual."""
        w, s = self.wishes, self.skeleton
        trunk = trunk_of(s, v, self.acting, w.hold)
        R, p = self.part.pose(s, trunk)
        chest = R[:, self.part.index("spine01")]
        shoulder = p[:, self.part.index("upperarm01", self.acting)]
        arm = solve_arm(s, self.acting, chest, shoulder, w.T_world_hand, v[:, _SWIVEL])
        hand = w.T_world_hand[:, :3, 3]
        wrist = hand - apply(arm.hand, _wrist_to_palm(s, self.acting))
        length = s.length("upperarm01", "lowerarm01", self.acting) + s.length("lowerarm01", "wrist", self.acting)
        share = np.linalg.norm(wrist - shoulder, axis=1) / length
        posture = (v - w.posture)[:, _BEND:] / np.array([0.28, 0.12, 0.30, 0.035, 0.5])
        turned = (v[:, _YAW] - w.yaw) / 0.4
        held = np.stack(
            [
                _over(share, 0.975) / 0.004,
                _over(share, 0.86) / 0.08,
                _over(0.50 - share, 0) / 0.06,
                _over(arm.bend, WRIST_LIMIT) / 0.06,
                _over(arm.bend, 0.5) / 0.5,
                _over(np.abs(arm.pronation), _PRONATION) / 0.3,
                _over(arm.elbow[:, 2] - shoulder[:, 2], -0.02) / 0.08,
            ],
            1,
        )
        place = np.column_stack([(v[:, :2] - w.xy) / 0.12, turned])
        clear = self._clearance(v, p, arm.elbow, wrist)
        return np.concatenate([place, posture, held * w.hold[:, None], clear], 1)

    def _clearance(
        self,
        v: Float[np.ndarray, "n 8"],
        p: Float[np.ndarray, "n b 3"],
        elbow: Float[np.ndarray, "n 3"],
        wrist: Float[np.ndarray, "n 3"],
    ) -> Float[np.ndarray, "n r"]:
        """How deep parts of the body are in the furniture's margin."""
        hips = np.column_stack([v[:, :2], standing_height(self.skeleton) - v[:, _CROUCH]])
        left = about(Z, v[:, _YAW])[:, :, 1]
        spots = [(hips, 0.20), (p[:, self.part.index("spine02")], 0.19), (p[:, self.part.index("spine01")], 0.19)]
        spots += [(p[:, self.part.index("upperarm01", side)], 0.11) for side in SIDES]
        spots += [(p[:, self.part.index("head")] + [0, 0, 0.06], 0.16)]
        for out in (-0.11, 0.11):
            spots += [(hips + out * left - [0, 0, down], 0.15) for down in (0.3, 0.6, 0.78)]
        free = 0.29 if self.acting == "right" else -0.29
        spots += [(hips + free * left - [0, 0, 0.05], 0.10), (hips + 0.9 * free * left + [0, 0, 0.22], 0.08)]
        arm = [(elbow, 0.07), (0.5 * (elbow + wrist), 0.06)]
        points = np.stack([spot for spot, _ in spots + arm], 1)
        radius = np.array([r for _, r in spots + arm])
        gap = self.space.distance(points, self.wishes.q)
        weight = np.ones((len(v), len(radius)))
        weight[:, len(spots) :] = self.wishes.hold[:, None]
        return np.asarray(_over(radius - gap, 0) / 0.015 * weight)


@dataclass(frozen=True, eq=False)
class _Part:
    """The bones between pelvis, head and shoulders."""

    labels: tuple[str, ...]
    parents: tuple[int, ...]
    heads: Float[np.ndarray, "b 3"]
    bones: tuple[int, ...]
    lookup: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, skeleton: Skeleton) -> _Part:
        """Chosen from a whole skeleton; the neck's upper bones are skipped."""
        keep = [i for i, label in enumerate(skeleton.labels) if label.split(".")[0] in ("root", *_CHAIN)]
        parents = []
        for i in keep:
            up = skeleton.parents[i]
            while up >= 0 and up not in keep:
                up = skeleton.parents[up]
            parents.append(keep.index(up) if up >= 0 else -1)
        labels = tuple(skeleton.labels[i] for i in keep)
        return cls(labels, tuple(parents), skeleton.heads[keep], tuple(keep), {k: i for i, k in enumerate(labels)})

    def index(self, name: str, side: str = "") -> int:
        """Row of a bone."""
        return self.lookup[f"{name}.{side[0].upper()}" if side else name]

    def pose(self, skeleton: Skeleton, trunk: Trunk) -> tuple[Float[np.ndarray, "t b 3 3"], Float[np.ndarray, "t b 3"]]:
        """World rotations and places of these bones."""
        R = trunk_rotations(skeleton, trunk)
        own = {k: R[bone] for k, bone in enumerate(self.bones) if bone in R}
        return forward(self.parents, self.heads, own, root_of(skeleton, trunk, R[self.bones[0]]))


def fit(skeleton: Skeleton, space: Space, wishes: Wishes, acting: str) -> tuple[Float[np.ndarray, "n 8"], float]:
    """The unknowns at all knots, and what remains of the cost per knot: a measure of comfort."""
    problem = _Problem(skeleton, _Part.of(skeleton), space, wishes, acting)
    n = len(wishes.q)
    v = np.tile(wishes.posture, (n, 1))
    v[:, :2], v[:, _YAW] = wishes.xy, wishes.yaw
    smooth = _smoothness(n)
    damping = 1e-2
    r = problem.residuals(v)
    cost = _cost(r, v, smooth)
    for _ in range(_ROUNDS):
        J = np.empty((*r.shape, len(VARIABLES)))
        for i in range(len(VARIABLES)):
            moved = v.copy()
            moved[:, i] += _DELTA
            J[..., i] = (problem.residuals(moved) - r) / _DELTA
        H = _block_diagonal(np.einsum("nri,nrj->nij", J, J)) + smooth
        g = np.einsum("nri,nr->ni", J, r).ravel() + smooth @ v.ravel()
        before = cost
        for _ in range(6):
            step = spsolve((H + damping * sparse.diags(H.diagonal())).tocsc(), -g).reshape(n, -1)
            trial = v + np.clip(step, -0.3, 0.3)
            rest = problem.residuals(trial)
            if (value := _cost(rest, trial, smooth)) < cost:
                v, r, cost, damping = trial, rest, value, max(damping / 4, 1e-6)
                break
            damping *= 5
        if before - cost < 1e-3 * before:
            break
    return v, cost / n


def _over(x: Float[np.ndarray, "*n"], limit: float) -> Float[np.ndarray, "*n"]:
    return np.maximum(x - limit, 0.0)


def _wrist_to_palm(skeleton: Skeleton, side: str) -> Float[np.ndarray, "3"]:
    return np.asarray(skeleton.T_body_hand[side][:3, 3] - skeleton.head("wrist", side))


def _cost(r: Float[np.ndarray, "n r"], v: Float[np.ndarray, "n 8"], smooth: sparse.csr_matrix) -> float:
    flat = v.ravel()
    return float(np.sum(r * r) + flat @ (smooth @ flat))


def _smoothness(n: int) -> sparse.csr_matrix:
    """The quadratic form of accelerations; at both ends also of speeds, as the body stands there."""
    second = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n)) / KNOT_S**2
    speed = 3.0 / KNOT_S * np.array([-1.0, 1.0, -1.0, 1.0])
    ends = sparse.csr_matrix((speed, ([0, 0, 1, 1], [0, 1, n - 2, n - 1])), shape=(2, n))
    rows = sparse.csr_matrix(sparse.vstack([second, ends]))
    return sparse.csr_matrix(sparse.kron(sparse.csr_matrix(rows.T @ rows), sparse.diags(1 / _ACCELERATION**2)))


def _block_diagonal(blocks: Float[np.ndarray, "n k k"]) -> sparse.csr_matrix:
    n, k, _ = blocks.shape
    return sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(n * k, n * k)).tocsr()
