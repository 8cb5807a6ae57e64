"""The simulated robot obeys physics: it holds its pose, follows its targets, opens by friction only."""

from __future__ import annotations

import numpy as np
import pytest

for name in ("mujoco", "pinocchio", "numba"):
    pytest.importorskip(name, reason="needs the extras robot and stage")

from understudy import lie  # noqa: E402
from understudy.errors import MissingExtraError, UnderstudyError  # noqa: E402
from understudy.robot.model import Robot, load_robot  # noqa: E402
from understudy.robot.simulator import Noise, Simulator, Targets  # noqa: E402
from understudy.robot.simulator_video import contact_sheet, write_video  # noqa: E402
from understudy.stage.furniture import sample_furniture  # noqa: E402

START = np.array([-1.6, 0.1, 0.2])


@pytest.fixture(scope="module")
def robot() -> Robot:
    try:
        return load_robot("pr2")
    except MissingExtraError as e:
        pytest.skip(f"no robot: {e}")


def held(simulator: Simulator) -> Targets:
    state = simulator.state()
    return Targets(state.base, state.q, state.torso, 0.05)


def test_the_model_has_the_kinematics_of_the_robot(robot: Robot) -> None:
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=START, torso_start=0.1)
    state = simulator.state()
    expected = lie.se2_to_se3(START[None])[0] @ robot.forward(state.q[None], np.array([0.1]))[0]
    assert np.abs(state.T_world_tool - expected).max() < 1e-6


def test_holds_its_pose_against_gravity(robot: Robot) -> None:
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=START)
    before = simulator.state()
    simulator.step(held(simulator), 1.0)
    after = simulator.state()
    assert np.abs(after.q - before.q).max() < 1e-3 and abs(after.torso - before.torso) < 1e-3
    assert np.abs(after.base - before.base).max() < 1e-3 and np.abs(after.q_velocity).max() < 1e-3


def test_follows_moving_targets_without_lag(robot: Robot) -> None:
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=START)
    start, v, w = simulator.state(), np.array([-0.2, 0.1, 0.3]), 0.3 * np.ones(robot.n)
    for k in range(50):
        t = 0.02 * k
        simulator.step(Targets(start.base + t * v, start.q + t * w, start.torso, 0.0, v, w), 0.02)
    state = simulator.state()
    assert np.abs(state.base - (start.base + v)).max() < 2e-3
    assert np.abs(state.q - (start.q + w)).max() < 5e-3


def test_fingers_open_evenly_and_to_the_width_asked_for(robot: Robot) -> None:
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=START)
    simulator.step(held(simulator), 1.0)
    T = np.linalg.inv(simulator.state().T_world_tool)
    pads = [T[:3, :3] @ simulator.data.geom(f"pad{i}").xpos + T[:3, 3] for i in (0, 1)]
    thickness = 2 * simulator.model.geom("pad0").size[1]
    assert abs(pads[0][1] + pads[1][1]) < 1e-3
    assert abs(pads[0][1] - pads[1][1]) == pytest.approx(0.05 + thickness, abs=4e-3)  # linear in the joint, nearly


@pytest.mark.parametrize("task", ["drawer", "swivel_door"])
def test_furniture_yields_to_more_than_its_friction_only(robot: Robot, task: str) -> None:
    furniture = sample_furniture(task, 3)
    simulator = Simulator(robot, furniture, seed=0, base_start=START)
    dof = simulator.model.joint("part").dofadr[0]
    targets = held(simulator)
    simulator.data.qfrc_applied[dof] = 0.6 * furniture.dynamics.friction
    simulator.step(targets, 0.5)
    assert abs(simulator.opened) < 4e-3  # dry friction is a soft constraint: it creeps
    simulator.data.qfrc_applied[dof] = 3 * furniture.dynamics.friction
    simulator.step(targets, 0.5)
    assert simulator.opened > 0.02


def test_measurements_have_the_noise_that_is_said(robot: Robot) -> None:
    furniture = sample_furniture("drawer", 0)
    simulator = Simulator(robot, furniture, seed=5, base_start=START, noise=Noise())
    inverse = np.linalg.inv(simulator.T_world_handle)
    near = lie.se3_log(np.array([inverse @ simulator.measured_handle_pose(near=True) for _ in range(2000)]))
    assert np.sqrt((near[:, :3] ** 2).sum(axis=1).mean()) == pytest.approx(0.005, rel=0.05)
    assert np.degrees(np.sqrt((near[:, 3:] ** 2).sum(axis=1).mean())) == pytest.approx(1.0, rel=0.05)
    # from afar, one error for all measurements of a trial
    far = np.array([inverse @ simulator.measured_handle_pose() for _ in range(200)])
    constant = lie.se3_log(far).mean(axis=0)
    others = []
    for seed in range(200):
        other = object.__new__(Simulator)
        other._rng, other._noise = np.random.default_rng([seed, 20817]), Noise()
        others.append(lie.se3_log(other._disturbance(*Noise().localisation)[None])[0])
    spread = np.sqrt((np.array(others)[:, :3] ** 2).sum(axis=1).mean())
    assert spread == pytest.approx(0.02, rel=0.15)
    assert np.linalg.norm(constant[:3]) > 3 * 0.003 / np.sqrt(200)


def test_touching_furniture_is_reported(robot: Robot) -> None:
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=np.array([-0.45, 0, 0.0]))
    state = simulator.state()
    touch = simulator.step(Targets(state.base + [0.3, 0, 0], state.q, state.torso, 0.0), 1.0)
    assert any(link == "base_link" for link, _ in touch.unwanted)
    assert simulator.state().base[0] < -0.2  # and it does not go through


def test_same_seed_same_world(robot: Robot) -> None:
    ends = []
    for _ in range(2):
        simulator = Simulator(robot, sample_furniture("sliding_door", 2), seed=9, base_start=START)
        simulator.step(held(simulator), 0.3)
        ends.append(np.concatenate([simulator.data.qpos, simulator.measured_handle_pose().ravel()]))
    assert (ends[0] == ends[1]).all()


def test_bad_start_is_refused(robot: Robot) -> None:
    with pytest.raises(UnderstudyError, match="base_start"):
        Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=np.array([np.nan, 0, 0]))
    simulator = Simulator(robot, sample_furniture("drawer", 0), seed=0, base_start=START)
    with pytest.raises(UnderstudyError, match="render=True"):
        simulator.frame()


def test_pictures_show_the_robot_and_make_a_video(robot: Robot, tmp_path) -> None:
    furniture = sample_furniture("drawer", 0)
    try:
        simulator = Simulator(robot, furniture, seed=0, base_start=START, render=True)
    except UnderstudyError as e:
        pytest.skip(f"no OpenGL: {e}")
    with simulator:
        simulator.step(held(simulator), 0.25)
        video = simulator.video
        assert video is not None and len(video.frames) >= 2
        here = simulator.frame()
        state = simulator.state()
        simulator.step(Targets(state.base - [0.5, 0, 0], state.q, state.torso, 0.0), 1.0)
        gone = simulator.frame()
    changed = (np.abs(here.astype(int) - gone.astype(int)).max(axis=2) > 30).mean()
    assert 0.02 < changed < 0.6
    assert contact_sheet([here, gone], columns=2).shape == (here.shape[0], 2 * here.shape[1], 3)
    imageio = pytest.importorskip("imageio_ffmpeg", reason="needs imageio-ffmpeg")
    write_video(tmp_path / "a.mp4", [here, gone, here])
    count, seconds = imageio.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert count == 3 and list(tmp_path.iterdir()) == [tmp_path / "a.mp4"] and seconds > 0
