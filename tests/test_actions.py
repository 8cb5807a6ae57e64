"""Action models: mixtures against an oracle and known truth; laws of frames, mirrors and borders; skills on disk."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from action_scenes import NO_SPREAD, TASKS, demonstrate
from scipy.spatial.transform import Rotation

from understudy import lie
from understudy.actions import RobotMotion, RobotPose, Skill, learn, load_skill, save_skill
from understudy.actions.features import BASE, POSITION, ROTATION, floor_frame
from understudy.actions.mixture import Mixture, fit_mixture
from understudy.actions.rotations import karcher_mean, nearest_vector, to_tangent
from understudy.actions.segments import SEGMENTS, progress_curve
from understudy.demonstration.demonstration import Segments
from understudy.errors import RecordingError, UnderstudyError
from understudy.geometry import inverse, rigid

pytest.importorskip("sklearn", reason="learning needs the extra 'learn'")


def a_mixture(k: int = 4, d: int = 10, seed: int = 0) -> Mixture:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(k, d + 1, d + 1))
    means = np.column_stack([np.linspace(0.1, 0.9, k), rng.normal(size=(k, d))])
    covariances = 0.02 * A @ A.swapaxes(1, 2) + 0.01 * np.eye(d + 1)
    return Mixture(rng.dirichlet(np.ones(k) * 5), means, covariances)


def motions(task: str, n: int, seed: int = 0, **keywords) -> list[RobotMotion]:
    rng = np.random.default_rng(seed)
    return [demonstrate(TASKS[task], rng, **keywords) for _ in range(n)]


@pytest.fixture(scope="module")
def models():
    """Tasks, and what was learnt from six demonstrations of each."""
    return {task: learn(motions(task, 6), components=4) for task in TASKS}


def rest(task: str) -> np.ndarray:
    return TASKS[task].articulation().T_rest


def over_floor(x: float, y: float, yaw: float, up: float = 0.0) -> np.ndarray:
    return rigid(Rotation.from_euler("z", yaw).as_matrix(), np.array([x, y, up]))


# --- mixtures


def test_regression_equals_the_gmr_package():
    gmr = pytest.importorskip("gmr", reason="the oracle is not installed")
    ours, phase = a_mixture(), np.linspace(-0.1, 1.1, 50)
    said = ours.regress(phase)
    oracle = gmr.GMM(len(ours), priors=ours.weights, means=ours.means, covariances=ours.covariances)
    np.testing.assert_allclose(said.mean, oracle.predict(np.array([0]), phase[:, None]), atol=1e-9)
    for i, t in enumerate(phase):
        conditional = oracle.condition(np.array([0]), np.array([t]))
        away = conditional.means - said.mean[i]
        moments = np.einsum("k,kij->ij", conditional.priors, conditional.covariances)
        moments += np.einsum("k,ki,kj->ij", conditional.priors, away, away)
        np.testing.assert_allclose(said.covariance[i], moments, atol=1e-9)


def test_slope_is_the_derivative_of_the_mean():
    mixture, phase, h = a_mixture(seed=1), np.linspace(0, 1, 30), 1e-5
    difference = (mixture.regress(phase + h).mean - mixture.regress(phase - h).mean) / (2 * h)
    np.testing.assert_allclose(mixture.regress(phase).slope, difference, atol=1e-6 * np.abs(difference).max())


def test_conditional_covariance_of_one_gaussian_is_the_schur_complement():
    mixture = a_mixture(k=1)
    S = mixture.covariances[0]
    schur = np.linalg.inv(np.linalg.inv(S)[1:, 1:])
    said = mixture.regress(np.array([-3.0, 0.2, 5.0])).covariance
    np.testing.assert_allclose(said, np.broadcast_to(schur, said.shape), atol=1e-10)


def test_covariances_are_positive_and_symmetric_everywhere():
    S = a_mixture(seed=2).regress(np.linspace(-1, 2, 100)).covariance
    np.testing.assert_array_equal(S, S.swapaxes(1, 2))
    assert np.linalg.eigvalsh(S).min() > 0


def test_em_finds_a_known_mixture():
    rng = np.random.default_rng(5)
    truth = Mixture(
        np.array([0.5, 0.3, 0.2]),
        np.array([[0.2, 0.0, 1.0], [0.5, 3.0, 0.0], [0.85, 1.0, -2.0]]),
        np.array([np.diag([0.01, 0.2, 0.1]), np.diag([0.004, 0.1, 0.3]), np.diag([0.003, 0.2, 0.2])])
        + np.array([[0, 0.02, 0], [0.02, 0, 0.05], [0, 0.05, 0]]) * 0.5,
    )
    which = rng.choice(3, 6000, p=truth.weights)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(truth.covariances)[which], rng.normal(size=(6000, 3)))
    found = fit_mixture(truth.means[which] + noise, np.array([1e-3, 1e-3, 1e-3]))
    assert len(found) == 3  # by BIC
    order = np.argsort(found.means[:, 0])
    np.testing.assert_allclose(found.weights[order], truth.weights, atol=0.03)
    np.testing.assert_allclose(found.means[order], truth.means, atol=0.06)
    np.testing.assert_allclose(found.covariances[order], truth.covariances, atol=0.04)


def test_mixture_is_learnt_alike_again_and_softening_keeps_its_lines():
    x = np.random.default_rng(0).normal(size=(200, 4))
    floor = np.full(4, 0.01)
    first, second = fit_mixture(x, floor, seed=3), fit_mixture(x, floor, seed=3)
    np.testing.assert_array_equal(first.covariances, second.covariances)
    soft = a_mixture().softened(1.7)
    np.testing.assert_allclose(soft.gains, a_mixture().gains, atol=1e-12)
    np.testing.assert_allclose(soft.residuals, a_mixture().residuals, atol=1e-10)
    np.testing.assert_allclose(soft.covariances[:, 0, 0], 1.7**2 * a_mixture().covariances[:, 0, 0])


def test_mixture_refuses_bad_samples():
    with pytest.raises(UnderstudyError, match="too few"):
        fit_mixture(np.zeros((2, 3)), np.ones(3))
    with pytest.raises(UnderstudyError, match="not finite"):
        fit_mixture(np.full((20, 3), np.nan), np.ones(3))
    with pytest.raises(UnderstudyError, match="weights must be positive"):
        Mixture(np.array([0.5, 0.6]), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))


# --- rotations and frames


def test_karcher_mean_is_where_the_logarithms_cancel():
    R = Rotation.random(1, random_state=0) * Rotation.from_rotvec(
        np.random.default_rng(1).normal(scale=0.7, size=(40, 3))
    )
    mean = karcher_mean(R.as_matrix())
    assert np.linalg.norm(lie.so3_log(mean.T @ R.as_matrix()).mean(axis=0)) < 1e-11
    axis = np.array([0.6, 0.0, 0.8])
    pair = Rotation.from_rotvec(np.outer([-1.5, 1.5], axis)).as_matrix()  # 172 degrees apart
    np.testing.assert_allclose(karcher_mean(pair), np.eye(3), atol=1e-10)


def test_tangent_vectors_do_not_jump_at_pi():
    turn = np.outer(np.linspace(0.1, 4.5, 60), (0.0, 0.6, 0.8))
    w = to_tangent(np.eye(3), Rotation.from_rotvec(turn).as_matrix())
    np.testing.assert_allclose(w, turn, atol=1e-9)
    np.testing.assert_allclose(
        nearest_vector(np.array([0, 0, -3.1]), np.array([0, 0, 3.1])), [0, 0, 2 * np.pi - 3.1], atol=1e-12
    )


def test_features_and_poses_are_inverse_and_mirrors_are_linear(models):
    rng, model = np.random.default_rng(2), models["swivel_door"]
    chart = model.segments["reach"].chart
    y = rng.normal(scale=0.5, size=(20, 10))
    back = np.concatenate([chart.features(chart.poses(row[None])) for row in y])
    np.testing.assert_allclose(back, y, atol=1e-10)
    mirror = model.mirror()
    mirrored = chart.mirrored(mirror).poses(y @ mirror.map.T)
    expected = chart.poses(y).mirrored(mirror)
    np.testing.assert_allclose(mirrored.T_carrier_tool, expected.T_carrier_tool, atol=1e-12)
    np.testing.assert_allclose(mirrored.base, expected.base, atol=1e-12)
    assert np.linalg.det(mirrored.T_carrier_tool[:, :3, :3]) == pytest.approx(np.ones(20))


def test_covariance_in_the_world_is_that_of_samples(models):
    """T S T' and the Jacobian of the rotation vector, against samples that are moved one by one."""
    model, rng = models["swivel_door"], np.random.default_rng(0)
    segment = model.segments["reach"]
    said = segment.predict(np.array([0.1]))
    S = 0.01 * said.covariance  # small, so that the first order is enough
    y = rng.multivariate_normal(said.mean[0], S[0], size=20000)
    carrier = model.object.carrier(np.zeros(1))
    T0, base0, torso0 = segment.chart.poses(said.mean).world(carrier)
    many = model.object.carrier(np.zeros(len(y)))
    T, base, torso = segment.chart.poses(y).world(many)
    dr = lie.so3_log(T[:, :3, :3] @ T0[0, :3, :3].T)
    deltas = np.column_stack([T[:, :3, 3] - T0[0, :3, 3], dr, lie.wrapped(base - base0), torso - torso0])
    J = segment.chart.jacobian(said.mean, carrier)
    predicted = (J @ S @ J.swapaxes(1, 2))[0]
    sigma = np.sqrt(np.diag(predicted))
    np.testing.assert_allclose(np.cov(deltas.T) / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.04)
    assert np.abs(segment.chart.poses(said.mean).T_carrier_tool[0, :3, :3] - np.eye(3)).max() > 0.3  # a real turn


# --- reproduction


@pytest.mark.parametrize("task", TASKS)
def test_segments_meet_without_jumps_and_at_rest(models, task):
    robot = RobotPose(rest(task) @ rigid(np.eye(3), np.array([0.9, 0.3, 0.1])), np.array([1.8, 0.7, 2.0]), 0.2)
    rate = 1000.0
    run = models[task].reproduce(rest(task), rate_hz=rate, start=robot)
    turns = np.linalg.norm(
        lie.so3_log(run.T_world_tool[:-1, :3, :3].swapaxes(1, 2) @ run.T_world_tool[1:, :3, :3]), axis=1
    )
    steps = np.linalg.norm(np.diff(run.T_world_tool[:, :3, 3], axis=0), axis=1)
    base = np.linalg.norm(np.diff(run.xy_yaw, axis=0), axis=1)
    for k in (run.segments.grasp, run.segments.release):
        around = slice(k - 1, k + 1)  # the steps to and from the border
        assert steps[around].max() < 1e-3 and np.degrees(turns[around].max()) < 0.1
        for track in (steps, turns, base):  # per second: velocities vanish on both sides
            assert track[around].max() * rate < 0.02
    assert steps.max() * rate < 2.0 and turns.max() * rate < 3.0  # and nowhere else a jump
    assert steps.max() * rate > 0.1  # it does move
    np.testing.assert_allclose(run.T_world_tool[0], robot.T_world_tool, atol=1e-9)
    np.testing.assert_allclose(lie.wrapped(run.xy_yaw[0] - robot.xy_yaw), 0, atol=1e-9)
    assert run.torso_height[0] == pytest.approx(robot.torso_height)


@pytest.mark.parametrize("task", TASKS)
def test_moving_the_object_moves_the_motion(models, task):
    """Equivariance: over the floor exactly; up and down, the base stays on the floor."""
    T_move, model = over_floor(1.3, -2.0, 2.5, up=0.12), models[task]
    articulation = TASKS[task].articulation()
    here = model.reproduce(rest(task), articulation)
    there = model.reproduce(T_move @ rest(task), articulation.moved(T_move))
    np.testing.assert_allclose(there.T_world_tool, T_move @ here.T_world_tool, atol=1e-9)
    base = lie.se2_compose(floor_frame(T_move[None]), here.xy_yaw)
    np.testing.assert_allclose(there.xy_yaw[:, :2], base[:, :2], atol=1e-9)
    np.testing.assert_allclose(lie.wrapped(there.xy_yaw[:, 2] - base[:, 2]), 0, atol=1e-9)
    np.testing.assert_allclose(there.torso_height, here.torso_height + 0.12, atol=1e-9)
    turn = np.eye(10)
    turn[POSITION, POSITION] = turn[ROTATION, ROTATION] = T_move[:3, :3]
    turn[6:8, 6:8] = T_move[:2, :2]
    np.testing.assert_allclose(there.covariance, turn @ here.covariance @ turn.T, atol=1e-12)


@pytest.mark.parametrize("task", ["room_door", "swivel_door", "sliding_door"])
def test_other_hinge_side_gives_the_mirror_image(models, task):
    scene, model = TASKS[task], models[task]
    y = -1.0
    other = replace(scene, hinge=-1.0, direction=(0, y, 0) if task == "sliding_door" else scene.direction)
    assert model.object.side != 0
    here = model.reproduce(rest(task), scene.articulation())
    there = model.reproduce(rest(task), other.articulation())
    flip = np.diag([1.0, -1.0, 1.0])
    np.testing.assert_allclose(there.T_world_tool[:, :3, 3], here.T_world_tool[:, :3, 3] @ flip, atol=1e-9)
    np.testing.assert_allclose(there.xy_yaw[:, :2], here.xy_yaw[:, :2] * (1, -1), atol=1e-9)
    np.testing.assert_allclose(lie.wrapped(there.xy_yaw[:, 2] + here.xy_yaw[:, 2]), 0, atol=1e-9)
    np.testing.assert_allclose(there.q, here.q, atol=1e-12)
    # the way the gripper points is mirrored; the fingers' line is, up to swapping them; and it is a rotation
    R, mirrored = there.T_world_tool[:, :3, :3], flip @ here.T_world_tool[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.einsum("tij,tij->tj", R, mirrored)), 1, atol=1e-9)
    np.testing.assert_allclose(R[..., 0], mirrored[..., 0], atol=1e-9)
    # the grasp is not turned upside down: on the way to a handle before the robot it stays the side that was up
    k = here.segments.grasp
    assert np.einsum("i,i", R[k, :, 2], here.T_world_tool[k, :3, 2]) > 0.9
    twice = model.mirrored().mirrored().reproduce(rest(task), scene.articulation())
    np.testing.assert_allclose(twice.T_world_tool, here.T_world_tool, atol=1e-9)


def test_demonstrations_on_both_sides_make_one_model():
    scene = TASKS["swivel_door"]
    both = [
        demonstrate(replace(scene, hinge=side), np.random.default_rng(i), spread=NO_SPREAD)
        for i, side in enumerate((1.0, -1.0))
    ]
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    # the second demonstration is shown by a left-hander: the exact mirror image of the first
    first, tool = both[0], np.diag([1.0, -1.0, 1.0, 1.0])
    both[1] = replace(both[1], T_world_tool=flip @ first.T_world_tool @ tool, xy_yaw=first.xy_yaw * (1, -1, -1))
    one, two = learn(both[:1]), learn(both)
    a, b = (m.reproduce(rest("swivel_door"), scene.articulation()) for m in (one, two))
    assert np.abs(a.T_world_tool - b.T_world_tool).max() < 5e-3


@pytest.mark.parametrize("task", TASKS)
def test_one_demonstration_reproduces_itself(task):
    (shown,) = motions(task, 1, spread=NO_SPREAD)
    run = learn([shown]).reproduce(shown.T_world_object[0], shown.articulation)
    ends = [0, shown.segments.grasp, shown.segments.release, len(shown) - 1]
    own = np.array([0, run.segments.grasp, run.segments.release, len(run) - 1])
    at = np.interp(np.arange(len(shown)), ends, own)
    tool = np.column_stack([np.interp(at, np.arange(len(run)), x) for x in run.T_world_tool[:, :3, 3].T])
    base = np.column_stack([np.interp(at, np.arange(len(run)), x) for x in run.xy_yaw.T])
    R = run.T_world_tool[np.round(at).astype(int), :3, :3]
    turn = np.linalg.norm(lie.so3_log(R.swapaxes(1, 2) @ shown.T_world_tool[:, :3, :3]), axis=1)
    assert np.linalg.norm(tool - shown.T_world_tool[:, :3, 3], axis=1).mean() < 0.005
    assert np.degrees(turn).mean() < 1.0
    assert np.linalg.norm((base - shown.xy_yaw)[:, :2], axis=1).mean() < 0.01
    held = slice(run.segments.grasp, run.segments.release + 1)
    grasp = inverse(shown.T_world_object[shown.segments.grasp]) @ shown.T_world_tool[shown.segments.grasp]
    off = lie.se3_log(inverse(grasp) @ lie.se3_inverse(run.T_world_object[held]) @ run.T_world_tool[held])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 2e-3 and np.degrees(np.abs(off[:, 3:]).max()) < 0.2
    sigma = np.sqrt(run.covariance[10, 0, 0])
    assert 0.02 < sigma < 0.08  # one demonstration does not look like certainty


def test_other_dimensions_keep_the_grasp_and_the_arm(models):
    """A door of another radius, opened further: the gripper stays on the handle, the base as far from it as shown."""
    scene = replace(TASKS["swivel_door"], radius=0.55, travel=1.4)
    model, articulation = models["swivel_door"], scene.articulation()
    shown = model.reproduce(rest("swivel_door"), TASKS["swivel_door"].articulation())
    run = model.reproduce(articulation.T_rest, articulation, q_goal=1.4)
    assert run.q[0] == 0 and run.q[-1] == pytest.approx(1.4)
    assert len(run.q[run.segments.grasp : run.segments.release]) > len(
        shown.q[shown.segments.grasp : shown.segments.release]
    )
    held = slice(run.segments.grasp, run.segments.release + 1)
    np.testing.assert_allclose(articulation.position(run.T_world_object[held]), run.q[held], atol=1e-9)
    off = (lie.se3_inverse(run.T_world_object[held]) @ run.T_world_tool[held])[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 5e-3
    for k, j in ((run.segments.grasp, shown.segments.grasp), (run.segments.release, shown.segments.release)):
        ways = [r.T_world_object[i, :2, 3] - r.xy_yaw[i, :2] for r, i in ((run, k), (shown, j))]
        np.testing.assert_allclose(*ways, atol=0.16)  # the handle is 0.14 m further round: the base went along
    lower = replace(TASKS["drawer"], height=0.5, travel=0.45)
    low, usual = (
        models["drawer"].reproduce(s.articulation().T_rest, s.articulation(), 0.4) for s in (lower, TASKS["drawer"])
    )
    np.testing.assert_allclose(low.T_world_tool[:, 2, 3], usual.T_world_tool[:, 2, 3] - 0.2, atol=1e-9)
    np.testing.assert_allclose(low.xy_yaw, usual.xy_yaw, atol=1e-9)
    np.testing.assert_allclose(low.torso_height, usual.torso_height - 0.2, atol=1e-9)


def test_opening_rises_smoothly_from_rest_to_rest(models):
    for model in models.values():
        curve, time = progress_curve(model.progress), np.linspace(0, 1, 2001)
        assert (np.diff(curve(time)) >= -1e-12).all()
        assert curve([0, 1]) == pytest.approx([0, 1])
        assert curve.derivative()([0, 1]) == pytest.approx([0, 0], abs=1e-9)


@pytest.mark.parametrize("task", ["drawer", "swivel_door"])
def test_held_out_demonstrations_lie_within_the_covariance(task):
    model, held = learn(motions(task, 12, seed=7)), motions(task, 25, seed=8)
    for name in SEGMENTS:
        squared = []
        for motion in held:
            e, S = model.deviations(motion)[name]
            squared.append(
                [
                    np.einsum("ti,tij,tj->t", e[:, b], np.linalg.inv(S[:, b, b]), e[:, b]).mean() / 3
                    for b in (POSITION, ROTATION, BASE)
                ]
            )
        assert ((np.mean(squared, axis=0) > 0.2) & (np.mean(squared, axis=0) < 1.8)).all()
    e, S = zip(*(model.deviations(motion)["reach"] for motion in held), strict=True)
    z = np.concatenate(
        [
            a[:, [0, 1, 2, 6, 7, 8]] / np.sqrt(np.einsum("tii->ti", b)[:, [0, 1, 2, 6, 7, 8]])
            for a, b in zip(e, S, strict=True)
        ]
    )
    assert 0.9 < (np.abs(z) < 2).mean() < 0.99  # a normal distribution: 0.954


def test_spread_is_what_it_was_made_with():
    model = learn(motions("drawer", 30, seed=4))
    S = model.segments["reach"].predict(np.array([0.02])).covariance[0]
    assert np.sqrt(np.diag(S)[BASE]) == pytest.approx([0.05, 0.05, 0.05], rel=0.35)
    mean_s, spread_s = model.segments["reach"].duration_s
    assert spread_s / mean_s == pytest.approx(0.12, abs=0.05)


def test_alignment_by_warping_shrinks_the_spread_of_the_way():
    """People are early or late; the way is the same. Linear phases take that for a spread of the way."""
    rng, shown = np.random.default_rng(0), motions("drawer", 8, spread=NO_SPREAD)
    late = []
    for motion in shown:
        k = motion.segments.grasp
        time = motion.times_s.copy()
        u = np.linspace(0, 1, k + 1)
        bend = rng.uniform(-0.8, 0.8)
        time[: k + 1] = time[k] * (u + bend * u * (1 - u))
        late.append(replace(motion, times_s=time))
    size = {}
    for alignment in ("linear", "dtw"):
        S = learn(late, alignment=alignment).segments["reach"].predict(np.linspace(0.1, 0.9, 50)).covariance
        size[alignment] = np.sqrt(np.einsum("tii->ti", S)[:, POSITION].sum(axis=1)).mean()
    assert size["dtw"] < 0.7 * size["linear"]


def test_bad_input_is_named(models):
    (shown,) = motions("drawer", 1)
    with pytest.raises(UnderstudyError, match="at least"):
        learn([])
    with pytest.raises(UnderstudyError, match="'linear', 'dtw'"):
        learn([shown], alignment="magic")
    with pytest.raises(UnderstudyError, match="demonstration 0: reach has 2 samples"):
        learn([replace(shown, segments=Segments(2, 50))])
    with pytest.raises(UnderstudyError, match="demonstration 1 does not go with"):
        learn([shown, motions("swivel_door", 1)[0]])
    still = replace(shown, T_world_object=np.tile(shown.T_world_object[0], (len(shown), 1, 1)))
    with pytest.raises(UnderstudyError, match="moves by 0 mm"):
        learn([still])
    with pytest.raises(UnderstudyError, match="xy_yaw must be finite"):
        replace(shown, xy_yaw=np.full_like(shown.xy_yaw, np.nan))
    bent = shown.T_world_tool.copy()
    bent[3, 0, 0] += 0.5
    with pytest.raises(UnderstudyError, match="T_world_tool must be rigid"):
        replace(shown, T_world_tool=bent)
    with pytest.raises(UnderstudyError, match="off its articulation"):
        models["drawer"].reproduce(over_floor(0, 1, 0) @ rest("drawer"), TASKS["drawer"].articulation())
    with pytest.raises(UnderstudyError, match="learnt on a prismatic object, this one is revolute"):
        models["drawer"].reproduce(rest("swivel_door"), TASKS["swivel_door"].articulation())
    push = replace(TASKS["swivel_door"], direction=(0, 0, -1))
    with pytest.raises(UnderstudyError, match="opens away from it"):
        models["swivel_door"].reproduce(rest("swivel_door"), push.articulation())
    with pytest.raises(UnderstudyError, match="does not go up"):
        models["drawer"].reproduce(rest("drawer"), q_goal=-0.2)
    with pytest.raises(UnderstudyError, match="rate_hz"):
        models["drawer"].reproduce(rest("drawer"), rate_hz=0.0)


# --- skills


def test_skill_comes_back_exactly(tmp_path, models):
    for task, model in models.items():
        save_skill(tmp_path / task, Skill(model, task, "pr2", {"recordings": ["a", "b"]}))
        skill = load_skill(tmp_path / task)
        assert (skill.task, skill.robot, skill.provenance) == (task, "pr2", {"recordings": ["a", "b"]})
        a, b = (m.reproduce(m.object.T_start) for m in (model, skill.model))
        for name in ("T_world_tool", "xy_yaw", "torso_height", "covariance", "q", "times_s"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert skill.model.segments["reach"].duration_s == model.segments["reach"].duration_s
        assert sorted(p.name for p in (tmp_path / task).iterdir()) == ["skill.json", "skill.npz"]


def test_broken_skills_are_named(tmp_path, models):
    folder = tmp_path / "skill"
    with pytest.raises(RecordingError, match="no skill"):
        load_skill(folder)
    save_skill(folder, Skill(models["drawer"], "drawer", "pr2"))
    path, arrays = folder / "skill.json", folder / "skill.npz"
    text, content = path.read_text(), arrays.read_bytes()
    data = json.loads(text)
    for change, message in (
        ({"format": "skill/9"}, "reads 'skill/1'"),
        ({"progress": [0, 1]}, "progress must be 33"),
        ({"segments": {}}, "no 'reach'"),
        ({"features": ["phase"]}, "features are"),
        ({"object": {**data["object"], "T_start": [[1]]}}, "T_start must be"),
        ({"object": {**data["object"], "articulation": {"kind": "magic"}}}, "articulation"),
    ):
        path.write_text(json.dumps({**data, **change}))
        with pytest.raises(RecordingError, match=message):
            load_skill(folder)
    path.write_text(text)
    arrays.write_bytes(content[:-10] + b"0123456789")
    with pytest.raises(RecordingError, match="not the file that skill.json was written with"):
        load_skill(folder)
    arrays.unlink()
    with pytest.raises(RecordingError, match="not readable"):
        load_skill(folder)
    with pytest.raises(UnderstudyError, match="provenance"):
        save_skill(folder, Skill(models["drawer"], "drawer", "pr2", {"when": object()}))


def test_model_is_drawn(models):
    pytest.importorskip("matplotlib", reason="plots need the extra 'plots'")
    from understudy.actions.plots import action_model

    picture = action_model(models["swivel_door"], motions("swivel_door", 2), "swivel door")
    assert picture.startswith(b"\x89PNG") and len(picture) > 20000
