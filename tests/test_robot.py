"""Robots: descriptions, kinematics against Pinocchio, exact inverse kinematics, reachability."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pin = pytest.importorskip("pinocchio", reason="needs the extra `robot` (pin)")
pytest.importorskip("numba", reason="needs the extra `robot` (numba)")

from understudy.errors import MissingExtraError, UnderstudyError  # noqa: E402
from understudy.robot import urdf  # noqa: E402
from understudy.robot.description import ROBOTS, RobotError, load_description  # noqa: E402
from understudy.robot.field import label, load_field, train_field, training_poses  # noqa: E402
from understudy.robot.ik import pose_distance, solve_ik  # noqa: E402
from understudy.robot.ik_follow import follow_ik_path  # noqa: E402
from understudy.robot.ik_path import solve_ik_path  # noqa: E402
from understudy.robot.model import Robot, load_robot  # noqa: E402
from understudy.robot.reachability import build_map, load_map, orientation_bins  # noqa: E402

try:
    urdf.data_folder()
except MissingExtraError:
    pytest.skip("needs the package example-robot-data", allow_module_level=True)


@pytest.fixture(scope="module")
def pr2() -> Robot:
    return load_robot("pr2")


@pytest.fixture(scope="module")
def tiago() -> Robot:
    return load_robot("tiago_pro")


@pytest.fixture(params=["pr2", "pr2:left", "tiago_pro"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


def exp(xi: np.ndarray) -> np.ndarray:
    """Small right perturbations (n, 6) as (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(xi), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = xi[:, :3], Rotation.from_rotvec(xi[:, 3:]).as_matrix()
    return T


def oracle(robot: Robot, q: np.ndarray, torso: float) -> Any:
    """Pinocchio's own kinematics of the full model: its data with all frames placed."""
    model, d = robot.model, robot.description
    data, full = model.createData(), pin.neutral(model)
    for name, value in zip((d.torso_joint, *d.arm_joints), (torso, *q), strict=True):
        joint = model.joints[model.getJointId(name)]
        full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
    pin.framesForwardKinematics(model, data, full)
    return data


# descriptions


def test_every_shipped_description_loads_and_its_tool_frame_is_right_handed() -> None:
    for name in ROBOTS:
        T = load_description(name).T_link_tool
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "legs"}, "base 'legs': must be one of 'planar'"),
        ({"posture": [0, 1]}, "posture: must be 7 numbers"),
        ({"posture": [9, 0, 0, -1, 0, -1, 0]}, "posture: outside of the joint limits"),
        ({"arm_joints": "all"}, "arm_joints: must be a list of names"),
        ({"torso_joint": "spine"}, "torso_joint: the URDF has no movable joint 'spine'"),
        ({"tool_link": "hand"}, "tool_link: the URDF has no link 'hand'"),
        ({"tool_link": "l_gripper_tool_frame"}, "'l_gripper_tool_frame' moves with joint 'l_wrist_roll_joint'"),
        ({"base_link": "torso_lift_link"}, "base_link: 'torso_lift_link' is not the root"),
        ({"urdf": "nowhere.urdf"}, "no file"),
        ({"footprint": [[0, 0], [0, 1], [1, 0]]}, "footprint: must be a convex polygon, counter-clockwise"),
        ({"tool_frame": {"origin": [0, 0, 0], "x": [1, 0, 0], "y": [1, 0, 0]}}, "x and y: must be unit vectors"),
        ({"colour": "red"}, "unknown field 'colour'"),
    ],
)
def test_a_bad_description_is_refused_and_the_field_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    data = json.loads((files("understudy.robot") / "descriptions" / "pr2_right.json").read_text())
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data | change))
    with pytest.raises(RobotError) as error:
        load_robot(path)
    assert message in str(error.value) and "mine.json" in str(error.value)


def test_a_missing_field_and_an_unknown_robot_are_named(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(RobotError, match="field 'arm_joints' is missing"):
        load_robot(tmp_path / "mine.json")
    with pytest.raises(RobotError, match="'pr3': must be one of 'pr2'"):
        load_robot("pr3")


def test_urdf_with_base_moves_the_whole_robot_and_finds_its_meshes(pr2: Robot) -> None:
    text = pr2.urdf_with_base()
    model = pin.buildModelFromXML(text)
    meshes = [mesh.get("filename") for mesh in ET.fromstring(text).iter("mesh")]
    assert meshes and all(Path(str(m)).is_file() for m in meshes)
    q, data = pin.neutral(model), model.createData()
    for name, value in zip(urdf.BASE_JOINTS, (1.0, -2.0, 0.5), strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, q)
    moved = data.oMf[model.getBodyId(pr2.description.tool_link)].homogeneous
    world_base = np.eye(4)
    world_base[:2, 3], world_base[:3, :3] = (1, -2), Rotation.from_rotvec([0, 0, 0.5]).as_matrix()
    np.testing.assert_allclose(moved, world_base @ pr2.forward(np.zeros((1, 7)), np.zeros(1))[0], atol=1e-12)


# kinematics


def test_forward_agrees_with_pinocchio(robot: Robot) -> None:
    q, torso = robot.sample(100, seed=1)
    T = robot.forward(q, torso)
    d = robot.description
    frame = robot.model.getBodyId(d.tool_link)
    for i in range(len(q)):
        truth = oracle(robot, q[i], torso[i]).oMf[frame].homogeneous @ d.T_link_tool
        np.testing.assert_allclose(T[i], truth, atol=1e-9)


def test_the_tool_frame_is_the_pinch_point(robot: Robot) -> None:
    """The two finger tips lie on either side of its origin along y, and in front of the gripper's base along x."""
    d = robot.description
    q, torso = robot.sample(1, seed=4)
    data = oracle(robot, q[0], torso[0])
    tips = [f.name for f in robot.model.frames if f.name.endswith(("finger_tip_link",)) or "fingertip" in f.name]
    side = d.tool_link[0] if robot.name.startswith("pr2") else "gripper_right"
    tips = [name for name in tips if name.startswith(side) and name.endswith("link")]
    base_T = np.linalg.inv(robot.forward(q, torso)[0])
    seen = np.array([(base_T @ data.oMf[robot.model.getBodyId(name)].homogeneous)[:3, 3] for name in tips])
    assert len(seen) == 2
    np.testing.assert_allclose(seen[0] * (1, -1, 1), seen[1], atol=2e-3)
    assert np.abs(seen[:, 1]).min() > 0.005 and np.abs(seen[:, 2]).max() < 2e-3
    assert (seen[:, 0] < 0.005).all() and (seen[:, 0] > -0.08).all()


def test_gripper_values_span_the_joint(robot: Robot) -> None:
    gripper = robot.description.gripper
    assert gripper.joint_value(0) == gripper.closed and gripper.joint_value(9) == gripper.open
    joint = robot.model.joints[robot.model.getJointId(gripper.joints[0])]
    low, high = robot.model.lowerPositionLimit[joint.idx_q], robot.model.upperPositionLimit[joint.idx_q]
    assert sorted((gripper.closed, gripper.open)) == pytest.approx([low, high], abs=1e-3)


def test_the_arm_in_the_body_collides_and_the_comfortable_posture_does_not(robot: Robot) -> None:
    posture, low = robot.description.posture, robot.torso_limits[0]
    q, torso = robot.sample(300, seed=2)
    colliding = robot.collides(q, torso)
    assert not robot.collides(posture[None], np.array([low]))[0]
    assert 0.05 < colliding.mean() < 0.4
    worst = int(np.flatnonzero(colliding)[0])
    assert robot.self_collision.touching(q[worst], torso[worst])
    assert not robot.self_collision.touching(posture, low)


def test_balls_rule_out_no_pair_of_links_that_touches(robot: Robot) -> None:
    """They rule out nearly all that do not; what remains is exactly Coal's answer over all pairs."""
    collision = robot.self_collision
    q, torso = robot.sample(600, seed=12)
    near = collision.near(q, torso)
    touching = np.zeros_like(near)
    for i, row in enumerate(collision.configurations(q, torso)):
        pin.updateGeometryPlacements(
            collision.model, collision.data, collision.geometry, collision.geometry_data, row
        )  # fmt: skip
        pin.computeCollisions(collision.geometry, collision.geometry_data, False)
        touching[i] = [r.isCollision() for r in collision.geometry_data.collisionResults]
    assert touching.any() and not (touching & ~near).any()
    assert near.mean() < 0.15
    np.testing.assert_array_equal(robot.collides(q, torso), touching.any(axis=1))


# inverse kinematics


@pytest.mark.parametrize("at_limits", [False, True])
def test_ik_finds_what_there_is_exactly_and_within_limits(robot: Robot, at_limits: bool) -> None:
    q, torso = robot.sample(250, seed=5)
    if at_limits:
        rng = np.random.default_rng(6)
        side = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
        q = np.where((rng.random(q.shape) < 0.4) & np.isfinite(side), side, q)
    T = robot.forward(q, torso)
    result = solve_ik(robot, T, torso, check_collisions=False)
    assert result.success.mean() >= 0.995
    ok = result.success
    position, angle = pose_distance(robot.forward(result.q, result.torso), T)
    assert position[ok].max() <= 1e-4 and angle[ok].max() <= 1e-3
    assert robot.within_limits(result.q, result.torso)[ok].all()
    np.testing.assert_allclose(result.torso, torso)


def test_ik_avoids_self_collision_and_says_why_it_fails(pr2: Robot) -> None:
    q, torso = pr2.sample(300, seed=8)
    free = ~pr2.collides(q, torso)
    T = pr2.forward(q[free], torso[free])
    result = solve_ik(pr2, T, torso[free])
    assert result.success.mean() >= 0.99
    assert not pr2.collides(result.q[result.success], result.torso[result.success]).any()
    T[:, 0, 3] += 5
    far = solve_ik(pr2, T[:3], torso[free][:3])
    assert far.why == ("unreachable",) * 3 and not far.success.any() and (far.position_error > 3).all()
    inside = np.eye(4)[None].copy()
    inside[0, :3, 3] = 0.0, 0.0, 0.5  # in the middle of the base
    assert solve_ik(pr2, inside, np.array([0.1])).why[0] in ("collision", "unreachable")


def test_ik_with_a_free_torso_stays_within_its_bounds_and_near_a_wanted_posture(pr2: Robot) -> None:
    q, torso = pr2.sample(100, seed=9)
    T = pr2.forward(q, torso)
    bounds = np.column_stack([np.maximum(torso - 0.05, 0), np.minimum(torso + 0.05, 0.31)])
    result = solve_ik(pr2, T, bounds, seed=q, check_collisions=False)
    assert result.success.all()
    assert ((result.torso >= bounds[:, 0]) & (result.torso <= bounds[:, 1])).all()
    near = solve_ik(pr2, T, torso, seed=q, check_collisions=False)
    np.testing.assert_allclose(near.q, q, atol=1e-3)


@pytest.mark.parametrize(
    ("torso", "message"), [(np.array([[0.2, 0.1]]), "low first"), (np.array([5.0]), "torso: heights must be within")]
)
def test_ik_refuses_bad_heights(pr2: Robot, torso: np.ndarray, message: str) -> None:
    with pytest.raises(UnderstudyError, match=message):
        solve_ik(pr2, np.eye(4)[None], torso)
    with pytest.raises(UnderstudyError, match="finite"):
        solve_ik(pr2, np.full((1, 4, 4), np.nan))


def arc(t: int, side: float = 1.0) -> np.ndarray:
    """A door handle's way before the robot: an arc of 60 degrees, at 0.9 m. side: -1 mirrors it for a left arm."""
    a = np.linspace(0, np.pi / 3, t)
    T = np.tile(np.eye(4), (t, 1, 1))
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = 0.65 - 0.35 * np.sin(a) * 0.5, -0.5 + 0.35 * (1 - np.cos(a)), 0.9
    T[:, 1, 3] *= side
    T[:, :3, :3] = Rotation.from_euler("z", side * 0.6 * a[:, None]).as_matrix().reshape(t, 3, 3)
    return T


def test_a_path_is_exact_continuous_and_within_velocity_limits(robot: Robot) -> None:
    t = 40
    T = arc(t, -1.0 if "left" in robot.name else 1.0)
    path = solve_ik_path(robot, T, np.full(t, 0.1), times_s=np.arange(t) * 0.15)
    assert path.success.all() and path.jumps == ()
    assert path.position_error.max() <= 1e-4 and path.angle_error.max() <= 1e-3
    assert np.abs(np.diff(path.q, axis=0)).max() < 0.1
    assert not robot.collides(path.q, path.torso).any() and robot.within_limits(path.q, path.torso).all()
    assert path.velocity_share is not None and path.velocity_share.max() < 1
    fast = solve_ik_path(robot, T, np.full(t, 0.1), times_s=np.arange(t) * 0.0015)
    np.testing.assert_allclose(fast.velocity_share, 100 * path.velocity_share, rtol=1e-6)


def test_a_path_that_leaves_the_workspace_says_where(pr2: Robot) -> None:
    T = arc(20)
    T[10:, 0, 3] += 2
    path = solve_ik_path(pr2, T, np.full(20, 0.1))
    np.testing.assert_array_equal(path.success, np.arange(20) < 10)
    np.testing.assert_allclose(path.q[10:], np.tile(path.q[9], (10, 1)))


def test_a_followed_path_is_exact_continuous_and_no_faster_than_the_thorough_one(robot: Robot) -> None:
    t = 40
    T, torso, times = arc(t, -1.0 if "left" in robot.name else 1.0), np.full(t, 0.1), np.arange(t) * 0.15
    path, thorough = follow_ik_path(robot, T, torso, times), solve_ik_path(robot, T, torso, times)
    assert path.success.all() and path.jumps == ()
    assert path.position_error.max() <= 1e-4 and path.angle_error.max() <= 1e-3
    assert not robot.collides(path.q, path.torso).any() and robot.within_limits(path.q, path.torso).all()
    assert path.velocity_share.max() <= 1.05 * thorough.velocity_share.max()


def test_a_followed_path_goes_on_beyond_a_gap(pr2: Robot) -> None:
    """Samples in the middle that cannot be reached are no success; those after them are."""
    T = arc(30)
    T[12:15, 0, 3] += 2
    path = follow_ik_path(pr2, T, np.full(30, 0.1), 0.2 * np.arange(30))
    np.testing.assert_array_equal(path.success, ~np.isin(np.arange(30), [12, 13, 14]))
    nowhere = T.copy()
    nowhere[:, 0, 3] += 5
    assert not follow_ik_path(pr2, nowhere, np.full(30, 0.1), 0.2 * np.arange(30)).success.any()
    with pytest.raises(UnderstudyError, match="times that increase"):
        follow_ik_path(pr2, T, np.full(30, 0.1), np.zeros(30))


# reachability


@pytest.mark.parametrize("name", ["pr2", "tiago_pro"])
def test_the_shipped_field_is_right_about_typical_poses(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gripper within 20 degrees of level, before the robot: precision and recall against exact IK with collisions."""
    monkeypatch.setattr("understudy.robot.field.train_field", None)  # shipped: must not train
    robot = load_robot(name)
    rng, n = np.random.default_rng(11), 250
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = rng.uniform((0.25, -0.8, 0.4), (1.1, 0.8, 1.4), (n, 3))
    angles = np.column_stack([rng.uniform(-1.4, 1.4, n), rng.uniform(-0.35, 0.35, n), rng.uniform(-0.35, 0.35, n)])
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    torso = rng.uniform(*robot.torso_limits, n)
    exact = solve_ik(robot, T, torso).success
    says = load_field(robot).distance(T, torso)[0] <= 0
    assert exact[says].mean() >= 0.95 and says[exact].mean() >= 0.88


def test_the_fields_gradient_is_its_derivative(pr2: Robot) -> None:
    field = load_field(pr2)
    T, torso = training_poses(pr2, 300, 21)
    value, d_pose, d_torso = field.distance(T, torso)
    np.testing.assert_allclose(field.value(T, torso), value, rtol=0, atol=1e-12)
    step = 1e-5
    for k in range(6):
        xi = np.zeros((len(T), 6))
        xi[:, k] = step
        change = field.distance(T @ exp(xi), torso)[0] - field.distance(T @ exp(-xi), torso)[0]
        np.testing.assert_allclose(d_pose[:, k], change / (2 * step), atol=1e-6)
    change = field.distance(T, torso + step)[0] - field.distance(T, torso - step)[0]
    np.testing.assert_allclose(d_torso, change / (2 * step), atol=1e-6)


def test_the_field_grows_like_the_distance_far_out(pr2: Robot) -> None:
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = (0.8, -0.3, 0.9)
    T[:, 0, 3] += (0, 1, 2, 3)
    value, d_pose, _ = load_field(pr2).distance(T, np.full(4, 0.1))
    assert value[0] < 0.05
    np.testing.assert_allclose(np.diff(value[1:]), 1, atol=0.25)
    assert (d_pose[1:, 0] > 0.7).all()


def test_training_is_deterministic_kept_and_keyed_by_the_robot(
    pr2: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNDERSTUDY_CACHE", str(tmp_path))
    pose, torso = training_poses(pr2, 50, 3)
    field = load_field(pr2, samples=600)
    again = train_field(pr2, samples=600)
    np.testing.assert_array_equal(field.distance(pose, torso)[0], again.distance(pose, torso)[0])
    monkeypatch.setattr("understudy.robot.field.train_field", None)  # from here on only the cache
    kept = load_field(pr2, samples=600)
    np.testing.assert_array_equal(field.distance(pose, torso)[0], kept.distance(pose, torso)[0])
    other = Robot(replace(pr2.description, content=pr2.description.content + b" "))
    with pytest.raises(TypeError):  # another checksum: it would train
        load_field(other, samples=600)


def test_labels_are_distances_to_the_reachable_set(pr2: Robot) -> None:
    """A pose moved straight away from a stretched arm is as far as it was moved; none is nearer than claimed."""
    T, torso = training_poses(pr2, 300, 5)
    labels = label(pr2, T, torso)
    assert 0.1 < labels.reachable.mean() < 0.6
    known = np.isfinite(labels.nearest[:, 0, 0])
    assert known.sum() > 20
    position, angle = pose_distance(labels.nearest[known], T[known])
    np.testing.assert_allclose(np.hypot(position, 0.25 * angle), labels.distance[known], atol=1e-6)
    assert solve_ik(pr2, labels.nearest[known], torso[known]).success.mean() > 0.95


def test_the_map_scores_what_is_reached_and_places_the_base(
    pr2: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNDERSTUDY_CACHE", str(tmp_path))
    reachability = load_map(pr2, samples=500_000)
    q, torso = pr2.sample(500, seed=12)
    free = ~pr2.collides(q, torso)
    T = pr2.forward(q, torso)[free]
    assert (reachability.reachable(T, torso[free]) > 0).mean() > 0.9
    far = T.copy()
    far[:, 0, 3] += 2
    assert not reachability.reachable(far, torso[free]).any()
    handle = np.tile(np.eye(4), (2, 1, 1))
    handle[:, :3, 3] = (3, 1, 0.9), (2.8, 1, 0.9)
    placements = reachability.base_placements(handle, 0.1, count=50)
    assert len(placements.base) == 50 and (np.diff(placements.score) <= 0).all()
    reached = np.ones(50, bool)
    for T_world_tool in handle:
        T_base_tool = np.array(
            [np.linalg.inv(exp(np.array([[x, y, 0, 0, 0, a]]))[0]) @ T_world_tool for x, y, a in placements.base]
        )
        reached &= solve_ik(pr2, T_base_tool, np.full(50, 0.1)).success
    assert reached.mean() >= 0.7
    kept = load_map(pr2, samples=500_000)
    np.testing.assert_array_equal(kept.score, reachability.score)
    np.testing.assert_array_equal(build_map(pr2, 80_000).score, build_map(pr2, 80_000).score)


def test_orientation_bins_hold_about_equal_shares() -> None:
    T = np.tile(np.eye(4), (40_000, 1, 1))
    T[:, :3, :3] = Rotation.random(len(T), rng=np.random.default_rng(0)).as_matrix()
    count = np.bincount(orientation_bins(T), minlength=432)
    assert len(count) == 432 and count.min() > 0.5 * count.mean() and count.max() < 1.6 * count.mean()
