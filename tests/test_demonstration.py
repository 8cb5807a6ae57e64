"""Segments, clock, alignment, map and storage of demonstrations, against what is known exactly."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from demonstration_scenes import camera, cast, door_demonstration, minimum_jerk, to_cam
from scipy.spatial.transform import Rotation

from understudy.demonstration import clock, storage
from understudy.demonstration.actor import in_question, reaching_hands
from understudy.demonstration.alignment import align, on_floor, phase
from understudy.demonstration.demonstration import FREE, OCCUPIED, UNKNOWN, Demonstration, Segments
from understudy.demonstration.known_motion import part_points
from understudy.demonstration.object_track import untouched
from understudy.demonstration.scene_map import RESOLUTION, Sweep, View, occupancy, static_scene
from understudy.demonstration.segments import MOVING, find_segments, measure_motion
from understudy.errors import RecordingError, UnderstudyError
from understudy.floor import find_floor, world_from_camera
from understudy.geometry import rigid, transform_points
from understudy.skeleton import BONES, JOINT
from understudy.tracking import PersonTrack
from understudy.trajectories import PlanarTrack, PoseTrack
from understudy.types import RegisteredDepth
from understudy.voxels import cloud

RATE = 10.0


# segments


def motion(begin: float, end: float, way: float, until: float, pause: tuple[float, float] | None = None):
    """Times and way of a handle, and the seconds between which it is faster than MOVING (pauses included)."""
    fine = np.arange(0, until, 0.001)
    s = (fine - begin) / (end - begin)
    if pause is not None:  # stands still for a while in the middle, having slowed down for it
        at, seconds = pause
        first = way * at * minimum_jerk((fine - begin) / ((end - begin) * at))
        second = (
            way * (1 - at) * minimum_jerk((fine - begin - (end - begin) * at - seconds) / ((end - begin) * (1 - at)))
        )
        path = first + second
    else:
        path = way * minimum_jerk(s)
    moving = fine[1:][np.abs(np.diff(path)) / 0.001 > MOVING]
    times = np.arange(0, until, 1 / RATE)
    return times, np.interp(times, fine, path), (moving[0], moving[-1])


@pytest.mark.parametrize("pause", [None, (0.4, 0.8), (0.6, 1.5)])
def test_segments_of_noisy_motions_are_within_three_tenths_of_a_second(pause):
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(60):
        begin, length = rng.uniform(1.5, 3.5), rng.uniform(1.6, 4.5)
        way = rng.uniform(0.2, 0.9)
        rest = 0.0 if pause is None else pause[1]
        times, path, truth = motion(begin, begin + length, way, begin + length + rest + rng.uniform(1.5, 3), pause)
        noisy = path + rng.normal(0, 0.004, len(path))
        noisy[rng.random(len(path)) < 0.08] = np.nan
        apart = np.where((times > begin - 0.3) & (times < begin + length + rest + 0.3), 0.08, 0.5)
        found = find_segments(times, noisy, apart)
        errors.append([times[found.grasp] - truth[0], times[min(found.release, len(times) - 1)] - truth[1]])
    errors = np.abs(errors)
    assert (errors <= 0.3).mean() >= 0.97, np.sort(errors.ravel())[-6:]
    assert np.median(errors) < 0.12


def test_a_part_that_swings_on_alone_is_released_when_the_hand_leaves():
    times, path, _ = motion(2, 6, 0.8, 9)
    apart = np.where(times < 4, 0.07, 0.07 + 0.6 * np.clip(times - 4, 0, 1))
    found = find_segments(times, path, apart)
    assert 4.0 <= times[found.release] <= 4.6


def test_a_hand_that_is_not_seen_decides_nothing():
    times, path, truth = motion(2, 5, 0.4, 8)
    apart = np.where(times < 3, 0.07, np.nan)
    assert find_segments(times, path, apart) == find_segments(times, path)
    assert times[find_segments(times, path).release] == pytest.approx(truth[1], abs=0.2)


def test_one_wrong_sighting_of_the_hand_does_not_end_the_manipulation():
    times, path, truth = motion(2, 5, 0.4, 8)
    apart = np.full(len(times), 0.07)
    apart[35:37] = 0.9
    assert times[find_segments(times, path, apart).release] == pytest.approx(truth[1], abs=0.2)


def test_nothing_moves():
    times = np.arange(0, 6, 0.1)
    noise = np.random.default_rng(0).normal(0, 0.003, len(times))
    with pytest.raises(UnderstudyError, match="does not move"):
        find_segments(times, noise)
    with pytest.raises(UnderstudyError, match="never seen"):
        find_segments(times, np.full(len(times), np.nan))


def test_speed_of_a_steady_motion_is_exact_also_with_gaps_and_at_the_ends():
    times = np.arange(0, 4, 0.1)
    way = 0.25 * times + 0.1
    way[[3, 4, 20]] = np.nan
    measured = measure_motion(times, way)
    np.testing.assert_allclose(measured.way_m, 0.25 * times + 0.1, atol=1e-3)
    np.testing.assert_allclose(measured.speed, 0.25, atol=3e-3)


def test_segments_refuse_what_is_empty():
    with pytest.raises(UnderstudyError, match="grasp < release"):
        Segments(5, 5)


# clock


def track(t: int, seed: int = 0) -> PoseTrack:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (t, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 1, t)[:, None] * [0.3, 1.2, -0.4]).as_matrix()
    T[:, :3, 3] = np.cumsum(rng.normal(0, 0.01, (t, 3)), axis=0)
    return PoseTrack(T, np.tile(1e-4 * np.eye(6), (t, 1, 1)), np.ones(t, bool), np.ones(t, bool))


def test_a_clock_that_is_even_already_changes_nothing():
    times = 5.0 + np.arange(30) * 0.1 + np.random.default_rng(1).uniform(-0.002, 0.002, 30)
    even = clock.even_times(times)
    assert len(even) == 30 and np.ptp(np.diff(even)) < 1e-9
    own = track(30)
    same = clock.resample_poses(own, even, even)
    np.testing.assert_allclose(same.T_world_x, own.T_world_x, atol=1e-12)
    assert same.observed.all() and same.oriented.all()


def test_a_slow_recording_gets_ten_samples_a_second_and_what_is_between_is_not_called_measured():
    times = np.arange(20) * 0.5
    even = clock.even_times(times)
    assert np.diff(even) == pytest.approx(0.1)
    dense = clock.resample_poses(track(20), times, even)
    assert dense.known.all()
    lost = track(20)
    lost.observed[8:12] = False
    flags = clock.resample_poses(lost, times, even).observed
    assert not flags[(even > 4.35) & (even < 5.15)].any() and flags[even < 3.4].all()


def test_long_gaps_stay_gaps():
    own = track(40)
    own.T_world_x[10:25] = np.nan
    times = np.arange(40) * 0.1
    there = clock.resample_poses(own, times, times)
    assert not there.known[10:24].any() and there.known[:10].all()


def test_planar_tracks_and_points_follow_straight_lines():
    times = np.arange(10) * 0.2
    planar = PlanarTrack(np.outer(times, [1.0, -2, 0.5]), np.tile(np.eye(3), (10, 1, 1)), np.ones(10, bool))
    at = np.arange(19) * 0.1
    np.testing.assert_allclose(clock.resample_planar(planar, times, at).xy_yaw, np.outer(at, [1, -2, 0.5]), atol=1e-12)
    points = np.multiply.outer(times, np.ones((18, 3)))
    points[3:5, 7] = np.nan
    dense = clock.resample_points(points, times, at)
    np.testing.assert_allclose(dense, np.multiply.outer(at, np.ones((18, 3))), atol=1e-12)


def test_a_recording_of_one_frame_is_no_demonstration():
    with pytest.raises(UnderstudyError, match="two frames"):
        clock.even_times([1.0])


# alignment


def test_the_same_demonstration_elsewhere_and_slower_is_aligned_to_the_same():
    T_move = rigid(Rotation.from_euler("z", 50, degrees=True).as_matrix(), np.array([2.0, -1.0, 0.0]))
    both = align([door_demonstration(), door_demonstration(T_move=T_move, stretch=1.5)])
    np.testing.assert_allclose(both.T_rest_hand[0], both.T_rest_hand[1], atol=1e-9)
    np.testing.assert_allclose(both.way[0], both.way[1], atol=1e-9)
    np.testing.assert_allclose(both.torso[0], both.torso[1], atol=1e-9)
    np.testing.assert_allclose(both.durations_s[1], 1.5 * both.durations_s[0], atol=1e-6)


def test_phases_meet_at_the_borders_of_segments():
    demo = door_demonstration()
    p = phase(demo.times_s, demo.segments)
    assert p[0] == 0 and p[demo.segments.grasp] == pytest.approx(1) and p[demo.segments.release] == pytest.approx(2)
    assert p[-1] == pytest.approx(3) and (np.diff(p) > 0).all()


def test_a_floor_frame_turns_with_the_handle():
    T = rigid(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([1.0, 2, 0.9]))
    np.testing.assert_allclose(on_floor(T, np.array([[1.0, 3, np.pi]])), [[1, 0, np.pi / 2]], atol=1e-12)


def test_align_needs_something():
    with pytest.raises(UnderstudyError, match="at least one"):
        align([])


# map


def looking(height: float = 1.6, down: float = 25) -> np.ndarray:
    """A camera over the world's origin that looks along x and down."""
    level = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return rigid(level @ Rotation.from_euler("x", -down, degrees=True).as_matrix(), np.array([0.0, 0, height]))


CUPBOARD = (np.array([2.5, -0.5, 0.0]), np.array([3.0, 0.4, 1.0]))


def test_the_floor_of_a_cast_scene_gives_back_the_camera():
    T = looking()
    depth = cast(T, [CUPBOARD])
    found = world_from_camera(find_floor(cloud(depth), []))
    np.testing.assert_allclose(found, T, atol=2e-3)


def test_the_map_holds_the_furniture_but_not_the_person_who_passes():
    T = looking()
    rng = np.random.default_rng(0)
    views = []
    for k in range(8):
        y = -0.9 + 0.25 * k
        person = (np.array([1.7, y - 0.12, 0.0]), np.array([1.9, y + 0.12, 1.7]))
        joints = np.array([1.8, y, 0.9]) + np.column_stack([np.zeros((18, 2)), np.linspace(-0.85, 0.75, 18)])
        views.append(View(cast(T, [CUPBOARD, person]), to_cam(T, joints)[None]))
    scene = static_scene(views, T)
    inside = ((scene > CUPBOARD[0] - 0.06) & (scene < CUPBOARD[1] + 0.06)).all(axis=1)
    assert inside.sum() > 100
    assert (scene[~inside, 2] < 0.1).all(), "something besides the cupboard stands on the floor"
    walked = np.column_stack([np.full(20, 1.8), np.linspace(-0.9, 0.85, 20)])
    made = occupancy(scene, views, T, walked)

    def at(x: float, y: float) -> int:
        column, row = np.rint((np.array([x, y]) - made.origin_xy) / RESOLUTION).astype(int)
        return int(made.state[row, column])

    assert at(2.5, 0.0) == OCCUPIED
    assert all(at(1.8, y) == FREE for y in (-0.9, 0.0, 0.8))
    assert all(at(2.2, y) == FREE for y in rng.uniform(-0.4, 0.3, 5))
    assert at(3.3, 0.0) == UNKNOWN, "nobody has seen what is behind the cupboard"


def test_the_moving_part_is_not_in_the_scene():
    T = looking()
    views = [View(cast(T, [CUPBOARD]), np.zeros((0, 18, 3))) for _ in range(3)]
    front = Sweep(np.eye(4)[None], np.array([2.49, -0.5, 0.0]), np.array([2.51, 0.4, 1.0]))
    scene = static_scene(views, T, front)
    low, high = CUPBOARD
    on_front = (np.abs(scene[:, 0] - low[0]) < 0.04) & (scene[:, 2] > 0.1) & (scene[:, 2] < high[2] - 0.1)
    assert not on_front.any() and len(scene)


def test_what_went_away_is_gone_also_where_depth_has_gaps_in_every_frame():
    """Registered depth is a net: where its gaps are the same in every frame, no pixel of them ever speaks."""
    T = looking()
    door = (np.array([2.0, -0.3, 0.0]), np.array([2.1, 0.3, 1.0]))
    views = []
    for k in range(8):
        depth = cast(T, [CUPBOARD, door] if k < 5 else [CUPBOARD])
        z = np.where(np.add.outer(np.arange(120), np.arange(160)) % 2 == 0, depth.z, np.float32(0))
        views.append(View(RegisteredDepth(z, depth.camera), np.zeros((0, 18, 3))))
    scene = static_scene(views, T)
    inside = ((scene > CUPBOARD[0] - 0.06) & (scene < CUPBOARD[1] + 0.06)).all(axis=1)
    assert inside.sum() > 100
    assert (scene[~inside, 2] < 0.1).all(), "the door that went away is still there"


def test_a_handle_that_sticks_out_of_the_moving_part_is_not_in_the_scene():
    bar = np.array([[-0.1, 0.0, z] for z in (0.5, 0.6, 0.7)])
    front = Sweep(np.eye(4)[None], np.array([-0.01, -0.4, 0.0]), np.array([0.01, 0.4, 1.0]), bar)
    points = np.array([[0.0, 0, 0.5], [-0.13, 0, 0.65], [-0.13, 0.2, 0.65], [-0.2, 0, 0.65]])
    assert front.holds(points, 0.06).tolist() == [True, True, False, False]


def test_the_part_whose_motion_is_known_is_found_and_the_hand_at_it_is_not():
    """A drawer with a bracket on its front comes out of a cupboard; somebody's hand with a box is at it meanwhile."""
    T, still = looking(), np.zeros((0, 18, 3))
    way = np.concatenate([np.zeros(4), np.linspace(0.1, 0.4, 5), np.full(4, 0.4)])
    views = []
    for k, q in enumerate(way):
        front = (np.array([2.46 - q, -0.4, 0.5]), np.array([2.48 - q, 0.3, 0.9]))
        bracket = (np.array([2.36 - q, 0.1, 0.6]), np.array([2.46 - q, 0.25, 0.8]))
        hand = (np.array([2.16 - q, -0.25, 0.6]), np.array([2.3 - q, -0.1, 0.75]))
        views.append(View(cast(T, [CUPBOARD, front, bracket, *([hand] if 4 <= k < 9 else [])]), still))
    T_part = np.tile(np.eye(4), (len(way), 1, 1))
    T_part[:, 0, 3] = 2.44 - way
    T_part[:, 2, 3] = 0.7
    T_part[2] = np.nan
    part = part_points(views, T, T_part)
    boxes = np.array([[[0.02, -0.4, -0.2], [0.04, 0.3, 0.2]], [[-0.08, 0.1, -0.1], [0.02, 0.25, 0.1]]])
    beside = np.maximum(boxes[:, None, 0] - part, part - boxes[:, None, 1]).max(axis=2)
    assert (beside.min(axis=0) < 0.04).all()
    assert (beside < 0.03).sum(axis=1).min() > 8, "front and bracket"
    assert np.ptp(part[:, 1]) > 0.6
    nobody = part_points(views, T, np.full((len(way), 4, 4), np.nan))
    assert nobody.shape == (0, 3)


def test_a_door_that_was_opened_once_is_no_wall():
    """A gate is pushed back and stays there, where nobody could look before: it is the part, not what stands still."""
    T, still = looking(), np.zeros((0, 18, 3))
    way = np.array([0.0, 0.0, 0.0, 0.7, 0.7, 0.7, 0.7, 0.7])
    T_part = np.tile(np.eye(4), (len(way), 1, 1))
    T_part[:, 0, 3] = 2.4 + way
    gates = [(np.array([2.4 + q, -0.4, 0.3]), np.array([2.42 + q, 0.4, 1.2])) for q in way]
    post = (np.array([2.4, 0.5, 0.0]), np.array([2.5, 0.7, 1.2]))
    views = [View(cast(T, [gate, post]), still) for gate in gates]
    part = part_points(views, T, T_part)
    assert len(part) > 100
    assert (np.abs(part[:, 0]) < 0.05).all()
    assert (np.abs(part[:, 1]) < 0.45).all(), "the post does not go with the gate"
    assert np.ptp(part[:, 1]) > 0.7 and np.ptp(part[:, 2]) > 0.8


def test_a_part_that_no_hand_has_reached_is_at_rest():
    """The object is hidden from sample 5 to 20; the hand is seen at it at sample 12 and pulls it out from there on."""
    t, x = 30, np.concatenate([np.zeros(12), np.linspace(0, 0.5, 18)])
    T = np.tile(np.eye(4), (t, 1, 1))
    T[:, 0, 3] = x
    hand = T.copy()
    hand[:, 1, 3] = np.maximum(12 - np.arange(t), 0) * 0.1
    seen = (np.arange(t) < 5) | (np.arange(t) >= 20)
    T[~seen] = np.nan
    covariance, every = np.tile(1e-6 * np.eye(6), (t, 1, 1)), np.ones(t, bool)
    covariance[~seen] = np.nan
    object = PoseTrack(T, covariance, seen, seen.copy())
    filled = untouched(object, PoseTrack(hand, np.tile(1e-4 * np.eye(6), (t, 1, 1)), every, every))
    assert filled.known[:10].all() and not filled.known[10:20].any()  # within reach from sample 10 on
    np.testing.assert_array_equal(filled.T_world_x[5:10], np.tile(np.eye(4), (5, 1, 1)))
    np.testing.assert_array_equal(filled.observed, seen)
    hidden = PoseTrack(np.full_like(hand, np.nan), covariance, ~every, ~every)
    np.testing.assert_array_equal(untouched(object, hidden).known, seen)


def test_an_empty_recording_has_an_empty_map():
    scene = static_scene([], np.eye(4))
    assert scene.shape == (0, 3) and occupancy(scene, [], np.eye(4)).state.tolist() == [[UNKNOWN]]


# storage


def test_what_is_saved_is_read_back_exactly(tmp_path):
    demo = door_demonstration(seed=4)
    back = storage.load(storage.save(tmp_path / "demo", demo))
    for field in fields(Demonstration):
        a, b = getattr(demo, field.name), getattr(back, field.name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        elif hasattr(a, "__dataclass_fields__"):
            for inner in fields(a):
                np.testing.assert_array_equal(getattr(a, inner.name), getattr(b, inner.name))
        else:
            assert a == b


@pytest.mark.parametrize("field", ["task", "acting", "segments", "articulation", "handle", "map_resolution_m"])
def test_a_missing_field_is_named(tmp_path, field):
    folder = storage.save(tmp_path, door_demonstration())
    info = json.loads((folder / storage.INFO).read_text())
    del info[field]
    (folder / storage.INFO).write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=field):
        storage.load(folder)


def test_damage_is_reported_with_the_file(tmp_path):
    folder = storage.save(tmp_path, door_demonstration())
    arrays = folder / storage.ARRAYS
    arrays.write_bytes(arrays.read_bytes()[:2000])
    with pytest.raises(RecordingError, match=r"demonstration\.npz"):
        storage.load(folder)
    with pytest.raises(RecordingError, match="holds no"):
        storage.load(tmp_path / "nowhere")
    (folder / storage.INFO).write_text('{"format": "demonstration/9"}')
    with pytest.raises(RecordingError, match="format"):
        storage.load(folder)


def test_a_demonstration_checks_itself():
    demo = door_demonstration()
    with pytest.raises(UnderstudyError, match="acting"):
        replace(demo, acting="both")
    short = PlanarTrack(demo.torso.xy_yaw[:-1], demo.torso.covariance[:-1], demo.torso.observed[:-1])
    with pytest.raises(UnderstudyError, match="as many samples"):
        replace(demo, torso=short)
    with pytest.raises(UnderstudyError, match="beyond 90 samples"):
        replace(demo, segments=Segments(30, 91))


def test_points_and_camera_agree():
    """The tests' own caster: its points lie on what it cast."""
    T = looking()
    depth = cast(T, [])
    world = transform_points(T, cloud(depth).astype(np.float64))
    assert np.abs(world[:, 2]).max() < 1e-5 and camera().width == depth.camera.width


@pytest.mark.parametrize(
    "right, left, tried",
    [
        (0.5, 0.1, ["right"]),
        (0.1, 0.5, ["left"]),
        (0.5, 0.4, ["right", "left"]),
        (0.006, 0.001, ["right", "left"]),  # neither is a reach: the object must tell
        (-0.2, -0.2, ["left", "right"]),
    ],
)
def test_hands_that_hardly_reach_are_both_tried(right, left, tried):
    """right, left: metres by which a wrist is farther from the trunk than at rest, for a second."""
    n = 31
    joints = np.zeros((n, 18, 3))
    joints[:, JOINT["right_wrist"], 0], joints[:, JOINT["left_wrist"], 0] = 0.33 + right, 0.33 + left
    sure, observed = np.full((n, 18), 1e-3), np.ones((n, 18), bool)
    times = np.linspace(0, 1, n)
    track = PersonTrack(0, times, joints, sure, observed, np.full((n, 18), "observed"), np.ones(len(BONES)))
    hands = reaching_hands([track], np.eye(4))
    assert hands[0].reaching_s == pytest.approx(max(right, left, 0), rel=0.05, abs=1e-9)
    assert [hand.side for hand in in_question(hands)] == tried
