"""Who is who, and where: laws of the filter, exact motions, gaps, outliers, bones, and live against offline."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from understudy.errors import UnderstudyError
from understudy.people_file import FramePeople
from understudy.skeleton import JOINT
from understudy.tracking import MEMORY, MEMORY_S, IdentityTracker, LiveTracker, Model, bones, smooth, track
from understudy.tracking.kalman import K, Measured, State, backward, forward
from understudy.tracking.measured import BALL
from understudy.tracking.robust import Past, smooth_points
from understudy.types import INFERRED, MISSING, OBSERVED, Keypoints2D, Person

BODY = np.array(
    [
        [0.0, -0.70, -0.08], [0.0, -0.50, 0.0],
        [-0.16, -0.50, 0.0], [-0.16, -0.22, 0.0], [-0.16, 0.03, 0.0],
        [0.16, -0.50, 0.0], [0.16, -0.22, 0.0], [0.16, 0.03, 0.0],
        [-0.11, -0.05, 0.0], [-0.11, 0.36, 0.0], [-0.11, 0.76, 0.0],
        [0.11, -0.05, 0.0], [0.11, 0.36, 0.0], [0.11, 0.76, 0.0],
        [-0.03, -0.74, -0.07], [0.03, -0.74, -0.07], [-0.08, -0.72, 0.0], [0.08, -0.72, 0.0],
    ]
)  # fmt: skip
"""Somebody upright, metres, camera's axes."""


def seen_at(keypoints, sigma=0.02, hidden=()):
    """Somebody measured there, with this `sigma_m`; without the hidden joints."""
    keypoints, sigmas = np.array(keypoints, float), np.full(18, float(sigma))
    keypoints[list(hidden)], sigmas[list(hidden)] = np.nan, np.nan
    source = tuple(OBSERVED if np.isfinite(s) else MISSING for s in sigmas)
    found = Keypoints2D.where(np.full((18, 2), 50.0), np.ones(18))
    return Person(found, keypoints, np.where(np.isfinite(sigmas), 0.95, 0.0), sigmas, source)


def moving(t):
    """BODY, walking and swinging its left arm as a whole; (t, 18, 3)."""
    joints = np.tile(BODY, (len(t), 1, 1))
    angle = 0.7 * np.sin(2.0 * t)
    for joint in (JOINT["left_elbow"], JOINT["left_wrist"]):
        down = BODY[joint, 1] - BODY[JOINT["left_shoulder"], 1]
        joints[:, joint] = BODY[JOINT["left_shoulder"]] + down * np.stack([0 * t, np.cos(angle), np.sin(angle)], axis=1)
    return joints + np.stack([0.5 * np.sin(0.8 * t), 0 * t, 3 + 0.2 * t], axis=1)[:, None]


def random_points(rng, t, b):
    seen = rng.random((t, b)) < 0.8
    seen[0] = True
    y = np.cumsum(rng.normal(0, 0.05, (t, b, 3)), axis=0)
    return Measured(y, rng.uniform(0.02, 0.06, (t, b)), seen, np.ones((t, b), bool))


def person(x: float, z: float = 3.0) -> Person:
    """Somebody at (x, 0, z) metres, seen by a camera with f = 500 px."""
    keypoints = np.tile((x, 0.0, z), (18, 1)) + np.random.default_rng(0).normal(0, 0.1, (18, 3))
    uv = 500 * keypoints[:, :2] / keypoints[:, 2:] + 500
    seen = Keypoints2D.where(uv, np.ones(18))
    return Person(seen, keypoints, np.ones(18), np.full(18, 0.02), ("observed",) * 18)


def failed(x: float) -> Person:
    return Person.failure(person(x).keypoints_2d, "no depth")


def ids(people):
    return [p.id for p in people]


def test_ids_stay_whatever_the_order():
    tracker = IdentityTracker()
    assert ids(tracker.update([person(-1), person(0), person(1)])) == [0, 1, 2]
    assert ids(tracker.update([person(1.05), person(-0.9), person(0.1)])) == [2, 0, 1]


def test_a_newcomer_and_one_who_comes_back():
    tracker = IdentityTracker()
    tracker.update([person(-1), person(1)])
    assert ids(tracker.update([person(1)])) == [1]
    assert ids(tracker.update([person(3), person(1), person(-1)])) == [2, 1, 0]
    for _ in range(MEMORY + 1):
        tracker.update([person(1)])
    assert ids(tracker.update([person(-1), person(1)])) == [3, 1]


def test_people_without_depth_keep_their_ids_too():
    tracker = IdentityTracker()
    tracker.update([person(-1), failed(1)])
    assert ids(tracker.update([failed(1.02), failed(-1.01)])) == [1, 0]
    assert ids(tracker.update([person(-1), person(1)])) == [0, 1]


def test_numbering_again_changes_nothing():
    """Stored results are numbered again when a recording is resumed: same ids, whatever ids they carry."""
    frames = [[person(-1), person(0.5)], [person(0.6), person(-1.1), person(2)], [], [person(2.1), person(-1.0)]]
    tracker = IdentityTracker()
    numbered = [tracker.update(f) for f in frames]
    again = IdentityTracker()
    assert [ids(again.update(f)) for f in numbered] == [ids(f) for f in numbered]


# Identities


def test_people_who_cross_keep_their_ids():
    tracker, seen = IdentityTracker(), []
    for k, t in enumerate(np.arange(0, 4, 0.1)):
        people = [person(-2 + t, 3.0), person(2 - t, 3.15)]  # they pass at 15 cm
        seen.append(ids(tracker.update(people[:: 1 if k % 2 else -1], float(t)))[:: 1 if k % 2 else -1])
    assert seen == [[0, 1]] * 40 or seen == [[1, 0]] * 40


def test_a_walker_is_found_again_behind_a_pillar_and_a_stander_is_not_taken_for_him():
    tracker = IdentityTracker()
    for t in np.arange(0, 1.01, 0.1):
        assert ids(tracker.update([person(-2 + t), person(1.2)], float(t))) == [0, 1]
    for t in np.arange(1.1, 2.55, 0.1):  # hidden for 1.5 s, walking on
        assert ids(tracker.update([person(1.2)], float(t))) == [1]
    assert ids(tracker.update([person(1.2), person(0.6)], 2.6)) == [1, 0]


def test_two_who_come_back_are_told_apart_by_their_proportions():
    """A child and an adult vanish from beside each other, and come back with sides exchanged."""
    small, tall = 0.6 * BODY, BODY
    frame = lambda a, b: [seen_at(a + [-0.3, 0, 3]), seen_at(b + [0.3, 0, 3])]  # noqa: E731
    tracker = IdentityTracker()
    for k in range(20):
        assert ids(tracker.update(frame(small, tall), 0.1 * k)) == [0, 1]
    for k in range(20, 60):
        assert tracker.update([], 0.1 * k) == []
    assert ids(tracker.update(frame(tall, small), 6.0)) == [1, 0]


def test_the_lost_are_forgotten_after_a_time():
    tracker = IdentityTracker()
    tracker.update([person(0)], 0.0)
    assert ids(tracker.update([person(0)], MEMORY_S - 0.1)) == [0]
    assert ids(tracker.update([person(0)], 3 * MEMORY_S)) == [1]


@settings(deadline=None, max_examples=10)
@given(st.lists(st.lists(st.floats(-3, 3), max_size=5), max_size=8))
def test_never_two_people_with_one_id(frames):
    tracker = IdentityTracker()
    for xs in frames:
        found = ids(tracker.update([person(x) for x in xs]))
        assert len(set(found)) == len(xs)


def test_times_must_go_forwards():
    tracker = IdentityTracker()
    tracker.update([person(0)], 1.0)
    with pytest.raises(UnderstudyError, match="must increase"):
        tracker.update([person(0)], 1.0)


# The filter itself


def test_steps_of_time_compose():
    """Two steps are one: F(a + b) = F(b) F(a), Q(a + b) = F(b) Q(a) F(b)' + Q(b)."""
    F, Q, B = Model().steps(np.array([0.1, 0.25, 0.35]))
    np.testing.assert_allclose(F[2], F[1] @ F[0], atol=1e-12)
    for noise in (Q, B):
        np.testing.assert_allclose(noise[2], F[1] @ noise[0] @ F[1].T + noise[1], atol=1e-12)


def test_the_smoother_is_the_mean_of_the_joint_gaussian():
    """Against conditioning all states at once on all measurements, without any recursion backwards."""
    rng, model, q = np.random.default_rng(3), Model(), 50.0
    dt = np.array([0.0, 0.1, 0.05, 0.3, 0.1, 0.1, 0.2])
    t = len(dt)
    measured = random_points(rng, t, 1)
    measured.seen[3] = False
    weight = rng.uniform(0.2, 1, (t, 1))
    start = State(rng.normal(size=(1, K, 3)), np.eye(K)[None] * [[[0.5], [2.0], [3.0], [1.0]]])
    x, P = backward(forward(measured, model, dt, np.array([q]), weight, start))
    F, Q, B = model.steps(dt)
    noise = np.zeros((K * (t + 1), K * (t + 1)))
    noise[:K, :K] = start.P[0]
    rows_of = np.zeros((t, K, K * (t + 1)))
    row = np.hstack([np.eye(K), np.zeros((K, K * t))])
    for k in range(t):
        row = F[k] @ row
        row[:, K * (k + 1) : K * (k + 2)] = np.eye(K)
        noise[K * (k + 1) : K * (k + 2), K * (k + 1) : K * (k + 2)] = q * Q[k] + B[k]
        rows_of[k] = row
    A = rows_of.reshape(t * K, -1)
    C, mean = A @ noise @ A.T, A[:, :K] @ start.x[0]
    h, R = measured.rows(model)
    H = np.zeros((t, t * K))
    for k in range(t):
        H[k, K * k : K * (k + 1)] = h[k, 0]
    used = measured.seen[:, 0]
    H = H[used]
    gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + np.diag((R / weight)[used, 0]))
    np.testing.assert_allclose(x[:, 0].reshape(t * K, 3), mean + gain @ (measured.y[used, 0] - H @ mean), atol=1e-8)
    both = (C - gain @ H @ C).reshape(t, K, t, K)
    np.testing.assert_allclose(P[:, 0], both[np.arange(t), :, np.arange(t)], atol=1e-8)


def test_all_points_at_once_are_each_point_alone():
    rng = np.random.default_rng(0)
    measured, dt = random_points(rng, 25, 7), np.full(25, 0.1)
    together = smooth_points(measured, Model(), dt, Past.none(7))
    for b in range(7):
        alone = smooth_points(measured.points(slice(b, b + 1)), Model(), dt, Past.none(1))
        np.testing.assert_allclose(alone.position[:, 0], together.position[:, b], atol=1e-9)
        np.testing.assert_allclose(alone.variance[:, 0], together.variance[:, b], rtol=1e-9)


def test_the_ball_holds_the_truth_as_often_as_it_says():
    """Points drawn from the model itself, noise with its lasting and its constant part."""
    rng, model = np.random.default_rng(4), Model()
    t, b, s = 80, 150, 0.03
    F, Q, B = model.steps(np.full(t, 0.1))
    root = np.linalg.cholesky(1000.0 * Q[0] + B[0] + 1e-12 * np.eye(K))
    x = np.zeros((b, K, 3))
    x[:, 3] = rng.normal(size=(b, 3))
    truth, y = np.zeros((t, b, 3)), np.zeros((t, b, 3))
    constant = np.sqrt(model.constant_share) * rng.normal(size=(b, 3))
    white = 1 - model.bias_share - model.constant_share
    for k in range(t):
        x = F[0] @ x + root @ rng.normal(size=(b, K, 3))
        truth[k] = x[:, 0]
        y[k] = x[:, 0] + s * (np.sqrt(model.bias_share) * x[:, 3] + constant + np.sqrt(white) * rng.normal(size=(b, 3)))
    measured = Measured(y, np.full((t, b), s), np.ones((t, b), bool), np.ones((t, b), bool))
    result = smooth_points(measured, model, np.full(t, 0.1), Past.none(b))
    distance = np.linalg.norm(result.position - truth, axis=2)
    inside = (distance <= BALL * np.sqrt(result.variance)).mean()
    assert 0.62 < inside < 0.74
    assert distance.mean() < np.linalg.norm(y - truth, axis=2).mean()


# People


def test_a_steady_motion_is_recovered_and_not_delayed():
    t = np.arange(30) * 0.1
    path = np.outer(t, [0.8, -0.1, 0.4])
    track = smooth(t, [[seen_at(BODY + p + [0, 0, 3])] for p in path])[0]
    np.testing.assert_allclose(track.keypoints, BODY + path[:, None] + [0, 0, 3], atol=2e-3)  # also at the ends
    still = smooth(t, [[seen_at(BODY + [0, 0, 3])] for _ in t])[0]
    np.testing.assert_allclose(still.keypoints, np.tile(BODY + [0, 0, 3], (30, 1, 1)), atol=2e-3)


def test_a_swing_is_not_delayed_and_noise_shrinks():
    rng, t = np.random.default_rng(0), np.arange(120) * 0.05
    truth = moving(t)
    noisy = truth + rng.normal(0, 0.02, truth.shape)
    track = smooth(t, [[seen_at(p, 0.037)] for p in noisy])[0]
    error = np.linalg.norm(track.keypoints - truth, axis=2)
    assert error.mean() < 0.6 * np.linalg.norm(noisy - truth, axis=2).mean()
    jitter = lambda p: np.diff(p - truth, 2, axis=0).std()  # noqa: E731
    assert jitter(track.keypoints) < 0.3 * jitter(noisy)
    shifts, inner = np.arange(-3, 4), slice(10, -10)
    apart = [np.linalg.norm((np.roll(track.keypoints, -s, axis=0) - truth)[inner], axis=2).mean() for s in shifts]
    assert shifts[int(np.argmin(apart))] == 0


def test_in_a_gap_uncertainty_grows_and_shrinks():
    t, wrist = np.arange(40) * 0.1, JOINT["left_wrist"]
    people = [[seen_at(p, hidden=[wrist] if 15 <= k < 24 else [])] for k, p in enumerate(moving(t))]
    track = smooth(t, people)[0]
    gap = slice(15, 24)
    assert (
        not track.observed[gap, wrist].any() and track.observed[:15, wrist].all() and track.observed[24:, wrist].all()
    )
    assert (track.source[gap, wrist] == INFERRED).all()
    assert (track.source[:15] == OBSERVED).all() and (track.source[24:] == OBSERVED).all()
    sigma = track.sigma_m[14:25, wrist]
    assert (np.diff(sigma[:5]) > 0).all() and (np.diff(sigma[-5:]) < 0).all()
    error = np.linalg.norm(track.keypoints - moving(t), axis=2)[gap, wrist]
    assert (error < 2 * sigma[1:-1]).all()


def test_what_is_far_from_any_measurement_has_no_position():
    t, wrist = np.arange(60) * 0.1, JOINT["left_wrist"]
    people = [[seen_at(p, hidden=[wrist] if k < 12 or 25 <= k < 50 else [])] for k, p in enumerate(moving(t))]
    track = smooth(t, people, reach_s=0.55)[0]
    known = np.isfinite(track.keypoints[:, wrist]).all(axis=1)
    expected = [7 <= k < 30 or k >= 45 for k in range(60)]
    assert known.tolist() == expected
    assert np.isnan(track.sigma_m[~known, wrist]).all() and (track.source[~known, wrist] == MISSING).all()
    assert (track.confidence[~known, wrist] == 0).all() and (track.confidence[known, wrist] > 0).all()
    never = smooth(t, [[seen_at(p, hidden=[wrist])] for p in moving(t)])[0]
    assert np.isnan(never.keypoints[:, wrist]).all() and np.isfinite(np.delete(never.keypoints, wrist, 1)).all()


def test_outliers_are_rejected():
    rng, t = np.random.default_rng(2), np.arange(60) * 0.1
    truth = moving(t)
    noisy = truth + rng.normal(0, 0.01, truth.shape)
    bad = rng.random((60, 18)) < 0.05
    noisy[bad] += 0.5
    assert bad.sum() > 30
    track = smooth(t, [[seen_at(p, 0.02)] for p in noisy])[0]
    assert np.linalg.norm(track.keypoints - truth, axis=2)[bad].mean() < 0.03
    assert not track.observed[bad].any() and track.observed[~bad].mean() > 0.97


def test_bones_are_learnt_and_kept():
    rng, t = np.random.default_rng(5), np.arange(80) * 0.1
    truth = 1.15 * moving(t)
    noisy = truth + rng.normal(0, 0.03, truth.shape)
    track = smooth(t, [[seen_at(p, 0.056)] for p in noisy])[0]
    rigid = [k for k, give in enumerate(bones.GIVE_M) if give <= 0.005]
    assert len(rigid) == 12
    true = bones.lengths(truth)[0]
    assert np.abs(track.bone_lengths_m - true)[rigid].max() < 0.02
    now = bones.lengths(track.keypoints)[:, rigid]
    assert np.abs(now - track.bone_lengths_m[rigid]).max() < 0.015
    assert now.std(axis=0).max() < 0.2 * bones.lengths(noisy)[:, rigid].std(axis=0).min()


def test_without_measurements_bones_are_those_of_most_people():
    nothing = np.full((3, bones.N_BONES), np.nan)
    length, sigma = bones.learn(nothing, nothing, 1.0)
    np.testing.assert_allclose(length, bones.USUAL_M)
    assert (sigma > 0).all()


def test_enforcing_bones_moves_joints_by_their_uncertainty_only():
    """Against a general minimiser of the stated sum."""
    rng = np.random.default_rng(6)
    p, v = BODY + rng.normal(0, 0.01, (18, 3)), rng.uniform(0.01, 0.05, 18) ** 2
    length, sigma = bones.lengths(BODY), np.full(bones.N_BONES, 0.004)
    got, variance = bones.enforce(p[None], v[None], length, sigma)

    def residuals(x):
        x = x.reshape(18, 3)
        moved = (x - p) / np.sqrt((1 - bones.SHARED) * v)[:, None]
        stretched = (bones.lengths(x) - length) / np.hypot(bones.GIVE_M, sigma)
        return np.concatenate([moved.ravel(), stretched])

    best = least_squares(residuals, p.ravel(), xtol=1e-9).x.reshape(18, 3)
    np.testing.assert_allclose(got[0], best, atol=1.5e-3)
    assert (variance[0] < v).all() and (variance[0] > 0.4 * v).all()


def test_others_in_the_recording_change_nothing():
    t = np.arange(20) * 0.1
    alone = [[seen_at(p).with_id(3)] for p in moving(t)]
    both = [
        [*a, seen_at(p + [1, 0, 1]).with_id(1)] if k > 4 else a
        for k, (a, p) in enumerate(zip(alone, moving(t), strict=True))
    ]
    together = smooth(t, both)
    assert [x.id for x in together] == [1, 3] and [len(x) for x in together] == [15, 20]
    np.testing.assert_allclose(together[1].keypoints, smooth(t, alone)[0].keypoints, atol=1e-9)


def test_short_and_broken_recordings():
    assert smooth([], []) == [] and smooth([0.0, 1.0], [[], []]) == []
    one = smooth([4.0], [[seen_at(BODY + [0, 0, 3])]])[0]
    np.testing.assert_allclose(one.keypoints[0], BODY + [0, 0, 3], atol=0.01)
    frames = [
        FramePeople(0, (seen_at(BODY + [0, 0, 3]),), 0.0),
        FramePeople(1, (), 0.1, "unreadable"),
        FramePeople(2, (failed(0.0),), 0.2),
        FramePeople(3, (seen_at(BODY + [0, 0, 3]),), 0.3),
    ]
    tracks = [x for x in track(frames) if len(x) == 4]
    assert len(tracks) == 1
    assert tracks[0].observed.all(axis=1).tolist() == [True, False, False, True]
    assert np.isfinite(tracks[0].keypoints).all()


def test_frames_without_time_stamps_need_fps():
    frames = [FramePeople(k, (seen_at(BODY),)) for k in (4, 5, 7)]
    np.testing.assert_allclose(track(frames, fps=5.0)[0].times_s, [0.8, 1.0, 1.4])
    with pytest.raises(UnderstudyError, match=r"frame 4.*timestamp_s.*fps"):
        track(frames)
    with pytest.raises(UnderstudyError, match="fps must be above 0"):
        track(frames, fps=0.0)


@pytest.mark.parametrize(
    "times, people, words",
    [
        ([0.0, 0.0], 2, "must increase, got 0 and then 0"),
        ([0.0, np.nan], 2, "finite, got nan at position 1"),
        ([0.0], 2, "one time for each of the 2 frames"),
    ],
)
def test_bad_times(times, people, words):
    with pytest.raises(UnderstudyError, match=words):
        smooth(times, [[]] * people)


def test_bad_people():
    with pytest.raises(UnderstudyError, match=r"people_per_frame\[1\]: id 0 is there twice"):
        smooth([0.0, 1.0], [[], [seen_at(BODY), seen_at(BODY)]])
    with pytest.raises(UnderstudyError, match="reach_s must be 0 or more"):
        smooth([0.0], [[]], reach_s=-1.0)
    with pytest.raises(UnderstudyError, match="lag_frames must be 0 or more"):
        LiveTracker(-1)


# Live


def test_looking_ahead_to_the_end_is_the_offline_smoother():
    t = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.2, 25))
    noisy = moving(t) + np.random.default_rng(0).normal(0, 0.03, (25, 18, 3))
    frames = [[seen_at(p, 0.05)] if k not in (8, 9) else [] for k, p in enumerate(noisy)]
    frames = [f if k < 10 else [*f, seen_at(noisy[k] + [1.2, 0, 0.5], 0.05)] for k, f in enumerate(frames)]
    live = LiveTracker(lag_frames=25)
    assert all(live.update(float(a), f) is None for a, f in zip(t, frames, strict=True))
    out = live.flush()
    assert [o.time_s for o in out] == t.tolist() and live.flush() == []
    tracks = track([FramePeople(k, tuple(f), float(a)) for k, (a, f) in enumerate(zip(t, frames, strict=True))])
    assert [len(x) for x in tracks] == [25, 15]
    for x in tracks:
        people = [p for o in out for p in o.people if p.id == x.id]
        np.testing.assert_allclose(np.stack([p.keypoints for p in people]), x.keypoints, atol=1e-6)
        np.testing.assert_allclose(np.stack([p.sigma_m for p in people]), x.sigma_m, rtol=1e-5)
        assert [p.source for p in people] == [tuple(row) for row in x.source.tolist()]


def test_the_more_it_looks_ahead_the_better():
    rng, t = np.random.default_rng(0), np.arange(30) * 0.1
    truth = moving(t)
    noisy = truth + rng.normal(0, 0.03, truth.shape)
    jitter, error = [], []
    for lag in (0, 4):
        live, out = LiveTracker(lag), []
        for k, p in enumerate(noisy):
            now = live.update(float(t[k]), [seen_at(p, 0.056)])
            assert (now is None) == (k < lag)
            if now is not None:
                assert now.time_s == t[k - lag]
                out.append(now.people[0].keypoints)
        out += [o.people[0].keypoints for o in live.flush()]
        assert len(out) == 30
        jitter.append(np.diff(np.stack(out) - truth, 2, axis=0).std())
        error.append(np.linalg.norm(np.stack(out) - truth, axis=2)[10:].mean())
    assert (
        jitter[0] < np.diff(noisy - truth, 2, axis=0).std() and error[0] < np.linalg.norm(noisy - truth, axis=2).mean()
    )
    assert jitter[0] > jitter[1] and error[0] > error[1]


def test_the_filter_coasts_for_a_moment_and_then_lets_go():
    live, t = LiveTracker(0, reach_s=0.35), np.arange(20) * 0.1
    sigma = []
    for k in range(20):
        here = [seen_at(BODY + [0.5 * t[k], 0, 3])] if k < 10 else []
        now = live.update(float(t[k]), here)
        assert now is not None and [p.id for p in now.people] == ([0] if k < 13 else [])
        sigma += [float(p.sigma_m[0]) for p in now.people]
        if 10 <= k < 13:
            assert set(now.people[0].source) == {INFERRED}
            assert np.abs(now.people[0].keypoints[1] - (BODY[1] + [0.5 * t[k], 0, 3])).max() < 0.05
    assert sigma[9] < sigma[10] < sigma[11] < sigma[12]
    with pytest.raises(UnderstudyError, match="must increase"):
        live.update(0.5, [])
