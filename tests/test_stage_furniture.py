"""Furniture of the stage: human sizes, joints that move as the articulation says, friction that holds."""

from __future__ import annotations

import numpy as np
import pytest

from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError
from understudy.stage.furniture import Furniture, sample_furniture

mujoco = pytest.importorskip("mujoco", reason="the extra 'stage' is not installed")

from understudy.stage.mechanism import HANDLE, PART, add_furniture, mjcf, pose_of  # noqa: E402
from understudy.stage.truth import furniture_to_json  # noqa: E402


def simulated(furniture: Furniture) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    add_furniture(spec, furniture, "f/")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def grip_speed(furniture: Furniture) -> np.ndarray:
    """How the closed handle sets off: metres per unit of q."""
    a, b = furniture.articulation.pose(np.array([0.0, 1e-6]))[:, :3, 3]
    return (b - a) / 1e-6


@pytest.mark.parametrize("task", TASKS)
def test_furniture_has_human_sizes(task: str) -> None:
    limits = {
        "room_door": {"width": (0.80, 0.95), "height": (1.94, 2.10), "handle": (0.95, 1.10), "range": (1.5, 1.8)},
        "swivel_door": {"width": (0.30, 0.55), "height": (0.40, 0.90), "handle": (0.70, 1.40), "range": (1.6, 2.0)},
        "drawer": {"width": (0.35, 0.80), "height": (0.12, 0.25), "handle": (0.55, 1.00), "range": (0.25, 0.45)},
        "sliding_door": {"width": (0.45, 0.95), "height": (1.0, 2.1), "handle": (0.80, 1.30), "range": (0.35, 0.70)},
    }[task]
    hinges, knobs = set(), 0
    for seed in range(200):
        f = sample_furniture(task, seed)
        _, width, height = 2 * np.array(f.panel.half_m)
        seen = {
            "width": width,
            "height": height,
            "handle": f.articulation.T_rest[2, 3],
            "range": f.articulation.range[1],
        }
        for name, (low, high) in limits.items():
            assert low <= seen[name] <= high, (seed, name, seen[name])
        assert f.articulation.range[0] == 0 and 0.55 * f.articulation.range[1] <= f.open_to <= f.articulation.range[1]
        assert 0.005 <= f.handle.radius_m <= 0.017 and 0.03 < f.handle.standoff_m < 0.08
        assert all(min(box.half_m) > 0 for box in (f.panel, *f.parts, *f.blocks))
        assert all(box.T_frame_box[2, 3] - box.half_m[2] > -1e-9 for box in f.blocks), "below the floor"
        hinges.add(np.sign(f.articulation.direction @ (0, 1, 1)))
        knobs += f.handle.length_m < 0.05
    assert hinges == ({0.0} if task == "drawer" else {-1.0, 1.0}), "both hands must get their turn"
    assert knobs == 0 if task == "room_door" else 10 < knobs < 80


@pytest.mark.parametrize("task", TASKS)
def test_handle_frame_keeps_the_convention_and_is_free_to_grasp(task: str) -> None:
    for seed in range(40):
        f = sample_furniture(task, seed)
        T = f.articulation.T_rest
        np.testing.assert_allclose(T[:3, 0], (-1, 0, 0))  # out of the front, to the person
        up = T[:3, 2] if abs(T[2, 2]) > 0.5 else T[:3, 1]
        np.testing.assert_allclose(up, (0, 0, 1))
        front = T[0, 3] + f.handle.standoff_m
        np.testing.assert_allclose((front, T[1, 3]), (0, 0), atol=1e-12)
        speed = grip_speed(f)
        assert {"room_door": speed[0] > 0.5, "sliding_door": abs(speed[1]) > 0.99}.get(task, speed[0] < -0.25)
        for box in (*f.blocks, *f.moving(0.0)):  # nothing within a hand's reach before the front, but the door's frame
            low, high = box.T_frame_box[:3, 3] - box.half_m, box.T_frame_box[:3, 3] + box.half_m
            assert low[0] > -0.005 or np.maximum(low[1:] - T[1:3, 3], T[1:3, 3] - high[1:]).max() > 0.05


@pytest.mark.parametrize("task", TASKS)
def test_joint_moves_the_handle_as_the_articulation_says(task: str) -> None:
    for seed in range(6):
        f = sample_furniture(task, seed)
        model, data = simulated(f)
        for q in np.linspace(*f.articulation.range, 7):
            data.joint(f"f/{PART}").qpos[0] = q
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(pose_of(data, f"f/{PART}"), f.articulation.pose(np.array([q]))[0], atol=1e-9)
            assert data.ncon == 0, [(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact]
        bar = data.geom(f"f/{HANDLE}")
        np.testing.assert_allclose(bar.xpos, data.body(f"f/{PART}").xpos, atol=1e-9)


def pulled(f: Furniture, model: mujoco.MjModel, data: mujoco.MjData, force: float, seconds: float) -> float:
    """q after a force (newtons) on the handle, along its way."""
    body = model.body(f"f/{PART}").id
    mujoco.mj_resetData(model, data)
    while data.time < seconds:
        a, b = f.articulation.pose(data.qpos[0] + np.array([0, 1e-6]))[:, :3, 3]
        data.qfrc_applied[:] = 0
        pull = force * (b - a) / np.linalg.norm(b - a)
        mujoco.mj_applyFT(model, data, pull, np.zeros(3), data.xpos[body], body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    return float(data.qpos[0])


@pytest.mark.parametrize("task", TASKS)
def test_friction_holds_a_pull_opens_and_limits_stop(task: str) -> None:
    for seed in range(2):
        f = sample_furniture(task, seed)
        model, data = simulated(f)
        most = f.articulation.range[1]
        threshold = (f.dynamics.friction + f.dynamics.preload) / (f.articulation.radius_m or 1.0)
        assert abs(pulled(f, model, data, 0.7 * threshold, 1.0)) < 0.01 * most
        assert 0.9 * most < pulled(f, model, data, 4 * threshold + 15, 3.0) < 1.03 * most


def test_door_closer_closes() -> None:
    f = next(f for f in (sample_furniture("room_door", s) for s in range(50)) if f.dynamics.preload > 2.6)
    assert f.dynamics.preload > f.dynamics.friction
    model, data = simulated(f)
    data.qpos[0] = 1.0
    while data.time < 8:
        mujoco.mj_step(model, data)
    assert data.qpos[0] < 0.02
    assert f.dynamics.mass_kg < model.body_mass.sum() < f.dynamics.mass_kg + 0.2


def test_furniture_is_a_function_of_its_seed() -> None:
    same, again, other = (furniture_to_json(sample_furniture("drawer", seed)) for seed in (3, 3, 4))
    assert same == again != other
    assert f'name="{PART}"' in mjcf(sample_furniture("drawer", 3))
    with pytest.raises(UnderstudyError, match="'fridge'.*'drawer'"):
        sample_furniture("fridge", 0)
