"""Edges of the adaptation graph: pure functions of stacks of unknowns, with residuals and analytic Jacobians.

Unknowns: gripper poses T (n, 4, 4) and base poses (n, 3: x, y, yaw), both perturbed on the right (understudy.lie), and
torso heights (n,). Residuals are in metres, radians and seconds; weights come later (`graph.py`). Hinges are 0 where
the constraint holds; those of distances set in softly, `SOFT_M` early.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.adaptation.fields import DistanceField, cells_near, half_planes, polygon_distance
from understudy.adaptation.platform import Reachability
from understudy.demonstration.demonstration import OccupancyMap

SOFT_M: Final = 0.01
"""half width of the parabola that rounds off the hinges of distances"""


def follow_pose(
    target: Float[np.ndarray, "n 4 4"], T: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 6"]]:
    """Log(target^-1 T): follow the hand (target = H X), or take hold (target = O g). Jacobian over T."""
    e = lie.se3_log(lie.se3_inverse(target) @ T)
    return e, lie.se3_left_jacobian_inverse(-e)


def follow_planar(
    target: Float[np.ndarray, "n 3"], base: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Log of target^-1 base in SE(2): follow the torso (target = P Y). Jacobian over the base."""
    e = lie.se2_log(lie.se2_compose(lie.se2_inverse(target), base))
    return e, lie.se2_left_jacobian_inverse(-e)


def between_poses(
    a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 6"]]:
    """Log(a^-1 b), and Jacobians over a and b."""
    e = lie.se3_log(lie.se3_inverse(a) @ b)
    return e, -lie.se3_left_jacobian_inverse(e), lie.se3_left_jacobian_inverse(-e)


def between_postures(
    a: Float[np.ndarray, "n 4 4"],
    base_a: Float[np.ndarray, "n 3"],
    b: Float[np.ndarray, "n 4 4"],
    base_b: Float[np.ndarray, "n 3"],
) -> tuple[
    Float[np.ndarray, "n 6"],
    tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 3"]],
    tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 3"]],
]:
    """How the gripper moves as seen from the base: between_poses of B^-1 T, and Jacobians over (T, base) of a and b."""
    seen = [lie.se3_inverse(lie.se2_to_se3(base)) @ T for T, base in ((a, base_a), (b, base_b))]
    e, J_a, J_b = between_poses(*seen)
    # moving the base by Exp(d) moves the tool, seen from the base, by Exp(-d) on the left
    turned = [lie.se3_adjoint(lie.se3_inverse(T))[..., [0, 1, 5]] for T in seen]
    K_a, K_b = -(J_a @ turned[0]), -(J_b @ turned[1])
    return e, (J_a, K_a), (J_b, K_b)


def between_planar(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3 3"]]:
    """Log(a^-1 b) in SE(2), and Jacobians over a and b."""
    e = lie.se2_log(lie.se2_compose(lie.se2_inverse(a), b))
    return e, -lie.se2_left_jacobian_inverse(e), lie.se2_left_jacobian_inverse(-e)


def rigid_grasp(
    grasp: Float[np.ndarray, "*n 4 4"], object: Float[np.ndarray, "n 4 4"], T: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 6"], Float[np.ndarray, "n 6 6"]]:
    """Log(g^-1 O^-1 T): the gripper stays where it took hold. Jacobians over T and over g, which all share."""
    e = lie.se3_log(lie.se3_inverse(object @ grasp) @ T)
    return e, lie.se3_left_jacobian_inverse(-e), -lie.se3_left_jacobian_inverse(e)


def reach(
    field: Reachability,
    T: Float[np.ndarray, "n 4 4"],
    base: Float[np.ndarray, "n 3"],
    torso: Float[np.ndarray, " n"],
    margin: float | Float[np.ndarray, " n"],
) -> tuple[
    Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 6"], Float[np.ndarray, "n 1 3"], Float[np.ndarray, "n 1 1"]
]:
    """max(0, distance of B^-1 T to the reachable set + margin), and Jacobians over T, base and torso."""
    T_base_tool = lie.se3_inverse(lie.se2_to_se3(base)) @ T
    value, d_pose, d_torso = field.distance(T_base_tool, torso)
    # moving the base by Exp(d) moves the tool, seen from the base, by Exp(-d) on the left
    seen = -(d_pose[:, None] @ lie.se3_adjoint(lie.se3_inverse(T_base_tool)))[:, 0, [0, 1, 5]]
    e, on = hinge(value + margin, SOFT_M)
    return e[:, None], (on[:, None] * d_pose)[:, None], (on[:, None] * seen)[:, None], (on * d_torso)[:, None, None]


def base_clearance(
    field: DistanceField,
    points: Float[np.ndarray, "k 2"],
    radii: Float[np.ndarray, " k"],
    base: Float[np.ndarray, "n 3"],
    margin: float,
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k 3"]]:
    """max(0, radius + margin - distance) at k points of the footprint (base frame). Jacobian over the base."""
    n, k = len(base), len(points)
    e, J = np.zeros((n, k)), np.zeros((n, k, 3))
    # distances change by at most the way gone: poses whose middle is far from everything need no closer look
    far = float((np.linalg.norm(points, axis=1) + radii).max()) + margin + SOFT_M + 2 * field.cell_m
    near = np.flatnonzero(field.at(base[:, :2])[0] < far)
    base, turn = base[near], _turns(base[near])
    world = base[:, None, :2] + points @ np.swapaxes(turn, 1, 2)
    d, gradient = field.at(world.reshape(-1, 2))
    e[near], on = hinge(radii + margin - d.reshape(-1, k), SOFT_M)
    local = gradient.reshape(-1, k, 2) @ turn
    yaw = points[:, 0] * local[..., 1] - points[:, 1] * local[..., 0]
    J[near] = -on[..., None] * np.concatenate([local, yaw[..., None]], axis=2)
    return e, J


def map_clearance(
    map: OccupancyMap,
    field: DistanceField,
    polygon: Float[np.ndarray, "k 2"],
    base: Float[np.ndarray, "n 3"],
    margin: float,
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k 3"]]:
    """max(0, half a cell + margin - distance to the footprint) of the deepest occupied cell at each side of it.

    Of cells, not of points of the footprint: a thin wall or a single cell under the footprint is pushed out to the
    nearest side, whereas points to both sides of it would pull in opposite directions. field: the map's, tells where
    no closer look is needed. Jacobian over the base.
    """
    n, k = len(base), len(polygon)
    e, J = np.zeros((n, k)), np.zeros((n, k, 3))
    room = margin + SOFT_M + 0.5 * map.resolution_m
    far = float(np.linalg.norm(polygon, axis=1).max()) + room
    near = np.flatnonzero(field.at(base[:, :2])[0] < far + field.cell_m)
    pose, row, column = cells_near(map, base[near], far)
    turn = _turns(base[near])
    away = map.origin_xy + map.resolution_m * np.column_stack([column, row]) - base[near][pose, :2]
    local = np.einsum("mi,mij->mj", away, turn[pose])
    normals, offsets = half_planes(polygon)
    heights = local @ normals.T - offsets
    close = np.flatnonzero(heights.max(axis=1) < room)
    side = np.argmax(heights[close], axis=1)
    d, gradient = polygon_distance(polygon, local[close])
    keys = k * pose[close] + side
    order = np.lexsort((-d, keys))
    last = order[np.append(keys[order][1:] != keys[order][:-1], True)] if len(order) else order
    rows, sides = near[pose[close[last]]], side[last]
    e[rows, sides], on = hinge(0.5 * map.resolution_m + margin - d[last], SOFT_M)
    g, p = gradient[last], local[close[last]]
    # moving the base by d moves the cell, seen from the base, by -d
    yaw = g[:, 1] * p[:, 0] - g[:, 0] * p[:, 1]
    J[rows, sides] = on[:, None] * np.column_stack([g, yaw])
    return e, J


def panel_clearance(
    polygon: Float[np.ndarray, "k 2"],
    panel: Float[np.ndarray, "n m 2"],
    base: Float[np.ndarray, "n 3"],
    margin: float,
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m 3"]]:
    """max(0, margin - distance to the footprint) of m points of the moving part (world, from above; NaN: none).

    Jacobian over the base.
    """
    n, m = panel.shape[:2]
    e, J = np.zeros((n, m)), np.zeros((n, m, 3))
    far = float(np.linalg.norm(polygon, axis=1).max()) + margin + SOFT_M
    away = panel - base[:, None, :2]
    with np.errstate(invalid="ignore"):  # NaN: no point
        pose, point = np.nonzero(np.sum(away**2, axis=2) < far**2)
    local = np.einsum("mi,mij->mj", away[pose, point], _turns(base)[pose])
    d, gradient = polygon_distance(polygon, local)
    e[pose, point], on = hinge(margin - d, SOFT_M)
    # moving the base by d moves the point, seen from the base, by -d
    yaw = gradient[:, 1] * local[:, 0] - gradient[:, 0] * local[:, 1]
    J[pose, point] = on[:, None] * np.column_stack([gradient, yaw])
    return e, J


def gripper_clearance(
    field: DistanceField,
    points: Float[np.ndarray, "k 3"],
    radius: float,
    T: Float[np.ndarray, "n 4 4"],
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k 6"]]:
    """max(0, radius - distance to the scene) at k points of the gripper and forearm (tool frame). Jacobian over T."""
    n, k = len(T), len(points)
    R = T[:, :3, :3]
    world = T[:, None, :3, 3] + points @ np.swapaxes(R, 1, 2)
    d, gradient = field.at(world.reshape(-1, 3))
    e, on = hinge(radius - d.reshape(n, k), SOFT_M)
    local = gradient.reshape(n, k, 3) @ R
    turning = np.cross(np.broadcast_to(points, local.shape), local)
    return e, -on[..., None] * np.concatenate([local, turning], axis=2)


def beyond(
    x: Float[np.ndarray, "n k"], least: Float[np.ndarray, " k"], greatest: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """How far each number is out of its range, and the derivative over that number."""
    above, below = np.maximum(x - greatest, 0.0), np.maximum(least - x, 0.0)
    return above + below, (above > 0).astype(np.float64) - (below > 0)


def longer(x: Float[np.ndarray, "n k"], limit: float) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 k"]]:
    """How much longer than the limit each vector is, and the Jacobian over the vector."""
    length = np.linalg.norm(x, axis=1)
    e, on = hinge(length - limit)
    return e[:, None], (on[:, None] * x / np.maximum(length, 1e-12)[:, None])[:, None]


def _turns(base: np.ndarray) -> Float[np.ndarray, "n 2 2"]:
    """Rotation matrices, base to world."""
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)


def hinge(x: np.ndarray, soft: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """max(0, x) and its derivative; within +-soft a parabola, so that the solver feels a limit before it is there."""
    if not soft:
        return np.maximum(x, 0.0), (x > 0).astype(np.float64)
    near = np.clip(x + soft, 0, 2 * soft)
    return near**2 / (4 * soft) + np.maximum(x - soft, 0), near / (2 * soft)


def robust(
    squared: Float[np.ndarray, " n"], kernel: str, width: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Cost and weight of edges from their squared, whitened lengths (iteratively reweighted least squares).

    kernel: 'none', 'huber' (linear beyond `width` standard deviations) or 'cauchy' (logarithmic).
    """
    if kernel == "none":
        return squared, np.ones_like(squared)
    if kernel == "huber":
        length = np.sqrt(squared)
        weight = width / np.maximum(length, width)
        return np.where(length <= width, squared, width * (2 * length - width)), weight
    return width**2 * np.log1p(squared / width**2), 1 / (1 + squared / width**2)
