"""The adaptation graph: derivatives, distances, the solver, and gtsam as the oracle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import adaptation_scenes as scenes
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy import lie
from understudy.adaptation import edges, fields, prepare
from understudy.adaptation import problem as problems
from understudy.adaptation.calibration import DEFAULT_HAND_TOOL, DEFAULT_TORSO_BASE, Calibration
from understudy.adaptation.graph import BASE, GRIPPER, TORSO, Graph, State
from understudy.adaptation.solver import WIDTH, Chain, Linear, Stop, _Normal, costs_by_kind, minimise
from understudy.adaptation.weights import Stage, Weights
from understudy.demonstration.demonstration import FREE, OCCUPIED, OccupancyMap

N = 40
STEP = 1e-6


def _poses(seed: int, spread: float = 0.4) -> np.ndarray:
    return lie.se3_exp(spread * np.random.default_rng(seed).normal(size=(N, 6)))


def _planar(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(N, 3)) * [0.5, 0.5, 1.0]


def _check(residual: Callable[[np.ndarray], np.ndarray], J: np.ndarray, size: int) -> None:
    """J (n, k, size) is the derivative of residual(d (n, size)) at 0."""
    for column, unit in enumerate(np.eye(size)):
        d = np.tile(STEP * unit, (N, 1))
        numeric = (residual(d) - residual(-d)) / (2 * STEP)
        np.testing.assert_allclose(J[..., column], numeric, atol=1e-6)
    assert np.abs(J).max() > 0.1


def test_follow_edges() -> None:
    A, T = _poses(0), _poses(1)
    e, J = edges.follow_pose(A, T)
    _check(lambda d: edges.follow_pose(A, T @ lie.se3_exp(d))[0], J, 6)
    np.testing.assert_allclose(A @ lie.se3_exp(e), T, atol=1e-12)
    P, B = _planar(2), _planar(3)
    e, J = edges.follow_planar(P, B)
    _check(lambda d: edges.follow_planar(P, lie.se2_compose(B, lie.se2_exp(d)))[0], J, 3)


def test_smoothness_edges() -> None:
    a, b = _poses(0), _poses(1)
    _, Ja, Jb = edges.between_poses(a, b)
    _check(lambda d: edges.between_poses(a @ lie.se3_exp(d), b)[0], Ja, 6)
    _check(lambda d: edges.between_poses(a, b @ lie.se3_exp(d))[0], Jb, 6)
    p, q = _planar(2), _planar(3)
    _, Ja, Jb = edges.between_planar(p, q)
    _check(lambda d: edges.between_planar(lie.se2_compose(p, lie.se2_exp(d)), q)[0], Ja, 3)
    _check(lambda d: edges.between_planar(p, lie.se2_compose(q, lie.se2_exp(d)))[0], Jb, 3)
    _, (Ja, Ka), (Jb, Kb) = edges.between_postures(a, p, b, q)
    _check(lambda d: edges.between_postures(a @ lie.se3_exp(d), p, b, q)[0], Ja, 6)
    _check(lambda d: edges.between_postures(a, p, b @ lie.se3_exp(d), q)[0], Jb, 6)
    _check(lambda d: edges.between_postures(a, lie.se2_compose(p, lie.se2_exp(d)), b, q)[0], Ka, 3)
    _check(lambda d: edges.between_postures(a, p, b, lie.se2_compose(q, lie.se2_exp(d)))[0], Kb, 3)


def test_rigid_grasp_edge() -> None:
    g, obj, T = _poses(0)[0], _poses(1), _poses(2)
    e, J, Jg = edges.rigid_grasp(g, obj, T)
    _check(lambda d: edges.rigid_grasp(g, obj, T @ lie.se3_exp(d))[0], J, 6)
    _check(lambda d: edges.rigid_grasp(g @ lie.se3_exp(d[0]), obj, T)[0], Jg, 6)
    np.testing.assert_allclose(edges.rigid_grasp(g, obj, obj @ g)[0], 0, atol=1e-12)
    assert np.abs(e).max() > 0.1


def test_a_mirrored_grasp_is_linearised_right() -> None:
    """Of demonstrations of doors hung on either side: residuals of holding and of coming straight, over the grasp that
    both share, against finite differences.
    """
    problem, state = _problem("room_door")
    problem = replace(problem, mirrored=np.arange(len(problem.dt)) >= len(problem.dt) // 2)
    state = state.retract(np.zeros((len(state.torso), WIDTH)), 0.2 * np.random.default_rng(0).normal(size=6))
    graph = Graph(problem, scenes.platform())
    for kind in ("rigid", "approach"):

        def residual(shared: np.ndarray, kind: str = kind) -> np.ndarray:
            moved = state.retract(np.zeros((len(state.torso), WIDTH)), shared)
            return next(e.residual for e in graph.grasping(moved, FULL) if e.kind == kind)

        border = next(e.border for e in graph.grasping(state, FULL) if e.kind == kind)
        for column, unit in enumerate(STEP * np.eye(6)):
            numeric = (residual(unit) - residual(-unit)) / (2 * STEP)
            np.testing.assert_allclose(border[..., column], numeric, rtol=1e-5, atol=1e-3)  # whitened: thousands
        steps = next(e.steps for e in graph.grasping(state, FULL) if e.kind == kind)
        assert problem.mirrored[steps].any() and not problem.mirrored[steps].all()
        assert np.abs(border[problem.mirrored[steps]]).max() > 10
    # and the mirror image is one: reflected twice it is the grasp, and it is still a rotation
    twice = problems.mirror(problems.mirror(state.grasp))
    np.testing.assert_allclose(twice, state.grasp, atol=1e-15)
    assert np.linalg.det(problems.mirror(state.grasp)[:3, :3]) == pytest.approx(1)


def test_reach_edge() -> None:
    field, rng = scenes.Shell(), np.random.default_rng(0)
    base = _planar(3)
    T = lie.se2_to_se3(base) @ _poses(1, 0.9)
    T[:, 2, 3] += 0.8
    torso = rng.uniform(0, 0.3, N)
    args = (T, base, torso)
    e, J, J_base, J_torso = edges.reach(field, *args, 0.02)
    assert (e > 0).any() and (e == 0).any()
    _check(lambda d: edges.reach(field, T @ lie.se3_exp(d), base, torso, 0.02)[0], J, 6)
    _check(lambda d: edges.reach(field, T, lie.se2_compose(base, lie.se2_exp(d)), torso, 0.02)[0], J_base, 3)
    _check(lambda d: edges.reach(field, T, base, torso + d[:, 0], 0.02)[0], J_torso, 1)


def _wavy(k: int) -> fields.DistanceField:
    """A field that is linear within each cell, with gradients that differ."""
    values = np.random.default_rng(5).normal(0.1, 0.1, size=(60,) * k)
    return fields.DistanceField(values, np.full(k, -3.0), 0.1)


def test_base_clearance_edge() -> None:
    field, base = _wavy(2), 0.5 * _planar(0)
    points, radii = np.array([[0.3, 0.3], [-0.3, 0.1], [0.0, 0.0]]), np.array([0.0, 0.0, 0.3])
    e, J = edges.base_clearance(field, points, radii, base, 0.05)
    assert (e > 0).any() and (e == 0).any()
    _check(lambda d: edges.base_clearance(field, points, radii, lie.se2_compose(base, lie.se2_exp(d)), 0.05)[0], J, 3)


def test_far_from_everything_is_free() -> None:
    """The shortcut in `base_clearance` leaves nothing out."""
    map, _ = scenes.room("drawer")
    field, base = fields.obstacle_field(map), np.random.default_rng(1).uniform([-1, -2.5, -3], [3.5, 2.5, 3], (3000, 3))
    points = fields.outline(scenes.platform().footprint, 0.08)
    e, _ = edges.base_clearance(field, points, np.zeros(len(points)), base, 0.03)
    turned = lie.se2_to_se3(base)[:, :2, :2] @ points.T
    d = field.at((base[:, :2, None] + turned).transpose(0, 2, 1).reshape(-1, 2))[0].reshape(len(base), -1)
    assert ((e > 0) == (0.03 + edges.SOFT_M - d > 0)).all()
    assert (e > 0).any()


def test_panel_edge() -> None:
    polygon, base = scenes.platform().footprint, 0.6 * _planar(0)
    panel = np.random.default_rng(1).uniform(-0.7, 0.7, (N, 6, 2))
    panel[:5, 3:] = np.nan
    e, J = edges.panel_clearance(polygon, panel, base, 0.1)
    assert (e > 0).any() and (e == 0).any() and (e[:5, 3:] == 0).all()
    _check(lambda d: edges.panel_clearance(polygon, panel, lie.se2_compose(base, lie.se2_exp(d)), 0.1)[0], J, 3)


def test_gripper_clearance_edge() -> None:
    field, T, points = _wavy(3), _poses(3), np.array([[-0.1, 0, 0], [-0.3, 0, 0.02]])
    e, J = edges.gripper_clearance(field, points, 0.1, T)
    assert (e > 0).any() and (e == 0).any()
    _check(lambda d: edges.gripper_clearance(field, points, 0.1, T @ lie.se3_exp(d))[0], J, 6)


def test_limits() -> None:
    x = np.random.default_rng(0).normal(size=(N, 3))
    e, J = edges.longer(x, 1.5)
    _check(lambda d: edges.longer(x + d, 1.5)[0], J, 3)
    least, greatest = np.full(3, -0.5), np.full(3, 1.0)
    e, slope = edges.beyond(x, least, greatest)
    np.testing.assert_allclose(np.clip(x, least, greatest) + slope * e, x)


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy"])
def test_robust_kernels(kernel: str) -> None:
    """The weight is the cost's derivative over the squared length, and small residuals are left alone."""
    s = np.linspace(0.01, 60, 200)
    cost, weight = edges.robust(s, kernel, 3.0)
    h = 1e-5
    numeric = (edges.robust(s + h, kernel, 3.0)[0] - edges.robust(s - h, kernel, 3.0)[0]) / (2 * h)
    np.testing.assert_allclose(weight, numeric, atol=1e-6)
    assert cost[0] == pytest.approx(s[0], rel=1e-2)


def test_distance_field_is_the_distance() -> None:
    blocked = np.zeros((50, 40), bool)
    blocked[20:24, 10:13] = True
    field = fields.signed_distance(blocked, np.array([1.0, 2.0]), 0.05)
    points = np.random.default_rng(0).uniform([1, 2], [3.4, 3.9], (500, 2))
    low, high = np.array([1 + 19.5 * 0.05, 2 + 9.5 * 0.05]), np.array([1 + 23.5 * 0.05, 2 + 12.5 * 0.05])
    truth = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)
    d, gradient = field.at(points)
    outside = truth > 0.05
    assert np.abs(d - truth)[outside].max() < 0.03  # corners of cells
    h = 1e-7
    for axis in range(2):
        shift = h * np.eye(2)[axis]
        numeric = (field.at(points + shift)[0] - field.at(points - shift)[0]) / (2 * h)
        np.testing.assert_allclose(gradient[:, axis], numeric, atol=1e-5)
    assert field.at(np.array([[2.05, 2.55]]))[0][0] < 0


def test_values_alone_are_the_values() -> None:
    """What the searches look up without gradients."""
    rng = np.random.default_rng(2)
    for k in (2, 3):
        field, points = _wavy(k), rng.uniform(-4, 4, (500, k))
        np.testing.assert_array_equal(field.values_at(points), field.at(points)[0])
    polygon = np.array([[0.4, -0.2], [0.3, 0.25], [-0.3, 0.2], [-0.3, -0.2]])
    points = rng.uniform(-0.6, 0.6, (2000, 2))
    value, gradient = fields.polygon_distance(polygon, points)
    np.testing.assert_allclose(fields.polygon_values(polygon, *points.T), value, atol=1e-15)
    smooth = np.abs(value) > 0.02  # the gradient jumps on the outline
    h = 1e-6
    for axis in range(2):
        shift = h * np.eye(2)[axis]
        numeric = (
            fields.polygon_distance(polygon, points + shift)[0] - fields.polygon_distance(polygon, points - shift)[0]
        )
        close = np.abs(numeric / (2 * h) - gradient[:, axis]) < 1e-5
        assert close[smooth].mean() > 0.995  # but at equal distances from two sides


def test_no_obstacles_at_all() -> None:
    field = fields.signed_distance(np.zeros((5, 5), bool), np.zeros(2), 0.05)
    assert (field.at(np.random.default_rng(0).normal(size=(20, 2)))[0] > 100).all()


def test_exact_collision_against_sampling() -> None:
    rng = np.random.default_rng(3)
    state = np.where(rng.random((40, 50)) < 0.01, OCCUPIED, FREE).astype(np.uint8)
    map = OccupancyMap(state, np.array([-1.0, -0.5]), 0.05)
    polygon = np.array([[0.4, -0.2], [0.3, 0.25], [-0.3, 0.2], [-0.3, -0.2]])
    base = rng.uniform([-1.2, -0.7, -3], [1.6, 1.6, 3], (400, 3))
    normals, offsets = fields.half_planes(polygon)
    sub = (np.arange(9) - 4) / 8 * 0.05 * 0.999
    cells = np.argwhere(state == OCCUPIED)
    grid = np.stack(np.meshgrid(sub, sub), -1).reshape(-1, 2)
    points = (np.column_stack([cells[:, 1], cells[:, 0]]) * 0.05 + map.origin_xy)[:, None] + grid
    free = fields.collision_free(map, polygon, base)
    local = [(points.reshape(-1, 2) - b[:2]) @ _turn(b[2]) for b in base]
    sampled = np.array([not (p @ normals.T <= offsets).all(axis=1).any() for p in local])
    assert not (free & ~sampled).any()  # what touches is never called free
    assert (free != sampled).mean() < 0.02  # the samples miss corners that barely touch
    assert 0.1 < free.mean() < 0.9


def _turn(yaw: float) -> np.ndarray:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def test_polygon_distance() -> None:
    square = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1.0]])
    points = np.array([[2.0, 0], [2, 2], [0.5, 0], [0, -3]])
    d, gradient = fields.polygon_distance(square, points)
    np.testing.assert_allclose(d, [1, np.sqrt(2), -0.5, 2])
    np.testing.assert_allclose(gradient, [[1, 0], [np.sqrt(0.5)] * 2, [1, 0], [0, -1]], atol=1e-12)


# the solver


def _random_linear(rng: np.random.Generator, n: int) -> list[Linear]:
    out = []
    for span, k in ((1, 4), (2, 3), (3, 5)):
        steps = np.arange(n - span + 1)
        parts = [
            (s, c, rng.normal(size=(len(steps), k, c.stop - c.start)))
            for s in range(span)
            for c in (GRIPPER, BASE, TORSO)
        ]
        r = rng.normal(size=(len(steps), k))
        out.append(Linear(f"span {span}", np.sum(r**2, 1), steps, r, parts, rng.normal(size=(len(steps), k, 6))))
    return out


def test_band_and_border_equal_a_dense_solve() -> None:
    rng, n = np.random.default_rng(0), 12
    linear, normal = _random_linear(rng, n), _Normal(n)
    size = n * WIDTH + 6
    H, b = np.zeros((size, size)), np.zeros(size)
    for e in linear:
        normal.add(e)
        for i, first in enumerate(e.steps):
            J = np.zeros((e.residual.shape[1], size))
            for s, c, A in e.parts:
                at = (first + s) * WIDTH
                J[:, at + c.start : at + c.stop] = A[i]
            J[:, -6:] = e.border[i]
            H += J.T @ J
            b += J.T @ e.residual[i]
    damping = rng.uniform(0.5, 1, size)
    expected = np.linalg.solve(H + np.diag(damping), -b)
    chain, border = normal.solve(damping[:-6].reshape(n, WIDTH), damping[-6:], True)
    np.testing.assert_allclose(np.append(chain.ravel(), border), expected, rtol=1e-7, atol=1e-9)


def _problem(task: str = "drawer", n: int = 2, samples: int = 30, seed_noise: scenes.Noise | None = None):
    shown = scenes.demonstrations(task, n, seed_noise, samples)
    grasp = np.array(scenes.GraspFamily(0.0, 1.0, 0.1).members(np.array([0.2]), np.array([0.0]))[0])
    calibration = Calibration(DEFAULT_HAND_TOOL, DEFAULT_TORSO_BASE)
    problem = prepare.stacked(shown, calibration, grasp, prepare.Obstacles(shown))
    base = np.concatenate([prepare.first_base(d, DEFAULT_TORSO_BASE) for d in shown])
    state = State(prepare.first_gripper(problem, grasp), base, np.full(len(base), 0.15), grasp)
    return problem, state


FULL = Stage(1.0, 1.0, "none", 1e-10, 60)


def test_every_family_is_linearised_right() -> None:
    """The sum of all edges: gradient of the cost against finite differences of the cost along random directions."""
    problem, state = _problem("room_door", samples=60)
    rng = np.random.default_rng(0)
    n = len(state.torso)
    state = replace(state, base=state.base - [0.5, 0, 0])  # into the door, the wall and what lies behind
    state = state.retract(0.02 * rng.normal(size=(n, WIDTH)), 0.01 * rng.normal(size=6))
    graph = Graph(problem, scenes.platform())
    stage = replace(FULL, constraints=0.05, grasp=0.05)
    normal = _Normal(n)
    for e in graph.linearise(state, stage):
        normal.add(e)
    kinds = {k for k, c in costs_by_kind(graph.linearise(state, stage)).items() if c > 0}
    assert {"hand", "torso", "grasp", "rigid", "limits", "reach", "moving part", "unknown"} <= kinds
    for _ in range(5):
        d, g = rng.normal(size=(n, WIDTH)), rng.normal(size=6)
        h = 1e-6
        costs = [
            sum(e.cost.sum() for e in graph.linearise(state.retract(s * h * d, s * h * g), stage)) for s in (1, -1)
        ]
        slope = 2 * (np.sum(normal.gradient * d) + normal.border_gradient @ g)
        assert (costs[0] - costs[1]) / (2 * h) == pytest.approx(slope, rel=2e-4)


def test_agrees_with_gtsam() -> None:
    """The pose-only graph: following, smoothness, taking hold, holding with a shared grasp."""
    gtsam = pytest.importorskip("gtsam")
    problem, state = _problem(samples=24)
    weights = replace(Weights(), gripper_acceleration=None, base_acceleration=None, torso_rest=1e3, grasp=(0.005, 0.02))
    graph = Graph(problem, scenes.platform(), weights)

    def poses_only(s: State) -> list[Linear]:
        kinds = ("hand", "torso", "torso lift", "grasp", "rigid", "gripper speed", "base speed", "torso speed")
        return [e for e in graph.linearise(s, FULL) if e.kind in kinds]

    n = len(state.torso)
    rng = np.random.default_rng(0)
    start = state.retract(0.05 * rng.normal(size=(n, WIDTH)), 0.05 * rng.normal(size=6))
    chain = Chain(n, poses_only, lambda s, d, g: s.retract(d, g))
    ours, course, converged = minimise(chain, start, Stop(1e-12, 100))
    assert converged
    theirs, cost = _gtsam_solution(gtsam, problem, weights, start)
    assert 2 * cost + costs_by_kind(poses_only(ours))["torso lift"] == pytest.approx(course[-1].cost, rel=1e-6)
    for mine, other in ((ours.gripper, theirs[0]), (ours.grasp[None], theirs[2])):
        apart = lie.se3_log(lie.se3_inverse(mine) @ other)
        assert np.abs(apart).max() < 1e-4
    assert np.abs(ours.base - theirs[1])[:, :2].max() < 1e-4
    assert np.abs(lie.wrapped(ours.base[:, 2] - theirs[1][:, 2])).max() < 1e-4


def _gtsam_solution(gtsam, problem, w: Weights, start: State):
    """gtsam orders tangents (rotation, translation), and its Pose2 has no logarithm in its factors: custom ones."""
    swap = np.r_[3:6, 0:3]
    graph, values, n = gtsam.NonlinearFactorGraph(), gtsam.Values(), len(start.torso)
    G, B = (lambda i: gtsam.symbol("g", int(i))), (lambda i: gtsam.symbol("b", int(i)))
    X = gtsam.symbol("x", 0)
    sigma = np.array([w.grasp[0]] * 3 + [w.grasp[1]] * 3)

    def noise(s: np.ndarray):
        return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(s, float))

    def full(c: np.ndarray, spread: np.ndarray):
        return gtsam.noiseModel.Gaussian.Covariance((c + np.diag(spread))[np.ix_(swap, swap)])

    def planar(target: np.ndarray | None, keys: list, model):
        def error(this, v, H):
            b = np.array([_row(v.atPose2(k)) for k in list(this.keys())])
            if target is not None:
                e, J = edges.follow_planar(target[None], b)
                Js = [J]
            else:
                e, Ja, Jb = edges.between_planar(b[:1], b[1:])
                Js = [Ja, Jb]
            if H is not None:
                for i, J in enumerate(Js):
                    H[i] = np.asfortranarray(J[0])
            return e[0]

        return gtsam.CustomFactor(model, keys, error)

    def rigid(obj: np.ndarray, key: int):
        def error(this, v, H):
            g, T = (v.atPose3(k).matrix() for k in list(this.keys()))
            e, J, Jg = edges.rigid_grasp(g, obj[None], T[None])
            if H is not None:
                H[0] = np.asfortranarray(Jg[0][np.ix_(swap, swap)])
                H[1] = np.asfortranarray(J[0][np.ix_(swap, swap)])
            return e[0][swap]

        return gtsam.CustomFactor(noise(sigma[swap]), [X, key], error)

    for i in range(n):
        values.insert(G(i), gtsam.Pose3(start.gripper[i]))
        values.insert(B(i), gtsam.Pose2(*start.base[i]))
        hand = np.repeat(w.hand_holding if problem.holding[i] else w.hand, 3) ** 2
        graph.add(gtsam.PriorFactorPose3(G(i), gtsam.Pose3(problem.hand[i]), full(problem.hand_covariance[i], hand)))
        torso = problem.torso_covariance[i] + np.diag([w.torso[0]] * 2 + [w.torso[1]]) ** 2
        graph.add(planar(problem.torso[i], [B(i)], gtsam.noiseModel.Gaussian.Covariance(torso)))
        if problem.holding[i]:
            graph.add(rigid(problem.object[i], G(i)))
        if np.isfinite(problem.dt[i]):
            dt = problem.dt[i]
            speed = dt * np.repeat(w.gripper_speed, 3)[swap]
            graph.add(gtsam.BetweenFactorPose3(G(i), G(i + 1), gtsam.Pose3(), noise(speed)))
            graph.add(planar(None, [B(i), B(i + 1)], noise(dt * np.array([w.base_speed[0]] * 2 + [w.base_speed[1]]))))
    for i in problem.grasp_steps:
        graph.add(gtsam.PriorFactorPose3(G(i), gtsam.Pose3(problem.object[i] @ problem.grasp), noise(sigma[swap])))
    values.insert(X, gtsam.Pose3(start.grasp))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    parameters.setMaxIterations(100)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    found = optimiser.optimize()
    gripper = np.array([found.atPose3(G(i)).matrix() for i in range(n)])
    base = np.array([_row(found.atPose2(B(i))) for i in range(n)])
    return (gripper, base, found.atPose3(X).matrix()[None]), optimiser.error()


def _row(pose) -> np.ndarray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def test_covariances_are_rotated_into_the_tangent_space() -> None:
    """Samples of the track's error model (world axes), seen in the tangent space of H X."""
    d = scenes.demonstration("drawer")
    rng = np.random.default_rng(0)
    A = 0.02 * rng.normal(size=(6, 6))
    cov = A @ A.T
    H = d.hand.T_world_x[:1]
    track = replace(d.hand, covariance=np.tile(cov, (len(d), 1, 1)))
    T, C = prepare.hand_targets(replace(d, hand=track), DEFAULT_HAND_TOOL)
    e = rng.multivariate_normal(np.zeros(6), cov, 40_000)
    true = np.tile(H, (len(e), 1, 1))
    true[:, :3, 3] += e[:, :3]
    true[:, :3, :3] = Rotation.from_rotvec(e[:, 3:]).as_matrix() @ true[:, :3, :3]
    seen = lie.se3_log(lie.se3_inverse(T[:1]) @ true @ DEFAULT_HAND_TOOL)
    np.testing.assert_allclose(np.cov(seen.T), C[0], atol=0.05 * np.abs(C[0]).max())
    P, B = d.torso, np.array([-0.4, 0.3, 0.5])
    cov = np.diag([1e-4, 9e-4, 4e-4])
    target, C = prepare.base_targets(replace(d, torso=replace(P, covariance=np.tile(cov, (len(d), 1, 1)))), B)
    true = lie.se2_compose(P.xy_yaw[0] + rng.multivariate_normal(np.zeros(3), cov, 40_000), B[None])
    seen = lie.se2_log(lie.se2_compose(lie.se2_inverse(target[:1]), true))
    np.testing.assert_allclose(np.cov(seen.T), C[0], atol=0.05 * np.abs(C[0]).max())


def test_what_was_not_seen_says_nothing() -> None:
    d = scenes.demonstration("drawer", noise=scenes.CORRUPTED)
    T, _ = prepare.hand_targets(d, DEFAULT_HAND_TOOL)
    assert (np.isnan(T).all(axis=(1, 2)) == ~d.hand.observed).all()
    unoriented = replace(d.hand, oriented=np.zeros(len(d), bool))
    _, C = prepare.hand_targets(replace(d, hand=unoriented), DEFAULT_HAND_TOOL)
    assert (np.linalg.eigvalsh(C[:, 3:, 3:]) > 1).all()
