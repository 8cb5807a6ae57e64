import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from understudy.errors import UnderstudyError
from understudy.geometry import rigid, transform_points
from understudy.metrics import (
    METRICS,
    PCK_THRESHOLDS_M,
    Calibration,
    JointMetrics,
    MatchRule,
    Observations,
    PalmMetrics,
    evaluate,
    match_people,
    metric_values,
    observe,
    summarise,
)
from understudy.metrics.angles import angles_or_nan, bone_direction_errors, flexion, flexion_errors
from understudy.people_file import FramePeople
from understudy.recordings.truth import Truth, TruthPerson
from understudy.skeleton import FLIP, JOINT, JOINTS, N_JOINTS
from understudy.types import OBSERVED, Keypoints2D, Palm, Person

BODY = np.array(
    [
        (0, -0.65, 2.4), (0, -0.45, 2.5),
        (-0.2, -0.45, 2.5), (-0.3, -0.2, 2.5), (-0.35, 0.05, 2.4),
        (0.2, -0.45, 2.5), (0.3, -0.2, 2.5), (0.35, 0.05, 2.4),
        (-0.12, 0.05, 2.5), (-0.12, 0.5, 2.5), (-0.12, 0.9, 2.55),
        (0.12, 0.05, 2.5), (0.12, 0.5, 2.5), (0.12, 0.9, 2.55),
        (-0.03, -0.68, 2.42), (0.03, -0.68, 2.42), (-0.08, -0.66, 2.5), (0.08, -0.66, 2.5),
    ]
)  # fmt: skip
"""A standing person, metres"""


def body(x: float = 0.0) -> np.ndarray:
    return BODY + (x, 0, 0)


def true_person(keypoints: np.ndarray, id: int = 0, hidden: tuple[str, ...] = (), outside: tuple[str, ...] = ()):
    in_view, occluded = np.ones(N_JOINTS, dtype=bool), np.zeros(N_JOINTS, dtype=bool)
    in_view[[JOINT[n] for n in outside]] = False
    occluded[[JOINT[n] for n in hidden]] = True
    nobody = {"left": None, "right": None}
    return TruthPerson(id, keypoints, in_view, occluded, nobody, {"left": False, "right": False})


def person(keypoints: np.ndarray, id: int = 0, confidence: float = 0.9, sigma_m: float = 0.05, **hands: Palm) -> Person:
    return Person(
        Keypoints2D(np.ones((N_JOINTS, 2)), np.ones(N_JOINTS)),
        keypoints,
        np.full(N_JOINTS, confidence),
        np.full(N_JOINTS, sigma_m),
        (OBSERVED,) * N_JOINTS,
        id,
        {"left": None, "right": None} | hands,
    )


def failure() -> Person:
    return Person.failure(Keypoints2D(np.ones((N_JOINTS, 2)), np.ones(N_JOINTS)), "no depth")


def of_frames(*frames: tuple[list[Person], list[TruthPerson]]):
    predicted = [FramePeople(i, tuple(people)) for i, (people, _) in enumerate(frames)]
    return evaluate(predicted, Truth({i: tuple(truth) for i, (_, truth) in enumerate(frames)}))


def test_constant_offset_has_known_errors():
    e = of_frames(([person(body(0.03))], [true_person(body())]))
    joints = e.joints["all"]
    assert joints.n_truth == joints.n_given == 18
    assert joints.epe_m == pytest.approx(0.03) and joints.epe_median_m == pytest.approx(0.03)
    assert joints.coverage == joints.pck == joints.pck_given == 1.0
    assert joints.auc == pytest.approx(1 - 3 / 20)
    np.testing.assert_array_equal(joints.pck_curve, np.arange(201) >= 30)  # a step at 30 mm
    assert e.bone_direction_rad == pytest.approx(0, abs=1e-9) and e.flexion_rad == pytest.approx(0, abs=1e-9)
    assert e.swapped == 0 and e.n_side_pairs == 6
    assert e.per_joint["left_knee"].epe_m == pytest.approx(0.03)
    assert list(e.per_joint) == list(JOINTS)


def test_classes_are_told_apart():
    truth = true_person(body(), hidden=("left_hip", "left_knee"), outside=("left_ankle",))
    keypoints = body()
    keypoints[[JOINT["left_hip"], JOINT["left_knee"]]] += (0.0, 0.2, 0.0)
    keypoints[JOINT["left_ankle"]] += (0.0, 0.0, 0.3)
    e = of_frames(([person(keypoints)], [truth]))
    assert {k: v.n_truth for k, v in e.joints.items()} == {
        "all": 18, "visible": 15, "occluded": 2, "out_of_view": 1, "in_view": 17,
    }  # fmt: skip
    assert e.joints["visible"].epe_m == 0
    assert e.joints["occluded"].epe_m == pytest.approx(0.2) and e.joints["occluded"].pck == 0
    assert e.joints["out_of_view"].epe_m == pytest.approx(0.3)
    assert e.joints["all"].epe_m == pytest.approx((2 * 0.2 + 0.3) / 18)
    assert e.joints["in_view"].epe_m == pytest.approx(2 * 0.2 / 17)


def test_joints_left_out_are_wrong_in_pck_but_not_in_epe():
    keypoints = body(0.02)
    keypoints[:9] = np.nan
    keypoints[8] = (np.nan, 0, 0)  # half a row is no joint
    e = of_frames(([person(keypoints)], [true_person(body())]))
    joints = e.joints["all"]
    assert joints.epe_m == pytest.approx(0.02) and joints.n_given == 9
    assert joints.coverage == joints.pck == 0.5 and joints.pck_given == 1.0
    assert joints.auc == pytest.approx(0.5 * 0.9)
    assert e.n_side_pairs == 2 and e.swapped == 0  # knees and ankles
    assert e.calibration.n == e.calibration.n_sigma == 9
    assert math.isnan(e.per_joint["nose"].epe_m) and e.per_joint["nose"].coverage == 0


def test_truth_that_is_not_known_is_left_out():
    truth = body()
    truth[[JOINT["nose"], JOINT["right_hip"]]] = np.nan
    e = of_frames(([person(body(0.01))], [true_person(truth)]))
    assert e.joints["all"].n_truth == 16 and e.joints["all"].coverage == 1.0
    assert e.per_joint["nose"].n_truth == 0 and e.n_side_pairs == 5


def test_missed_false_and_failed_people():
    e = of_frames(
        ([person(body())], [true_person(body()), true_person(body(2.0), 1)]),  # one missed
        ([person(body()), person(body(-3.0))], [true_person(body())]),  # one false
        ([failure()], [true_person(body())]),  # failed, hence missed, not false
        ([], []),  # nobody, rightly
    )
    c = e.counts
    assert (c.frames, c.truth_people, c.missed, c.false, c.failed) == (4, 4, 2, 1, 1)
    values = metric_values(e)
    assert values["missed_percent"] == 50 and values["missed_per_frame"] == 0.5
    assert values["false_per_frame"] == values["failed_per_frame"] == 0.25
    assert e.joints["all"].pck == 0.5 and e.joints["all"].pck_given == 1.0 and e.joints["all"].epe_m == 0


def test_absent_and_skipped_frames_count_as_missed():
    truth = Truth({i: (true_person(body()),) for i in range(3)})
    predicted = [FramePeople(0, (person(body()),)), FramePeople(1, (), skipped="broken"), FramePeople(9, ())]
    e = evaluate(predicted, truth)
    c = e.counts
    assert (c.frames, c.skipped_frames, c.absent_frames, c.frames_without_truth, c.missed) == (3, 1, 1, 1, 2)
    assert e.joints["all"].coverage == pytest.approx(1 / 3)
    with pytest.raises(UnderstudyError, match="frame 0 is predicted twice"):
        evaluate([predicted[0], predicted[0]], truth)


def test_people_out_of_view_or_without_truth_do_not_count():
    outside = true_person(body(3.0), 1, outside=JOINTS)
    unknown = true_person(np.full((N_JOINTS, 3), np.nan), 2)
    e = of_frames(([person(body()), person(body(3.0))], [true_person(body()), outside, unknown]))
    c = e.counts
    assert (c.truth_people, c.uncounted_people, c.missed, c.false) == (1, 2, 0, 0)


def test_nothing_at_all_gives_no_numbers_and_no_warning():
    for e in (of_frames(), of_frames(([], [])), of_frames(([], [true_person(body())]))):
        values = metric_values(e)
        assert math.isnan(values["epe_cm_all"]) and math.isnan(values["bone_direction_deg"])
        assert math.isnan(values["ece_percent"]) and math.isnan(values["palm_mean_deg"])
    assert values["pck10_percent_all"] == 0 and values["auc_all"] == 0  # the missed person
    assert set(values) == {m.key for m in METRICS} and all(m.definition for m in METRICS)


def test_a_badly_lifted_person_is_still_matched():
    keypoints = body()
    keypoints[3:] += (0, 0, 2.0)  # all but three joints on the wall behind
    e = of_frames(([person(keypoints)], [true_person(body())]))
    assert e.counts.missed == e.counts.false == 0
    assert e.joints["all"].epe_m == pytest.approx(2.0 * 15 / 18)
    keypoints[2] += (0, 0, 2.0)
    e = of_frames(([person(keypoints)], [true_person(body())]))
    assert e.counts.missed == e.counts.false == 1


def test_matching_takes_the_best_pairs():
    truth = np.stack([body(0.0), body(0.4)])
    predicted = np.stack([body(0.42), body(-3.0), body(0.05)])
    np.testing.assert_array_equal(match_people(predicted, truth), [[2, 0], [0, 1]])
    assert match_people(predicted[:0], truth).shape == match_people(predicted, truth[:0]).shape == (0, 2)


def test_matching_does_not_break_a_good_pair_to_make_two_bad_ones():
    truth, predicted = np.stack([body(0.0), body(0.48)]), np.stack([body(0.0), body(-0.48)])
    np.testing.assert_array_equal(match_people(predicted, truth), [[0, 0]])
    assert "0.5 m" in MatchRule().definition


def test_swapped_sides():
    e = of_frames(([person(body()[FLIP])], [true_person(body())]))
    assert e.swapped == 1.0 and e.n_side_pairs == 6
    arms = body()
    swap = [JOINT[f"{side}_wrist"] for side in ("left", "right")]
    arms[swap] = arms[swap[::-1]]
    e = of_frames(([person(arms)], [true_person(body())]))
    assert e.swapped == pytest.approx(1 / 6)
    narrow = body() * (0.2, 1, 1)  # only the elbows and the wrists are 10 cm apart
    assert of_frames(([person(narrow[FLIP])], [true_person(narrow)])).n_side_pairs == 2


def test_one_side_nearer_to_the_other_is_no_swap():
    keypoints = body()
    keypoints[JOINT["left_ankle"]] = keypoints[JOINT["right_ankle"]]  # both feet on the right one
    assert of_frames(([person(keypoints)], [true_person(body())])).swapped == 0


def test_angles():
    truth, bent = body()[None], body()[None]
    elbow, wrist = JOINT["right_elbow"], JOINT["right_wrist"]
    forearm = truth[0, wrist] - truth[0, elbow]
    axis = np.cross(forearm, truth[0, JOINT["right_shoulder"]] - truth[0, elbow])
    turn = Rotation.from_rotvec(0.3 * axis / np.linalg.norm(axis))
    bent[0, wrist] = bent[0, elbow] + turn.apply(forearm)
    bones = bone_direction_errors(bent, truth)
    assert bones.shape == (1, 8) and np.sort(bones[0])[-1] == pytest.approx(0.3)
    assert bones.sum() == pytest.approx(0.3)
    assert flexion_errors(bent, truth).sum() == pytest.approx(0.3)
    assert flexion(truth)[0, 2] == pytest.approx(np.pi - np.arctan(0.05 / 0.4), abs=1e-6)
    bent[0, elbow] = np.nan
    assert np.isnan(bone_direction_errors(bent, truth)).sum() == 2 and np.isnan(flexion_errors(bent, truth)).sum() == 1
    assert np.isnan(angles_or_nan(np.zeros((1, 3)), np.ones((1, 3)))).all()


def palm_at(degrees: float) -> np.ndarray:
    return np.array([math.sin(math.radians(degrees)), 0.0, -math.cos(math.radians(degrees))])


def test_palms():
    truth = replace(
        true_person(body()),
        palms={"left": palm_at(0), "right": palm_at(0)},
        hands_in_view={"left": True, "right": True},
    )
    unseen = replace(truth, hands_in_view={"left": False, "right": False})
    e = of_frames(
        ([person(body(), left=Palm(palm_at(10), 1.0), right=Palm(palm_at(170), 1.0))], [truth]),
        ([person(body(), left=Palm(palm_at(30), 1.0))], [truth]),
        ([], [truth]),
        ([person(body(), left=Palm(palm_at(90), 1.0))], [unseen]),
    )
    p = e.palms
    assert (p.n_truth, p.n_given) == (6, 3) and p.coverage == 0.5
    assert math.degrees(p.mean_rad) == pytest.approx(70) and math.degrees(p.median_rad) == pytest.approx(30)
    assert p.within_30_deg == pytest.approx(2 / 6) and p.flipped == pytest.approx(1 / 3)
    none = np.full((1, 2, 3), np.nan)
    assert PalmMetrics.of(none, none, np.ones((1, 2), dtype=bool)).n_truth == 0


def test_id_switches():
    def frame(*ids):
        return [person(body(2.0 * i), id) for i, id in enumerate(ids)], [true_person(body()), true_person(body(2.0), 1)]

    e = of_frames(frame(7, 8), frame(7, 8), frame(8, 7), ([], frame(0, 0)[1]), frame(8, 9))
    assert e.counts.id_switches == 3  # 7 -> 8; 8 -> 7, then over the gap 7 -> 9
    assert of_frames(frame(7, 8), frame(7, 8)).counts.id_switches == 0


def test_calibration_of_a_calibrated_predictor():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(size=200_000)
    errors = np.where(rng.uniform(size=confidence.size) < confidence, 0.05, 0.2)
    sigma = rng.uniform(0.01, 0.1, size=confidence.size)
    c = Calibration.of(errors, confidence, sigma)
    assert c.ece < 0.01 and c.bin_count.sum() == c.n == confidence.size
    one_axis = sigma / np.sqrt(chi2.ppf(0.68, 3))  # sigma is the radius that holds 68 %
    gaussian = np.linalg.norm(rng.normal(size=(confidence.size, 3)) * one_axis[:, None], axis=-1)
    c = Calibration.of(gaussian, confidence, sigma)
    assert c.within_1_sigma == pytest.approx(0.68, abs=0.005)
    assert c.within_2_sigma == pytest.approx(0.9971, abs=0.002)


def test_calibration_of_a_boaster():
    errors = np.array([0.05, 0.2, 0.2, 0.2, np.nan])
    c = Calibration.of(errors, np.array([0.95, 0.95, 0.95, 0.95, 0.1]), np.full(5, 0.1))
    assert c.n == 4 and c.ece == pytest.approx(0.70)
    assert c.bin_share[9] == 0.25 and np.isnan(c.bin_share[:9]).all()
    assert c.within_1_sigma == 0.25 and c.within_2_sigma == 1.0


def test_pooling_recordings_weighs_joints_not_recordings():
    small = [FramePeople(0, (person(body(0.1)),))], Truth({0: (true_person(body()),)})
    large = (
        [FramePeople(i, (person(body(0.02), id=4),)) for i in range(3)],
        Truth({i: (true_person(body()),) for i in range(3)}),
    )
    e = summarise(Observations.pooled([observe(*small), observe(*large)]))
    assert e.joints["all"].epe_m == pytest.approx((0.1 + 3 * 0.02) / 4)
    assert e.counts.frames == 4 and e.counts.id_switches == 0
    with pytest.raises(UnderstudyError, match="at least one"):
        Observations.pooled([])


def random_scene(seed: int):
    """Predictions and truths of a few people in one frame, with joints left out, people missed and false."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    truth = [body(1.5 * i) + rng.normal(0, 0.05, (18, 3)) for i in range(n)]
    predicted = [t + rng.normal(0, rng.uniform(0.01, 0.15), (18, 3)) for t in truth if rng.uniform() < 0.8]
    predicted += [body(-4.0)] * int(rng.integers(0, 2))
    for p in predicted:
        p[rng.uniform(size=18) < 0.2] = np.nan
    hidden = tuple(rng.choice(JOINTS, 4))
    return predicted, [true_person(t, i, hidden=hidden) for i, t in enumerate(truth)], rng


def same(a, b):
    a, b = metric_values(a), metric_values(b)
    assert a.keys() == b.keys()
    np.testing.assert_allclose(list(a.values()), list(b.values()), rtol=1e-6, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_order_of_people_does_not_matter(seed):
    predicted, truth, rng = random_scene(seed)
    e = of_frames(([person(p) for p in predicted], truth))
    shuffled = [predicted[i] for i in rng.permutation(len(predicted))]
    same(e, of_frames(([person(p) for p in shuffled], [truth[i] for i in rng.permutation(len(truth))])))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_a_rigid_motion_of_everything_does_not_matter(seed):
    predicted, truth, rng = random_scene(seed)
    T = rigid(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    e = of_frames(([person(p) for p in predicted], truth))
    moved = [replace(t, keypoints=transform_points(T, t.keypoints)) for t in truth]
    same(e, of_frames(([person(transform_points(T, p)) for p in predicted], moved)))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.floats(0, 1), st.just(np.nan)), min_size=1, max_size=50))
def test_pck_rises_to_at_most_the_coverage_and_auc_is_its_area(errors):
    j = JointMetrics.of(np.array(errors, dtype=float))
    assert (np.diff(j.pck_curve) >= 0).all() and j.pck_curve[0] >= 0 and j.pck_curve[-1] <= j.coverage
    area = np.trapezoid(j.pck_curve, PCK_THRESHOLDS_M) / PCK_THRESHOLDS_M[-1]
    assert j.auc == pytest.approx(area, abs=0.5 / 200 + 1e-9)  # the trapezoids miss each step by half a sample
    if j.n_given:
        assert j.pck == pytest.approx(j.pck_given * j.coverage)
