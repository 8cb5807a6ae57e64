"""The moving part without markers: exact simulated depth of the four tasks, with a Kinect v2's noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from moving_part_scenes import COLOR, Recording, record

from understudy.camera import Camera
from understudy.errors import FrameError, UnderstudyError
from understudy.geometry import angle_between, inverse, rigid, transform_points
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation, Handle
from understudy.objects.moving_part import HandHint, MovingPart, find_moving_part
from understudy.objects.moving_part.bar import settle_on_bar
from understudy.objects.moving_part.hinge import fit_hinge
from understudy.objects.moving_part.motion import perturbed, spread_frames
from understudy.objects.moving_part.region import telling
from understudy.objects.moving_part.scoring import HIDDEN, Comparison, PartModel, Scorer, point_scores
from understudy.objects.moving_part.search import hand_path, hand_q
from understudy.objects.moving_part.stack import UNIT, DepthStack, Frames, left, person_mask, reference
from understudy.types import RegisteredFrame

N, HZ = 20, 3.2


@cache
def recorded(task: str, seed: int, still: bool = False, passer_by: bool = False) -> Recording:
    return record(task, seed, n=N, hz=HZ, still=still, passer_by=passer_by)


def found(r: Recording, hint: np.ndarray | None = None, frames: Frames | None = None) -> MovingPart:
    hand = HandHint(r.times_s, r.hint if hint is None else hint, np.full(len(r.times_s), 0.05))
    return find_moving_part(r.frames if frames is None else frames, r.people, r.T_world_cam, hand)


@cache
def usual(task: str, seed: int) -> MovingPart:
    return found(recorded(task, seed))


def errors(p: MovingPart, r: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Metres and degrees of every frame."""
    T, truth = p.track.T_world_x, r.T_world_handle
    R = np.einsum("nji,njk->nik", T[:, :3, :3], truth[:, :3, :3])
    angle = np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1), np.degrees(angle)


def assert_recovered(p: MovingPart, r: Recording) -> None:
    truth = r.scene.articulation
    assert p.articulation.kind == truth.kind
    metres, degrees = errors(p, r)
    assert np.percentile(metres, 95) < 0.03 and np.percentile(degrees, 95) < 4
    assert np.degrees(angle_between(p.articulation.direction, truth.direction)) < 3
    assert abs(p.articulation.radius_m - truth.radius_m) < 0.03
    reach = truth.radius_m or 1.0
    assert abs(p.q.max() - r.q.max()) * reach < 0.03
    went = np.flatnonzero(np.abs(np.gradient(r.q)) * reach > 0.01)
    assert abs(p.moving[0] - went[0]) <= 2 and abs(p.moving[1] - went[-1]) <= 2


@pytest.mark.parametrize(("task", "seed"), [("swivel_door", 0), ("drawer", 4), ("sliding_door", 3), ("room_door", 4)])
def test_the_four_tasks_are_recovered(task: str, seed: int) -> None:
    r, p = recorded(task, seed), usual(task, seed)
    assert_recovered(p, r)
    assert p.track.observed.mean() > 0.7
    assert p.quality["evidence_m2"] > 1.5 * p.quality["runner_up_m2"]
    # the part's points lie on the front behind the handle, and stay with it
    assert len(p.part_points) > 100
    assert abs(np.median(p.part_points[:, 0]) + r.scene.handle.standoff_m) < 0.02


def test_covariance_covers_the_errors() -> None:
    r, p = recorded("swivel_door", 0), usual("swivel_door", 0)
    d = p.track.positions - r.T_world_handle[:, :3, 3]
    squares = np.einsum("ni,nij,nj->n", d, np.linalg.inv(p.track.covariance[:, :3, :3]), d)
    assert np.median(squares) < 7.8  # 95 % of a chi square with 3 degrees of freedom
    assert np.linalg.eigvalsh(p.track.covariance).min() > 0


def test_nothing_moves() -> None:
    r = recorded("drawer", 4, still=True)
    p = found(r)
    assert p.articulation.kind == FIXED and p.moving == (0, 0)
    assert np.ptp(p.track.positions, axis=0).max() == 0


class Damaged:
    """Frames of which some cannot be read."""

    def __init__(self, frames: Sequence[RegisteredFrame], bad: set[int]):
        self.frames, self.bad = frames, bad

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int) -> RegisteredFrame:
        if i in self.bad:
            raise FrameError(f"frame {i} is damaged")
        return self.frames[i]


def test_damaged_frames_are_left_out_and_filled_in() -> None:
    r = recorded("drawer", 4)
    bad = {0, 6, 9, 10, 17}
    p = found(r, frames=Damaged(r.frames, bad))
    assert_recovered(p, r)
    assert not p.track.observed[sorted(bad)].any() and p.track.known.all()
    seen = np.setdiff1d(np.arange(N), sorted(bad))
    assert p.sigma_q[[9, 10]].min() > np.median(p.sigma_q[seen])
    with pytest.raises(UnderstudyError, match="no frame"):
        found(r, frames=Damaged(r.frames, set(range(N))))


def test_the_hand_may_be_missing_in_the_middle() -> None:
    r = recorded("swivel_door", 0)
    hint = r.hint.copy()
    hint[8:11] = np.nan
    assert_recovered(found(r, hint), r)


def test_somebody_passes_through() -> None:
    r = recorded("swivel_door", 4, passer_by=True)
    assert_recovered(found(r), r)


def test_bad_input_is_named() -> None:
    r = recorded("drawer", 4)
    hand = HandHint(r.times_s, r.hint, np.full(N, 0.05))
    with pytest.raises(UnderstudyError, match="for each of 20 frames"):
        find_moving_part(r.frames, r.people[:-1], r.T_world_cam, hand)
    with pytest.raises(UnderstudyError, match="T_world_cam"):
        find_moving_part(r.frames, r.people, 2 * r.T_world_cam, hand)
    with pytest.raises(UnderstudyError, match="fewer than 3"):
        found(r, np.full((N, 3), np.nan))
    with pytest.raises(UnderstudyError, match="never near a surface"):
        found(r, r.hint + [0, 0, 9.0])
    with pytest.raises(UnderstudyError, match="increase"):
        replace(hand, times_s=hand.times_s[::-1])


# --- parts ---


_T = rigid(np.eye(3), np.array([0.3, -0.2, 1.0]))
ARTICULATIONS = [
    Articulation(PRISMATIC, _T, np.array([0.6, 0.8, 0]), _T[:3, 3], (0.0, 0.5)),
    Articulation(REVOLUTE, _T, np.array([0, 0, 1.0]), np.array([-0.1, 0.1, 1.0]), (0.0, 1.5)),
]


@pytest.mark.parametrize("a", ARTICULATIONS, ids=lambda a: a.kind)
def test_hand_q_inverts_the_motion(a: Articulation) -> None:
    q = np.linspace(-1.2, 1.2, 9)
    np.testing.assert_allclose(hand_q(a, a.pose(q)[:, :3, 3]), q, atol=1e-12)


@pytest.mark.parametrize("a", ARTICULATIONS, ids=lambda a: a.kind)
def test_perturbations_tilt_and_shift_by_what_they_say(a: Articulation) -> None:
    np.testing.assert_allclose(perturbed(a, np.zeros(4)).direction, a.direction, atol=1e-12)
    tilted = perturbed(a, np.array([0.03, 0.04, 0, 0]))
    assert abs(angle_between(tilted.direction, a.direction) - 0.05) < 1e-9
    if a.kind == REVOLUTE:
        shifted = perturbed(a, np.array([0, 0, 0.03, 0.04]))
        assert abs(np.linalg.norm(shifted.point - a.point) - 0.05) < 1e-9


def test_a_hinge_is_fitted_from_far_off() -> None:
    r, p = recorded("swivel_door", 0), usual("swivel_door", 0)
    truth = r.scene.articulation
    stack = DepthStack.read(r.frames, r.people)
    scorer = Scorer(stack, reference(stack, np.arange(4), r.T_world_cam), r.T_world_cam)
    flat = np.abs(p.part_points[:, 0] - np.median(p.part_points[:, 0])) < 0.01
    normal = p.articulation.T_rest[:3, 0]
    model = PartModel(transform_points(p.articulation.T_rest, p.part_points), flat, normal)
    frames = np.flatnonzero(np.abs(r.q) > 0.1)
    start = perturbed(truth, np.array([0.03, -0.02, 0.06, -0.05]))
    fitted = fit_hinge(scorer, model, start, r.q[frames] + 0.05, frames, 0.008)[0]
    assert np.degrees(angle_between(fitted.direction, truth.direction)) < 1.0
    across = np.cross(fitted.point - truth.point, truth.direction)
    assert np.linalg.norm(np.cross(start.point - truth.point, truth.direction)) > 0.07
    assert np.linalg.norm(across) < 0.01


def test_frames_after_the_hand_has_left_are_used() -> None:
    q = np.concatenate([np.zeros(30), np.linspace(0, 0.3, 5), np.full(20, 0.3)])
    picked = spread_frames(q, np.ones(55, bool), 12)
    assert len(picked) <= 13 and (picked >= 35).sum() >= 4 and (picked < 30).any()


def test_what_stays_is_told_from_what_leaves() -> None:
    r = recorded("swivel_door", 0)
    stack = DepthStack.read(r.frames, r.people)
    ref = reference(stack, np.arange(4), r.T_world_cam)
    gone = left(stack, ref, np.flatnonzero(r.q > 0.9 * r.q.max()))
    center = transform_points(inverse(r.T_world_cam), r.T_world_handle[0, :3, 3])
    u, v = np.round(stack.camera.project(center[None])[0]).astype(int)
    assert gone[v - 2 : v + 3, u - 2 : u + 3].mean() > 0.7
    assert gone[:20].mean() < 0.05  # the wall


# --- the handle's bar ---

CAMERA = Camera(240, 240, np.array([[270.0, 0, 119.5], [0, 270.0, 119.5], [0, 0, 1.0]]))
FRONT, HALF, RADIUS, OUT = 2.0, 0.12, 0.01, 0.05  # metres: distance of the front; bar
# looks straight at the front; the bar's z is up
T_CAM_HANDLE = rigid(np.array([[0, 1.0, 0], [0, 0, -1], [-1, 0, 0]]), np.array([0.04, 0.03, FRONT - OUT]))


def bar_images(hidden: Sequence[tuple[float, float]], hand: Sequence[bool]) -> DepthStack:
    """Depth of a bar before a front. hidden: from where to where (along the bar) a body is before it; hand: whether one
    holds its middle. Nobody is marked.
    """
    v, u = np.mgrid[0:240, 0:240]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    at = rays * (FRONT - OUT) - T_CAM_HANDLE[:3, 3]
    across, along = at[..., 0], -at[..., 1]
    z = np.full((len(hidden), 240, 240), FRONT)
    for image, (low, high), held in zip(z, hidden, hand, strict=True):
        image[(np.abs(across) < RADIUS) & (np.abs(along) < HALF)] = FRONT - OUT - RADIUS
        if held:
            image[(np.abs(across) < 0.045) & (np.abs(along) < 0.045)] = FRONT - OUT - RADIUS
        image[(along > low) & (along < high)] = 1.6
    k = len(z)
    return DepthStack(CAMERA, (z / UNIT).astype(np.uint16), np.zeros(z.shape, bool), np.ones(k, bool))


def settled(stack: DepthStack, along: float, length: float) -> tuple[np.ndarray, Handle]:
    """From a handle that was put `along` metres beside the bar's middle; what it then is in the true handle's frame."""
    T = T_CAM_HANDLE @ rigid(np.eye(3), np.array([0.008, -0.006, along]))
    k = len(stack)
    still = Articulation(PRISMATIC, T, T[:3, 0], T[:3, 3], (0.0, 0.0))
    T, handle = settle_on_bar(stack, np.eye(4), still, np.zeros(k), np.arange(k), T, Handle(length, 0.006, OUT + 0.008))
    return (inverse(T_CAM_HANDLE) @ T)[:3, 3], handle


def test_a_bar_is_put_together_from_what_each_frame_shows() -> None:
    hidden = [(-1.0, 0.03)] * 5 + [(-0.04, 1.0)] * 4  # no frame shows more than half of it
    at, handle = settled(bar_images(hidden, [False] * 9), along=0.045, length=0.1)
    assert np.abs(at).max() < 0.006
    assert abs(handle.length_m - 2 * HALF) < 0.012 and abs(handle.radius_m - RADIUS) < 0.004
    assert abs(handle.standoff_m - OUT) < 0.006


def test_a_hand_on_the_bar_is_no_bar() -> None:
    at, handle = settled(bar_images([(2.0, 2.0)] * 8, [True] * 8), along=-0.03, length=0.16)
    assert np.abs(at).max() < 0.006 and abs(handle.length_m - 2 * HALF) < 0.012
    assert abs(handle.radius_m - RADIUS) < 0.004


def test_an_end_that_nobody_saw_is_in_doubt_by_as_much_as_is_hidden() -> None:
    at, handle = settled(bar_images([(0.08, 0.16)] * 8, [False] * 8), along=0.0, length=0.16)
    low, high = at[2] - handle.length_m / 2, at[2] + handle.length_m / 2
    assert abs(low + HALF) < 0.01 and 0.08 < high < 0.16


def test_without_a_bar_the_handle_stays() -> None:
    at, handle = settled(bar_images([(-1.0, 1.0)] * 6, [False] * 6), along=0.02, length=0.1)
    np.testing.assert_allclose(at, [0.008, -0.006, 0.02], atol=1e-12)
    assert handle.length_m == 0.1


def test_the_ends_of_a_sliding_front_tell_where_it_is() -> None:
    y, z = (g.ravel() for g in np.meshgrid(np.linspace(0, 0.8, 41), np.linspace(0, 1.5, 76)))
    front = np.column_stack([np.zeros_like(y), y, z])
    handle = np.array([[-0.04, 0.4, 0.9], [-0.04, 0.4, 0.95]])
    model = PartModel(np.vstack([front, handle]), np.arange(len(y) + 2) < len(y), np.array([-1.0, 0, 0]))
    slides = Articulation(PRISMATIC, np.eye(4), np.array([0, 1.0, 0]), np.zeros(3), (0.0, 0.5))
    told = telling(model, slides)
    inner = told.points[told.flat][:, 1]
    assert ((inner < 0.0601) | (inner > 0.7399)).all() and (inner == 0).sum() == (inner == 0.8).sum() == 76
    np.testing.assert_array_equal(told.points[~told.flat], handle)
    pulled = replace(slides, direction=np.array([-1.0, 0, 0]))
    assert telling(model, pulled) is model  # all of a drawer's front tells


def test_a_part_gains_nothing_by_hiding_behind_people() -> None:
    yes, no = np.ones((1, 3), bool), np.zeros((1, 3), bool)
    there = Comparison(np.zeros((1, 3), np.float32), yes, no, yes, no)  # found, where a person may be
    behind = replace(there, gap=np.full((1, 3), 0.5, np.float32))
    assert point_scores(there, 0.01, hidden=HIDDEN).mean() >= point_scores(behind, 0.01, hidden=HIDDEN).mean()
    assert point_scores(there, 0.01).max() == 0  # says nothing about which points move
    beyond = replace(there, gap=np.full((1, 3), -0.5, np.float32))
    np.testing.assert_allclose(point_scores(beyond, 0.01, hidden=HIDDEN), -1, atol=1e-6)


def test_hand_path_bridges_gaps_with_doubt_and_drops_outliers() -> None:
    times = np.arange(20) * 0.1
    truth = np.column_stack([times, 2 * times, 0 * times])
    measured = truth.copy()
    measured[6] += 1.0
    measured[10:14] = np.nan
    path = hand_path(times, measured, np.full(20, 0.05))
    assert (
        np.abs(path.positions - truth)[2:-2].max() < 0.25
    )  # a running median of 5 lags where a line is bent by an outlier
    assert not path.known[10:14].any() and (path.sigma_m[10:14] > path.sigma_m[9]).all()


def test_the_depth_stack_keeps_depth_and_masks_people() -> None:
    r = recorded("swivel_door", 0)
    stack = DepthStack.read(r.frames[:2], r.people[:2])
    z = r.frames[0].depth.z[: 2 * stack.z.shape[1], : 2 * stack.z.shape[2]]
    blocks = np.where(z > 0, z, np.inf).reshape(stack.z.shape[1], 2, stack.z.shape[2], 2).min(axis=(1, 3))
    some = np.isfinite(blocks)
    assert ((stack.z[0] > 0) == some).all()
    assert np.abs(stack.z[0][some] * UNIT - blocks[some]).max() < 0.0003
    joints = transform_points(inverse(r.T_world_cam), r.joints[0])
    uv = np.round(stack.camera.project(joints[[1, 8, 11]])).astype(int)  # neck and hips
    assert all(stack.person[0][v, u] for u, v in uv)
    assert 0.01 < stack.person[0].mean() < 0.3
    assert not person_mask(stack.camera, stack.z[0] * UNIT, []).any()
    assert COLOR.width == 2 * stack.camera.width
