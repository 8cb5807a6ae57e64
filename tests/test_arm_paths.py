"""Self-motions that are spread over time, and the arm's surface against what is around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

for name in ("pinocchio", "numba"):
    pytest.importorskip(name, reason="needs the extra robot")

import pinocchio as pin  # noqa: E402

from understudy import lie  # noqa: E402
from understudy.adaptation.around import Around, Surrounded, points_around  # noqa: E402
from understudy.adaptation.clearance import arm_clear  # noqa: E402
from understudy.adaptation.fields import point_field  # noqa: E402
from understudy.adaptation.robots import joint_path  # noqa: E402
from understudy.errors import MissingExtraError  # noqa: E402
from understudy.robot import urdf  # noqa: E402
from understudy.robot.arm_surface import arm_surface  # noqa: E402
from understudy.robot.ik import pose_distance, solve_ik  # noqa: E402
from understudy.robot.ik_bridge import bridged  # noqa: E402
from understudy.robot.ik_path import JUMP_RAD, IKPath  # noqa: E402
from understudy.robot.model import Robot, load_robot  # noqa: E402

try:
    urdf.data_folder()
except MissingExtraError:
    pytest.skip("needs the package example-robot-data", allow_module_level=True)


@pytest.fixture(params=["pr2", "tiago_pro"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


def jumping(robot: Robot, t: int = 40) -> tuple[IKPath, np.ndarray]:
    """A tool that stands still, held first with one posture of the arm, then at once with another."""
    height = np.array([0.5 * sum(robot.torso_limits)])
    T = robot.forward(robot.description.posture[None], height)
    rng = np.random.default_rng(0)
    one = solve_ik(robot, T, height).q[0]
    for _ in range(200):
        # the elbow elsewhere, along the same self-motion: small steps from one solution to the next
        other, way = one, 0.2 * rng.normal(size=robot.n)
        for _ in range(12):
            found = solve_ik(robot, T, height, seed=other + way)
            step = lie.wrapped(found.q[0] - other)
            if not found.success[0] or np.abs(step).max() > 0.4:
                break
            other = other + step
        if np.abs(other - one).max() > 1.5 * JUMP_RAD:
            break
    else:
        pytest.fail("no two postures for one pose")
    q = np.where(np.arange(t)[:, None] < t // 2, one, other)
    zero = np.zeros(t)
    return IKPath(q, np.full(t, height[0]), zero == 0, zero, zero, (t // 2,), None), np.repeat(T, t, axis=0)


def test_a_self_motion_is_spread_through_exact_solutions(robot: Robot) -> None:
    path, T = jumping(robot)
    out = bridged(robot, path, T)
    assert out.jumps == () and out.success.all()
    assert out.position_error.max() <= 1e-4 and out.angle_error.max() <= 1e-3
    assert np.abs(lie.wrapped(np.diff(out.q, axis=0))).max() < JUMP_RAD
    assert not robot.collides(out.q, out.torso).any() and robot.within_limits(out.q, out.torso).all()
    np.testing.assert_allclose(out.q[[0, -1]], path.q[[0, -1]])


def test_a_jump_stays_where_something_is_in_the_way(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    path, T = jumping(robot)
    ends = path.q[[0, -1]]

    def elsewhere(q: np.ndarray, torso: np.ndarray) -> np.ndarray:
        return np.abs(q[:, None] - ends).max(axis=2).min(axis=1) > 0.1

    monkeypatch.setattr(robot, "collides", elsewhere)
    out = bridged(robot, path, T)
    assert out.jumps == path.jumps and (out.q == path.q).all()


def test_no_bridge_over_samples_without_solution(robot: Robot) -> None:
    path, T = jumping(robot)
    failed = path.success.copy()
    failed[[18, 21]] = False
    assert bridged(robot, replace(path, success=failed), T).jumps == path.jumps


def test_surface_points_are_on_the_links_and_all_over_them(robot: Robot) -> None:
    surface, collision = arm_surface(robot), robot.self_collision
    q, torso = robot.sample(4, 1)
    points = surface.at(robot.stack(q, torso))
    data = collision.model.createData()
    for i, row in enumerate(collision.configurations(q, torso)):
        pin.forwardKinematics(collision.model, data, row)
        for number in np.unique(surface.joint):
            link = collision.model.getJointId(robot.description.arm_joints[number - 1])
            vertices = np.concatenate([_vertices(o, data) for o in collision.geometry.geometryObjects
                                       if o.parentJoint == link])  # fmt: skip
            ours = points[i, surface.joint == number]
            apart = np.linalg.norm(vertices[:, None] - ours, axis=2).min(axis=1)
            assert apart.max() < 0.06  # vertices inside of the hull are farther than 3 cm
            assert (ours.min(axis=0) > vertices.min(axis=0) - 1e-6).all()
            assert (ours.max(axis=0) < vertices.max(axis=0) + 1e-6).all()
            extreme = np.abs(ours.max(axis=0) - vertices.max(axis=0)).max()
            assert extreme < 0.015


def _vertices(shape: object, data: object) -> np.ndarray:
    g = shape.geometry  # type: ignore[attr-defined]
    v = np.array(g.points() if hasattr(g, "points") else g.vertices(), float).reshape(-1, 3)
    T = (data.oMi[shape.parentJoint] * shape.placement).homogeneous  # type: ignore[attr-defined]
    return np.asarray(v @ T[:3, :3].T + T[:3, 3])


def test_clear_is_the_least_distance_of_all_points(robot: Robot) -> None:
    surface, rng = arm_surface(robot), np.random.default_rng(3)
    low, high = np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 2.0])
    field = point_field(rng.uniform(low, high, (300, 3)), low, high, 0.05)
    q, torso = robot.sample(60, 2)
    x = robot.stack(q, torso)
    T = lie.se2_to_se3(rng.uniform(-0.2, 0.2, (60, 3)))
    points = surface.at(x) @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    inside = ((points > low) & (points < high)).all(axis=2)
    nearest = np.where(inside, field.at(points.reshape(-1, 3))[0].reshape(inside.shape), np.inf).min(axis=1)
    for least in (0.0, 0.02, 0.05):
        sure = np.abs(nearest - least) > 1e-9
        clear = surface.clear(x, T, field.values, field.origin, field.cell_m, least)
        assert (clear == (nearest >= least))[sure].all() and clear.any() and not clear.all()


def elbow_in_the_way(robot: Robot) -> tuple[np.ndarray, np.ndarray, Surrounded]:
    """A tool that moves a little, and something that stands where the elbow goes if nobody looks."""
    t = 12
    height = np.full(t, 0.5 * sum(robot.torso_limits))
    T = np.repeat(robot.forward(robot.description.posture[None], height[:1]), t, axis=0)
    T[:, 2, 3] += np.linspace(0, 0.04, t)
    free = joint_path(robot, T, height, 0.1 * np.arange(t), None, thorough=False)
    surface = arm_surface(robot)
    links = surface.at(robot.stack(free.q, height))[:, surface.joint == surface.joint.min()]
    out = links[t // 2, np.argmax(np.linalg.norm(links[t // 2] - T[t // 2, :3, 3], axis=1))]
    field = points_around(out[None], out - 1.5, out + 1.5, 0.03)
    poses = np.tile(np.eye(4), (t, 1, 1))
    return T, height, Surrounded(Around(field, None), np.zeros((t, 3)), poses)


def test_the_arm_goes_round_what_its_elbow_would_meet(robot: Robot) -> None:
    T, height, surrounded = elbow_in_the_way(robot)
    times = 0.1 * np.arange(len(T))
    blind = joint_path(robot, T, height, times, None, thorough=False)
    every = np.arange(len(T))
    assert not arm_clear(robot, surrounded, blind.q, height, every)[0].all(), "nothing is in the way"
    seeing = joint_path(robot, T, height, times, surrounded, thorough=True)
    assert seeing.exact.all() and seeing.linked.all() and seeing.clear.all()
    assert arm_clear(robot, surrounded, seeing.q, height, every)[0].all()
    apart, turned = pose_distance(robot.forward(seeing.q, height), T)
    assert apart.max() <= 1e-4 and turned.max() <= 1e-3


def test_an_arm_that_cannot_be_clear_says_where(robot: Robot) -> None:
    """Everything around the arm is full: the path stays exact, and is honest about it."""
    T, height, surrounded = elbow_in_the_way(robot)
    full = point_field(np.zeros((1, 3)), np.full(3, -2.0), np.full(3, 2.0), 0.1)
    wall = replace(surrounded, around=Around(replace(full, values=np.full_like(full.values, -1.0)), None))
    path = joint_path(robot, T, height, 0.1 * np.arange(len(T)), wall, thorough=True)
    assert path.exact.all() and path.linked.all()
    assert not path.scene_clear.any() and path.part_clear.all() and not path.clear.any()


def test_a_part_is_met_where_it_is_at_that_moment(robot: Robot) -> None:
    """The part's field is in its own frame: the same posture is clear before the part has come, and not after."""
    T, height, surrounded = elbow_in_the_way(robot)
    q = joint_path(robot, T, height, 0.1 * np.arange(len(T)), None, thorough=False).q
    poses = np.tile(np.eye(4), (len(T), 1, 1))
    poses[:6, 0, 3] = 1.0
    moving = Surrounded(Around(None, surrounded.around.scene), surrounded.base, poses)
    still = arm_clear(robot, surrounded, q, height, np.arange(len(T)))[0]
    scene, part = arm_clear(robot, moving, q, height, np.arange(len(T)))
    assert scene.all() and part[:6].all() and (part[6:] == still[6:]).all() and not part[6:].all()
