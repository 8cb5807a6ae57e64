"""Executions in physics: success, the ways to fail and their reasons, time scaling, ROS bags, trials."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import pytest

for name in ("mujoco", "pinocchio", "numba", "sklearn"):
    pytest.importorskip(name, reason="needs the extras robot and stage, and scikit-learn")

import adaptation_scenes  # noqa: E402
import execution_scenes as scenes  # noqa: E402
from scipy.stats import binomtest  # noqa: E402

from understudy import lie  # noqa: E402
from understudy.actions import ActionModel, RobotPose, Skill, learn  # noqa: E402
from understudy.adaptation.adapt import adapt  # noqa: E402
from understudy.adaptation.around import Surrounded  # noqa: E402
from understudy.adaptation.clearance import GuardedRobot  # noqa: E402
from understudy.adaptation.fields import collision_free  # noqa: E402
from understudy.adaptation.platform import Platform  # noqa: E402
from understudy.demonstration.demonstration import OCCUPIED  # noqa: E402
from understudy.errors import MissingExtraError, UnderstudyError  # noqa: E402
from understudy.execution import trials  # noqa: E402
from understudy.execution.control import Arm, HandleEstimate  # noqa: E402
from understudy.execution.execution import Config, Execution  # noqa: E402
from understudy.execution.imitation import imitation_plan, unadapted  # noqa: E402
from understudy.execution.outcome import Outcome, Reason, Stopped  # noqa: E402
from understudy.execution.planning import make_plan  # noqa: E402
from understudy.execution.surroundings import observe  # noqa: E402
from understudy.execution.timing import time_scaled  # noqa: E402
from understudy.geometry import inverse  # noqa: E402
from understudy.robot import ik  # noqa: E402
from understudy.robot.model import Robot  # noqa: E402
from understudy.robot.simulator import Noise, Simulator  # noqa: E402
from understudy.stage.furniture import sample_furniture  # noqa: E402
from understudy.teaching_motions import robot_motions  # noqa: E402


@pytest.fixture(scope="module")
def robot() -> Robot:
    try:
        return trials.trial_robot("pr2")
    except MissingExtraError as e:
        pytest.skip(f"no robot: {e}")


@pytest.fixture(scope="module")
def platform(robot: Robot) -> Platform:
    from understudy.adaptation.robots import platform_of

    return platform_of(robot)


@pytest.fixture(scope="module")
def drawer() -> ActionModel:
    return scenes.scripted_skill("drawer")


@pytest.fixture(scope="module")
def opened(drawer: ActionModel, robot: Robot, platform: Platform) -> Outcome:
    return trials.run_trial(drawer, robot, platform, trials.TrialSetup("drawer", 100_000))


def test_opens_a_drawer_that_it_has_not_seen(opened: Outcome) -> None:
    assert opened.success and opened.reason == Reason.OPENED, opened.detail
    assert opened.opened_share > 0.9 and not opened.collisions and opened.max_force < 100
    t = opened.trajectory
    assert t.opened[-1] > 0.2 and (np.diff(t.times_s) > 0).all()
    assert t.opening_m[-1] > 0.03  # has let go
    json.dumps(opened.to_json())


def test_the_commanded_motion_keeps_the_robots_limits(opened: Outcome, robot: Robot) -> None:
    t, limits = opened.trajectory, robot.description.limits
    dt = np.diff(t.times_s)[:, None]
    assert (np.abs(np.diff(t.q, axis=0)) <= robot.velocity * dt * 1.001).all()
    assert (np.abs(np.diff(t.base, axis=0)) <= np.array(limits.base_velocity) * dt).all()
    assert (np.abs(np.diff(t.torso)) <= limits.torso_velocity * dt[:, 0] * 1.001).all()
    assert robot.within_limits(t.q, np.clip(t.torso, *robot.torso_limits), 1e-6).all()


def test_pushes_a_room_door_open(robot: Robot, platform: Platform) -> None:
    outcome = trials.run_trial(
        scenes.scripted_skill("room_door"), robot, platform, trials.TrialSetup("room_door", 100_000)
    )
    assert outcome.opened_share > 0.8, (outcome.reason, outcome.course)
    base = outcome.trajectory.base
    assert base[:, 0].max() > base[0, 0] + 0.5  # the base goes along


def run(model: ActionModel, robot: Robot, platform: Platform, prepare, retries: int = 1) -> Outcome:
    setup = trials.TrialSetup("drawer", 100_001)
    simulator = Simulator(robot, setup.furniture, seed=1, base_start=setup.base_start)
    prepare(simulator)
    return Execution(model, robot, platform, partial(observe, setup.furniture), config=Config(retries=retries)).run(
        simulator
    )


def test_says_that_the_part_is_blocked(drawer: ActionModel, robot: Robot, platform: Platform) -> None:
    outcome = run(drawer, robot, platform, Simulator.block)
    assert not outcome.success and outcome.reason in (Reason.BLOCKED, Reason.LOST), outcome.course
    assert outcome.retries == 1 and abs(outcome.opened_share) < 0.05
    assert outcome.max_force < Config().force_n + 50
    assert any("does not move" in line for line in outcome.course), outcome.course


def test_notices_that_the_handle_slips(drawer: ActionModel, robot: Robot, platform: Platform) -> None:
    def slippery(simulator: Simulator) -> None:
        simulator.set_handle_friction(0.0)
        simulator.model.dof_frictionloss[simulator.model.joint("part").dofadr[0]] = 60.0

    outcome = run(drawer, robot, platform, slippery, retries=0)
    assert not outcome.success and outcome.reason in (Reason.LOST, Reason.MISSED), outcome.course


def test_plans_nothing_that_the_robot_cannot_do(drawer: ActionModel, robot: Robot, platform: Platform) -> None:
    """Whatever the skill says: the plan stays off the map, within joint limits, and the tool where the grasp is."""
    furniture = sample_furniture("drawer", 100_003)
    base, torso = np.array([-1.6, 0.3, 0.1]), 0.155
    q = robot.description.posture
    T = lie.se2_to_se3(base[None])[0] @ robot.forward(q[None], np.array([torso]))[0]
    observed = observe(furniture, furniture.articulation.T_rest)
    assert (observed.map.state == OCCUPIED).any()
    plan = make_plan(drawer, robot, platform, observed, RobotPose(T, base, torso), q)
    times = np.linspace(0, plan.duration_s, 400)
    x, v = plan.timed.at(times)
    assert np.abs(x[0, :3] - base).max() < 0.01 and np.abs(x[0, 4:-1] - q).max() < 1e-9
    assert collision_free(observed.map, robot.description.footprint, x[:, :3]).all()
    assert robot.within_limits(x[:, 4:-1], np.clip(x[:, 3], *robot.torso_limits), 1e-3).all()
    hold = (times >= plan.grasp_s) & (times <= plan.release_s)
    tool = lie.se2_to_se3(x[hold, :3]) @ robot.forward(x[hold, 4:-1], x[hold, 3])
    wanted = furniture.articulation.pose(x[hold, -1]) @ plan.grasp
    assert np.linalg.norm(tool[:, :3, 3] - wanted[:, :3, 3], axis=1).max() < 0.01
    assert np.abs(v[[0, -1]]).max() < 1e-6


def test_a_plan_ends_when_the_gripper_is_off_the_handle(robot: Robot, platform: Platform) -> None:
    """What the teacher's hand did afterwards (here: rose to where no arm reaches) is not carried out, nor planned."""
    motions = []
    for seed in range(2):
        motion = scenes.scripted_motion(sample_furniture("drawer", seed), np.random.default_rng(seed))
        T = motion.T_world_tool.copy()
        after = len(T) - motion.segments.release
        T[-after:, 2, 3] += 2.0 * np.linspace(0, 1, after) ** 2
        motions.append(replace(motion, T_world_tool=T))
    model, furniture = learn(motions), sample_furniture("drawer", 100_003)
    base, torso, q = np.array([-1.6, 0.3, 0.1]), 0.155, robot.description.posture
    start = RobotPose(lie.se2_to_se3(base[None])[0] @ robot.forward(q[None], np.array([torso]))[0], base, torso)
    observed = observe(furniture, furniture.articulation.T_rest)
    whole = model.reproduce(observed.T_world_object, observed.articulation, None, 10.0, start)
    assert whole.T_world_tool[-1, 2, 3] > 2.0 and len(whole.until(1e3)) == len(whole)
    assert len(whole.until(0.0)) == whole.segments.release + 1
    plan = make_plan(model, robot, platform, observed, start, q)
    end = plan.timed.at(np.array([plan.release_s, plan.duration_s]))[0]
    tool = lie.se2_to_se3(end[:, :3]) @ robot.forward(end[:, 4:-1], end[:, 3])
    assert np.linalg.norm(tool[1, :3, 3] - tool[0, :3, 3]) == pytest.approx(0.1, abs=0.03)


def test_tables_of_the_robot_are_made_once_however_often_it_is_guarded(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, init = [], ik.SeedTable.__init__

    def counted(self: ik.SeedTable, robot: Robot) -> None:
        made.append(robot)
        init(self, robot, 100)

    monkeypatch.setattr(ik, "_tables", WeakKeyDictionary())
    monkeypatch.setattr(ik.SeedTable, "__init__", counted)
    furniture = sample_furniture("drawer", 100_003)
    around = observe(furniture, furniture.articulation.T_rest).around()
    for _ in range(3):
        still = np.eye(4)[None]
        guard = GuardedRobot(robot, Surrounded(around, np.zeros((1, 3)), still), still, np.zeros(1, bool))
        ik.seed_table(guard)
        del guard
        gc.collect()
    assert len(made) == 1


def test_says_so_when_there_is_no_plan(drawer: ActionModel, robot: Robot, platform: Platform) -> None:
    furniture = sample_furniture("drawer", 100_003)
    observed = observe(furniture, furniture.articulation.T_rest)
    observed.map.state[:] = OCCUPIED
    base, q = np.array([-1.6, 0.3, 0.1]), robot.description.posture
    T = lie.se2_to_se3(base[None])[0] @ robot.forward(q[None], np.array([0.155]))[0]
    with pytest.raises(Stopped, match="map") as info:
        make_plan(drawer, robot, platform, observed, RobotPose(T, base, 0.155), q)
    assert info.value.reason == Reason.NO_PLAN


def test_time_scaling_keeps_velocities_and_accelerations() -> None:
    rng = np.random.default_rng(0)
    s = np.linspace(0, 4, 41)
    x = np.cumsum(rng.normal(size=(41, 3)), axis=0) * 0.2
    velocity, acceleration = np.array([0.5, 1.0, 0.8]), np.array([1.0, 3.0, 2.0])
    timed = time_scaled(s, x, velocity, acceleration, stops=np.array([2.0]))
    assert timed.duration_s > 4
    t = np.arange(0, timed.duration_s, 0.004)
    positions, v = timed.at(t)
    assert np.abs(np.diff(positions, axis=0) / 0.004 - 0.5 * (v[1:] + v[:-1])).max() < 0.02
    assert (np.abs(v).max(axis=0) <= velocity).all()
    assert (np.abs(np.diff(positions, axis=0)).max(axis=0) / 0.004 <= velocity).all()
    assert (np.abs(np.diff(positions, 2, axis=0)).max(axis=0) / 0.004**2 <= 1.05 * acceleration).all()
    assert np.abs(positions[[0, -1]] - x[[0, -1]]).max() < 1e-2
    at_stop = timed.at(np.array([timed.time_of(2.0)]))
    assert np.abs(at_stop[1]).max() < 1e-6 and np.abs(at_stop[0][0] - x[20]).max() < 1e-6


def test_time_scaling_is_not_slower_than_planned_where_limits_allow() -> None:
    s = np.linspace(0, 10, 101)
    x = (0.1 * s)[:, None]
    timed = time_scaled(s, x, np.ones(1), np.ones(1), stops=np.zeros(0))
    assert timed.duration_s < 10.8
    with pytest.raises(UnderstudyError, match="positive"):
        time_scaled(s, x, np.zeros(1), np.ones(1), stops=np.zeros(0))


def test_handle_estimate_finds_a_wrong_articulation() -> None:
    """The hinge is elsewhere and turned; measurements are noisy; the estimate is better than one measurement."""
    truth = sample_furniture("swivel_door", 4).articulation
    wrong = lie.se3_exp(np.array([0.02, -0.01, 0.01, 0.0, 0.02, 0.03]))
    rng = np.random.default_rng(1)
    estimate, errors = HandleEstimate(truth.moved(wrong)), []
    path = np.linspace(0, 1.2, 300)
    for q, step in zip(path, np.diff(path, prepend=0.0), strict=True):
        noise = lie.se3_exp(rng.normal(size=6) / np.sqrt(3) * np.repeat([0.005, np.radians(1)], 3))
        estimate.moved(float(step))
        estimate.add(truth.pose(np.array([q]))[0] @ noise)
        errors.append(np.linalg.norm((estimate.pose(estimate.q) - truth.pose(np.array([q]))[0])[:3, 3]))
    assert np.sqrt(np.mean(np.square(errors[30:]))) < 0.004


def test_the_correction_on_the_floor_does_the_same_to_the_handle() -> None:
    truth = sample_furniture("room_door", 4).articulation
    away = lie.se3_exp(np.array([0.03, -0.02, 0.01, 0.0, 0.0, 0.05]))
    estimate, q = HandleEstimate(truth.moved(inverse(away))), np.array([0.3])
    estimate.add(truth.pose(q)[0], 0.3)
    moved = lie.se2_to_se3(estimate.correction_on_floor(0.3)[None])[0]
    assumed, there = truth.moved(inverse(away)).pose(q)[0], truth.pose(q)[0]
    np.testing.assert_allclose((moved @ assumed)[:2], there[:2], atol=1e-9)


def test_the_base_stands_as_planned_before_the_handle_however_wrong_the_place_was(
    drawer: ActionModel, robot: Robot, platform: Platform
) -> None:
    """The robot is wrong by up to 8 cm and 6 degrees from afar: seen from the true handle, base and plan agree."""
    setup = trials.TrialSetup("drawer", 100_002)
    stands = []
    for noise in (Noise((0, 0), (0, 0), (0, 0)), Noise((0.08, 6.0), (0, 0), (0, 0))):
        simulator = Simulator(robot, setup.furniture, seed=3, base_start=setup.base_start, noise=noise)
        perception = partial(observe, setup.furniture)
        outcome = Execution(drawer, robot, platform, perception).run(simulator)
        assert outcome.success, outcome.course
        t = outcome.trajectory
        begins = int(np.argmax(t.opened > 0.02))
        stands.append(t.base[begins])
    planned, corrected = stands
    # the plan itself differs a little, as it begins elsewhere
    assert np.linalg.norm(planned[:2] - corrected[:2]) < 0.03 and abs(planned[2] - corrected[2]) < 0.03
    assert np.abs(t.base[:, 2] - setup.base_start[2]).max() < np.pi / 2  # it does not turn all the way round


def test_imitation_follows_hand_and_torso_as_they_were(robot: Robot, platform: Platform) -> None:
    shown = [adaptation_scenes.demonstration("drawer", k) for k in range(2)]
    result = adapt(shown, platform)
    raw = unadapted(shown, result, platform)
    for d, a in zip(shown, raw.demonstrations, strict=True):
        seen = d.hand.observed
        expected = d.hand.T_world_x[seen] @ result.calibration.hand_tool(d.acting)
        np.testing.assert_allclose(a.T_world_tool[seen], expected, atol=1e-9)
    skill = learn(robot_motions(shown, raw))
    setup = trials.TrialSetup("drawer", 100_000)
    imitated = trials.run_trial(skill, robot, platform, setup, planner=imitation_plan)
    assert imitated.reason in set(Reason) and imitated.trajectory.times_s[-1] > 1


def test_arm_follows_a_tool_path_exactly(robot: Robot) -> None:
    q = robot.description.posture
    T0 = robot.forward(q[None], np.array([0.1]))[0]
    arm = Arm(robot, q)
    for u in np.linspace(0, 1, 100):
        target = T0 @ lie.se3_exp(u * np.array([0.08, 0.03, -0.05, 0.2, 0.0, 0.1]))
        arm.follow(target, 0.1, q, 0.02)
        assert arm.error[0] < 1e-3 and arm.error[1] < 5e-3
    far = T0.copy()
    far[0, 3] += 2.0
    before = arm.q.copy()
    after, _ = arm.follow(far, 0.1, q, 0.02)
    assert (np.abs(after - before) <= robot.velocity * 0.02).all() and arm.error[0] > 0.5


def test_bag_round_trip(opened: Outcome, robot: Robot, tmp_path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra ros")
    from understudy.errors import RecordingError
    from understudy.execution.ros_trajectory import joint_path, read_bag, write_bag

    path = joint_path(opened.trajectory, robot.description)
    write_bag(tmp_path / "bag", path)
    back = read_bag(tmp_path / "bag")
    assert back.names == path.names and "r_elbow_flex_joint" in back.names
    assert np.abs(back.times_s - path.times_s).max() < 1e-8
    assert (back.positions == path.positions).all() and (back.velocities == path.velocities).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag"]
    with pytest.raises(UnderstudyError, match="already"):
        write_bag(tmp_path / "bag", path)
    with pytest.raises(RecordingError, match="bag"):
        read_bag(tmp_path / "none")


@pytest.mark.parametrize(("k", "n"), [(0, 5), (19, 20), (20, 20), (7, 13), (1, 1)])
def test_wilson_interval_is_scipys(k: int, n: int) -> None:
    expected = binomtest(k, n).proportion_ci(method="wilson")
    assert trials.wilson_interval(k, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_trials_resume_and_refuse_foreign_results(
    drawer: ActionModel, opened: Outcome, robot: Robot, platform: Platform, tmp_path, monkeypatch
) -> None:
    skill = Skill(drawer, "drawer", "pr2")
    layouts = trials.setups("drawer", 3, 2)
    assert [s.seed for s in layouts] == [102_000, 102_001, 102_002]
    ran = []

    def fake(model, robot, platform, setup, **more):
        if len(ran) == 2 and setup.seed == 102_002:
            raise KeyboardInterrupt
        ran.append(setup.seed)
        return Outcome(
            setup.seed != 102_001, Reason.OPENED if setup.seed != 102_001 else Reason.LOST, "", 0.95, 0, (), 20.0, (),
            (), 15.0, 1.0, opened.trajectory,
        )  # fmt: skip

    monkeypatch.setattr(trials, "run_trial", fake)
    with pytest.raises(KeyboardInterrupt):
        trials.run_trials(skill, robot, platform, layouts, tmp_path)
    assert len(list(tmp_path.glob("*.json"))) == 2 == len(list(tmp_path.iterdir()))
    ran.append(0)
    rows = trials.run_trials(skill, robot, platform, layouts, tmp_path)
    assert ran == [102_000, 102_001, 0, 102_002] and [r["success"] for r in rows] == [True, False, True]
    text = trials.table(rows)
    assert "2/3" in text and "1 LOST" in text
    other = Skill(scenes.scripted_skill("drawer", 1, 7), "drawer", "pr2")
    with pytest.raises(UnderstudyError, match="another skill"):
        trials.run_trials(other, robot, platform, layouts, tmp_path)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_trials_that_were_killed_go_on(tmp_path) -> None:
    """Killed in the midst of the second: the first is kept as it is, the second is whole, nothing else is left."""
    first, second = (tmp_path / f"drawer-10200{i}.json" for i in (0, 1))
    here = Path(__file__).resolve().parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(here), *sys.path])}
    process = subprocess.Popen([sys.executable, here / "execution_scenes.py", tmp_path, "2"], env=environment)
    deadline = time.monotonic() + 240
    while not first.exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.3)
    process.kill()
    assert process.wait() == -signal.SIGKILL and not second.exists()
    kept = first.stat().st_mtime_ns
    rows = scenes.drawer_trials(tmp_path, 2)
    assert first.stat().st_mtime_ns == kept and rows == [json.loads(p.read_text()) for p in (first, second)]
    assert all(row["success"] for row in rows) and set(tmp_path.iterdir()) == {first, second}


def test_bad_arguments_of_trials() -> None:
    with pytest.raises(UnderstudyError, match="swivel_door"):
        trials.setups("window", 3, 0)
    with pytest.raises(UnderstudyError, match="n must be"):
        trials.setups("drawer", 0, 0)
