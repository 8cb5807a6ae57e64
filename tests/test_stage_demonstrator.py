"""The stage's demonstrator: exact truth, a hand that stays on the handle, and a body that moves as bodies can."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest

from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError
from understudy.geometry import inverse, transform_points
from understudy.skeleton import JOINT
from understudy.stage.furniture import sample_furniture
from understudy.stage.kinematics import about, apply, forward, middle_joint, twist_angle, unit

pytest.importorskip("torch", reason="bodies need torch")
pytest.importorskip("anny", reason="bodies need anny")

from understudy.stage.body import SOLE, draw_body
from understudy.stage.demonstrator import Performance, perform, performance_of
from understudy.stage.markers import hand_markers, torso_markers
from understudy.stage.motion import plan_motion
from understudy.stage.motion_profiles import Clock, draw_clock, ease
from understudy.stage.motion_space import Space

SEEDS = (0, 1)
CASES = [*((task, 0) for task in TASKS), ("room_door", 1), ("swivel_door", 1)]
LIMBS = [("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")]


@cache
def played(task: str, seed: int) -> Performance:
    """Without a mesh, so that it is quick."""
    return performance_of(plan_motion(draw_body(seed).skeleton, sample_furniture(task, seed), seed), 20.0)


@cache
def seen() -> Performance:
    return perform(sample_furniture("drawer", 3), 3, 5.0)


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_the_hand_stays_on_the_handle(task: str, seed: int) -> None:
    p = played(task, seed)
    held = slice(p.segments.grasp, p.segments.release)
    T_world_handle = sample_furniture(task, seed).articulation.pose(p.q[held])
    T = np.linalg.inv(T_world_handle) @ p.T_world_hand[p.acting][held]
    assert len(T) > 20
    assert np.linalg.norm(T[:, :3, 3] - p.T_handle_hand[:3, 3], axis=1).max() < 0.002
    assert np.abs(T[:, :3, :3] - p.T_handle_hand[:3, :3]).max() < 0.005
    # and the bar lies before the palm, fingers across it
    bar = transform_points(inverse(p.T_handle_hand), np.zeros(3))
    assert 0.015 < bar[2] < 0.06 and abs(p.T_handle_hand[:3, 1] @ (0, 0, 1)) > 0.85


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_the_part_moves_only_while_it_is_held(task: str, seed: int) -> None:
    p, furniture = played(task, seed), sample_furniture(task, seed)
    assert (np.diff(p.q) >= -1e-12).all()
    assert p.q[0] == 0 and p.q[-1] == pytest.approx(furniture.open_to)
    assert p.q[p.segments.grasp] == 0 and p.q[p.segments.release - 1] == pytest.approx(furniture.open_to)
    handle = furniture.articulation.pose(p.q)[:, :3, 3]
    speed = np.linalg.norm(np.diff(handle, axis=0), axis=1) * 20
    assert 0.15 < speed.max() < 0.8
    assert 5.0 < p.times_s[-1] < 14.0


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_a_body_is_rigid_and_within_its_limits(task: str, seed: int) -> None:
    p = played(task, seed)
    for side, (start, end) in itertools.product(("left", "right"), LIMBS):
        bone = np.linalg.norm(p.joints[:, JOINT[f"{side}_{end}"]] - p.joints[:, JOINT[f"{side}_{start}"]], axis=1)
        assert np.ptp(bone) < 1e-6 and 0.15 < bone[0] < 0.55
    for side in ("left", "right"):
        s, e, w = (p.joints[:, JOINT[f"{side}_{name}"]] for name in ("shoulder", "elbow", "wrist"))
        bend = np.arccos(np.sum(unit(e - s) * unit(w - e), axis=1).clip(-1, 1))
        wrist = np.arccos(np.sum(unit(w - e) * p.T_world_hand[side][:, :3, 0], axis=1).clip(-1, 1))
        assert np.degrees(bend).max() < 150 and np.degrees(wrist).max() < 70
    speed = np.linalg.norm(np.diff(p.joints, axis=0), axis=2).max(1) * 20
    assert speed.max() < 3.5  # of a swinging foot, at most
    hand = np.linalg.norm(np.diff(p.T_world_hand[p.acting][:, :3, 3], axis=0), axis=1) * 20
    assert hand.max() < 2.5
    chest = np.linalg.norm(np.diff(p.torso_xy_yaw[:, :2], axis=0), axis=1) * 20
    assert chest.max() < 1.3


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_feet_stand_or_swing(task: str, seed: int) -> None:
    p = played(task, seed)
    rest = draw_body(seed).skeleton
    heights, slides = [], []
    for side in ("left", "right"):
        ankle = p.joints[:, JOINT[f"{side}_ankle"]]
        up = ankle[:, 2] - rest.head("foot", side)[2] - SOLE
        heights.append(up)
        stands = (up[1:] < 0.002) & (up[:-1] < 0.002)
        slides.append(np.linalg.norm(np.diff(ankle[:, :2], axis=0), axis=1)[stands])
        assert stands.any() and not stands.all()
    assert np.minimum(*heights).max() < 0.012 and min(up.min() for up in heights) > -1e-6
    assert max(s.max() for s in slides) < 0.03


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_nobody_is_inside_the_furniture(task: str, seed: int) -> None:
    p = played(task, seed)
    gap = Space(sample_furniture(task, seed)).distance(p.joints, p.q)
    assert gap.min() > 0
    trunk = [JOINT[name] for name in ("neck", "left_hip", "right_hip", "nose")]
    assert gap[:, trunk].min() > 0.06


def test_the_door_is_walked_through() -> None:
    for seed in SEEDS:
        p = played("room_door", seed)
        assert p.torso_xy_yaw[0, 0] < -0.8 and p.torso_xy_yaw[-1, 0] > 0.6
        assert abs(p.torso_xy_yaw[-1, 2]) < 0.6


def test_the_same_seed_makes_the_same() -> None:
    skeleton, furniture = draw_body(0).skeleton, sample_furniture("drawer", 0)
    first = played("drawer", 0)
    again, other = (performance_of(plan_motion(skeleton, furniture, seed), 20.0) for seed in (0, 1))
    assert np.array_equal(first.joints, again.joints) and np.array_equal(first.q, again.q)
    assert len(other) != len(first) or not np.allclose(first.joints, other.joints)


def test_frame_rates_sample_one_motion() -> None:
    p = played("drawer", 0)
    slow = performance_of(p.motion, 10.0)
    assert np.allclose(slow.joints, p.joints[::2][: len(slow)], atol=1e-9)
    with pytest.raises(UnderstudyError, match="fps"):
        perform(sample_furniture("drawer", 0), 0, fps=0)


def test_the_mesh_goes_with_the_truth() -> None:
    p = seen()
    names = [piece.name for piece in p.pieces]
    assert {"skin", "face", "eyes", "hair", "shirt", "trousers"} <= set(names)
    assert sum(len(v) for v in p.vertices(0)) < 28_000
    for i in range(0, len(p), len(p) // 4):
        mesh = dict(zip(names, p.vertices(i), strict=True))
        eyes = (p.joints[i, JOINT["left_eye"]] + p.joints[i, JOINT["right_eye"]]) / 2
        assert np.linalg.norm(mesh["eyes"].mean(0) - eyes) < 0.02
        for side, near in itertools.product(("left", "right"), ("wrist", "shoulder", "knee")):
            cloth = {"wrist": "skin", "shoulder": "shirt", "knee": "trousers"}[near]
            gap = np.linalg.norm(mesh[cloth] - p.joints[i, JOINT[f"{side}_{near}"]], axis=1)
            assert 0.005 < gap.min() < 0.10
        lowest = min(v[:, 2].min() for v in mesh.values())
        assert -0.02 < lowest < 0.01
    for piece, v in zip(p.pieces, p.vertices(0), strict=True):
        assert piece.faces.min() == 0 and piece.faces.max() == len(v) - 1
        assert (piece.texture is None) == (piece.uv is None)
        if piece.uv is not None:
            assert piece.uv.shape == (len(v), 2) and piece.uv.min() >= 0 and piece.uv.max() <= 1


def test_surfaces_face_outward() -> None:
    p = seen()
    for piece, v in zip(p.pieces, p.vertices(0), strict=True):
        a, b, c = (v[piece.faces[:, k]].astype(np.float64) for k in range(3))
        normal = np.cross(b - a, c - a)
        if piece.name in ("face", "eyes"):  # open ones: they look where the chest looks, more or less
            yaw = p.torso_xy_yaw[0, 2]
            assert normal.sum(0) @ (np.cos(yaw), np.sin(yaw), 0) > 0
        else:
            assert np.sum((a - v.mean(0)) * normal) > 0, piece.name


def test_markers_are_outside_and_look_away() -> None:
    """No plate is in the body (but for long hair), each looks away from it, and the hand's are near the hand."""
    p = seen()
    markers = [*hand_markers(p.acting), *torso_markers()]
    for i in (0, p.segments.grasp, p.segments.release, len(p) - 1):
        body = np.concatenate(p.vertices(i)).astype(np.float64)
        for marker in markers:
            T_marker_frame = marker.T_marker_frame
            middle = np.mean([inverse(m.T_marker_frame)[:3, 3] for m in markers if m.on == marker.on], axis=0)
            assert transform_points(T_marker_frame, middle[None])[0, 2] < 1e-9
            local = transform_points(T_marker_frame @ inverse(p.carriers(i)[marker.on]), body)
            half = marker.size_m / 2
            through = (np.abs(local[:, :2]) < half).all(axis=1) & (np.abs(local[:, 2]) < 0.01)
            assert not through.any(), (marker.id, i)
            assert np.linalg.norm(local, axis=1).min() < 0.2
    rear = inverse(torso_markers()[0].T_marker_frame)[:3, 2]
    heading = p.torso_xy_yaw[0, 2]
    assert (p.carriers(0)["torso"][:3, :3] @ rear)[:2] @ (np.cos(heading), np.sin(heading)) < -0.8


def test_limbs_reach_or_point_there() -> None:
    rng = np.random.default_rng(0)
    start, goal, pole = rng.normal(size=(3, 200, 3)) * 0.4
    middle, end = middle_joint(start, goal, (0.31, 0.25), pole)
    assert np.allclose(np.linalg.norm(middle - start, axis=1), 0.31) and np.allclose(
        np.linalg.norm(end - middle, axis=1), 0.25
    )
    distance = np.linalg.norm(goal - start, axis=1)
    within = (distance < 0.55) & (distance > 0.07)
    assert within.sum() > 20 and np.allclose(end[within], goal[within])
    assert np.allclose(np.cross(unit(end - start), unit(goal - start)), 0, atol=1e-9)
    assert (np.sum((middle - start) * (pole - start * 0), axis=1)[within] > -0.32).all()


def test_twist_and_forward_kinematics() -> None:
    rng = np.random.default_rng(1)
    axis, angle = unit(rng.normal(size=(50, 3))), rng.uniform(-3, 3, 50)
    assert np.allclose(twist_angle(about(axis, angle), axis), angle)
    square = unit(np.cross(axis, rng.normal(size=(50, 3))))
    swing = about(square, rng.uniform(-1, 1, 50))
    assert np.allclose(twist_angle(swing @ about(axis, angle), axis), angle)
    heads = rng.normal(size=(3, 3))
    R, p = forward((-1, 0, 1), heads, {1: about(axis, angle)}, np.zeros((50, 3)))
    assert np.allclose(p[:, 1], heads[1] - heads[0])
    assert np.allclose(p[:, 2] - p[:, 1], apply(R[:, 1], np.tile(heads[2] - heads[1], (50, 1))))


def test_the_clock_runs_forward() -> None:
    for seed in range(50):
        clock = draw_clock(np.random.default_rng(seed), 0.9, 0.5, 0.5)
        assert isinstance(clock, Clock)
        moments = [clock.walk, clock.reach, clock.grasp, clock.move, *clock.pause, clock.stop, clock.release]
        assert (np.diff([*moments, clock.leave, clock.rest, clock.end]) >= 0).all()
        times = np.linspace(0, clock.end, 400)
        share = clock.progress(times)
        assert (np.diff(share) >= 0).all() and share[0] == 0 and share[-1] == 1
        assert (share[times <= clock.move] == 0).all() and np.allclose(share[times >= clock.stop], 1)
    s = np.linspace(0, 1, 101)
    assert np.allclose(ease(s) + ease(1 - s), 1)
