"""The comparison of methods: who is who, numbers by hand, page and plots."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from understudy.benchmark import comparison_report, methods
from understudy.benchmark.comparison import RUN, Group, Lifted, lift_group
from understudy.benchmark.comparison_report import PLOTS, Trainings, held_out_name, main_table, write_report
from understudy.benchmark.methods import NAMES, NETWORK, OURS, Method, Weights, available
from understudy.benchmark.scores import evaluate_lifted, pck_over_distance, scores
from understudy.benchmark.subjects import (
    DETECTIONS,
    QUALITIES,
    TRUE,
    TRUE_VISIBLE,
    Subjects,
    distance_to_bones,
    is_frontal,
    match_2d,
    number_of,
)
from understudy.errors import UnderstudyError
from understudy.lifting import NaiveLifter
from understudy.recordings import open as open_recording
from understudy.recordings import write_recording
from understudy.recordings.truth import Truth, TruthPerson
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Keypoints2D

PNG = b"\x89PNG\r\n\x1a\n"


def person(z: float = 2.0, back: bool = False) -> np.ndarray:
    """Someone who stands upright and faces the camera (or turns their back to it), metres."""
    left = {
        "left_shoulder": (0.17, -0.5), "left_elbow": (0.2, -0.2), "left_wrist": (0.22, 0.05), "left_hip": (0.1, 0.0),
        "left_knee": (0.1, 0.42), "left_ankle": (0.1, 0.8), "left_eye": (0.03, -0.75), "left_ear": (0.07, -0.74),
    }  # fmt: skip
    out = np.zeros((N_JOINTS, 3))
    for name, (x, y) in left.items():
        out[JOINT[name]], out[JOINT[name.replace("left", "right")]] = (x, y, 0), (-x, y, 0)
    out[JOINT["neck"]], out[JOINT["nose"]] = (0, -0.5, 0), (0, -0.7, 0)
    return out * (-1 if back else 1, 1, 1) + (0, 0, z)


def subjects() -> Subjects:
    """Two people: one seen from the front, 2 m away; one from behind, 4 m away, with their legs behind a table."""
    truth = np.stack([person(2.0), person(4.0, back=True)])
    covered = np.zeros((2, N_JOINTS), bool)
    covered[1, [JOINT[f"{s}_{n}"] for s in ("left", "right") for n in ("knee", "ankle")]] = True
    in_view = np.ones((2, N_JOINTS), bool)
    in_view[0, JOINT["left_ankle"]] = False
    uv = truth[..., :2] / truth[..., 2:] * 500 + (320, 240)
    detected = np.concatenate([uv + (3, 4), np.full((2, N_JOINTS, 1), 0.8)], -1)
    detected[1, JOINT["nose"]] = 0
    frontal = np.array([is_frontal(t) for t in truth])
    return Subjects(
        np.full(2, number_of("kitchen-anny")), np.array([0, 1]), truth, in_view, covered.copy(), covered, frontal, uv,
        detected, np.array([1]), np.array([0]),
    )  # fmt: skip


def lifted(s: Subjects, error_m: tuple[float, float], missing: tuple[str, ...] = (), swap: bool = False) -> Lifted:
    """Every joint of a person is off by the same amount; `missing` joints of the second person are not given."""
    keypoints = s.truth + np.array(error_m)[:, None, None] * np.array([0.6, 0.8, 0])
    for name in missing:
        keypoints[1, JOINT[name]] = np.nan
    if swap:
        a, b = JOINT["left_wrist"], JOINT["right_wrist"]
        keypoints[0, [a, b]] = keypoints[0, [b, a]]
    given = np.isfinite(keypoints[..., 0])
    return Lifted(keypoints, np.where(given, 0.75, np.nan), np.where(given, 0.06, np.nan), ~given.any(1))


@pytest.fixture
def group() -> Group:
    s = subjects()
    some = lifted(s, (0.02, 0.08), ("nose", "left_ankle"))
    good = lifted(s, (0.01, 0.12))
    every = {(q, m): good for q in QUALITIES for m in NETWORK}
    more = {(DETECTIONS, RUN + "anny"): good, (DETECTIONS, held_out_name("kitchen")): some}
    return Group("Kitchen", "kitchen", ("kitchen-anny",), s, {(DETECTIONS, "naive"): some, **every, **more})


def test_the_example_is_what_it_says():
    s = subjects()
    np.testing.assert_array_equal(s.frontal, [True, False])
    np.testing.assert_array_equal(s.hard, [False, True])
    assert s.counted.sum() == 35 and s.distance == pytest.approx([2.02, 4.01], abs=0.05)


def test_numbers_by_hand(group):
    """Person 1: 17 joints in view, 2 cm. Person 2: 18, of which 16 given, 8 cm; 4 occluded, 3 of them given."""
    table = scores(group, {"naive": (DETECTIONS, "naive"), "ours": (DETECTIONS, OURS)})
    naive, ours = table["naive"], table["ours"]
    assert naive.epe_m == pytest.approx((17 * 0.02 + 16 * 0.08) / 33)
    assert naive.hard_m == pytest.approx(0.08) and naive.occluded_m == pytest.approx(0.08)
    assert naive.visible_m == pytest.approx((17 * 0.02 + 13 * 0.08) / 30)
    assert naive.given == pytest.approx(33 / 35) and naive.pck == pytest.approx(33 / 35)
    assert naive.auc == pytest.approx((17 * 0.9 + 16 * 0.6) / 35)
    assert naive.auc_hard == pytest.approx(16 * 0.6 / 18) and naive.auc_occluded == pytest.approx(3 * 0.6 / 4)
    assert ours.epe_m == pytest.approx((17 * 0.01 + 18 * 0.12) / 35)
    assert ours.common_m == pytest.approx((17 * 0.01 + 16 * 0.12) / 33) and ours.pck == pytest.approx(17 / 35)
    assert naive.swapped == ours.swapped == 0 and naive.failed == 0
    line = main_table(table).splitlines()[2]
    assert line == "| naive | 4.9 | 8.0 | 4.6 | 8.0 | 4.9 | 94.3 | 94.3 | 0.711 | 0.533 | 0.450 | 0.0 | 0 |"


def test_swaps_sigma_and_confidence_by_hand():
    s = subjects()
    e = evaluate_lifted(s, lifted(s, (0.02, 0.08), swap=True))
    assert e.n_side_pairs == 11 and e.swapped == pytest.approx(1 / 11)  # person 1 has one ankle in view
    assert e.calibration.within_1_sigma == pytest.approx(15 / 35)  # of 17 joints at 2 cm the two wrists are swapped
    assert e.calibration.ece == pytest.approx(abs(0.75 - 33 / 35))
    failed = lifted(s, (np.nan, 0.0))
    assert evaluate_lifted(s, failed).counts.failed == 1


def test_pck_over_distance_by_hand():
    s = subjects()
    shares, counts = pck_over_distance(s, lifted(s, (0.02, 0.12)), (1, 3, 5))
    np.testing.assert_array_equal(counts, [17, 18])
    assert np.isnan(shares).all()  # too few
    many = Subjects.pooled([s, s])
    both = Lifted.pooled([lifted(s, (0.02, 0.12))] * 2)
    np.testing.assert_allclose(pck_over_distance(many, both, (1, 3, 5))[0], [1, 0])


def test_qualities():
    s = subjects()
    assert list(QUALITIES)[:3] == [TRUE, TRUE_VISIBLE, DETECTIONS]
    true, visible, twice, fewer = (QUALITIES[q](s) for q in list(QUALITIES) if q != DETECTIONS)
    assert (true[..., 2] > 0).sum() == 35 and (visible[..., 2] > 0).sum() == 31
    found = s.detected[..., 2] > 0
    np.testing.assert_allclose((twice[..., :2] - s.true_uv)[found], np.tile([6.0, 8.0], (35, 1)))
    assert not twice[~found].any()
    assert 0 < (fewer[..., 2] > 0).sum() < 35
    np.testing.assert_array_equal(fewer, QUALITIES["detections, 20 % dropped"](subjects()))


def test_who_is_who():
    near, far = (person(z)[:, :2] / z * 500 + (320, 240) for z in (2.0, 4.0))
    seen = [Keypoints2D(uv + 5, np.ones(N_JOINTS)) for uv in (far, near + (100, 0))]
    seen.append(Keypoints2D(near + (900, 0), np.ones(N_JOINTS)))
    inside = [np.ones(N_JOINTS, bool)] * 2
    assert match_2d([near, far], inside, seen) == [(0, 1), (1, 0)]
    assert match_2d([near], inside[:1], []) == [] and match_2d([near], inside[:1], seen[2:]) == []


def test_distance_to_bones():
    points = np.array([[0.0, 0.2, 1.5], [0.1, 0.21, 2.0], [np.nan, 0, 0]])
    far, on_thigh, nothing = distance_to_bones(points, person())
    assert far == pytest.approx(np.hypot(0.5, 0.1), abs=1e-6) and on_thigh == pytest.approx(0, abs=1e-6)
    assert np.isnan(nothing)
    assert np.isnan(distance_to_bones(points, np.full((N_JOINTS, 3), np.nan))).all()


@pytest.fixture
def wall(flat_frame, tmp_path) -> Path:
    """Someone inside the wall, 6 cm behind its surface; a detection of them, and one of nobody."""
    truth = person(2.06)
    uv = flat_frame.camera.color.project(truth)
    in_view = flat_frame.camera.color.contains(uv)
    seen = Keypoints2D.where(uv + 2, np.where(in_view, 0.9, 0.0))
    nobody = Keypoints2D.where(uv + (400, 0), np.where(in_view, 0.9, 0.0))
    people = Truth({0: (TruthPerson(0, truth, in_view, np.zeros(N_JOINTS, bool)),)})
    write_recording(tmp_path / "wall", [flat_frame], truth=people, keypoints2d={0: [nobody, seen]})
    return tmp_path / "wall"


def test_lifting_is_kept(wall, tmp_path):
    methods = {"naive": Method("naive", NaiveLifter, "v1")}
    first = lift_group("Wall", "wall", [open_recording(wall)], methods, tmp_path / "cache")
    assert len(first.subjects.frame) == 1 and first.subjects.unmatched.sum() == 1 and first.subjects.frontal.all()
    assert set(first.lifted) == {(q, "naive") for q in QUALITIES}
    e = evaluate_lifted(first.subjects, first.lifted[TRUE, "naive"])
    assert e.joints["in_view"].epe_median_m == pytest.approx(0.06, abs=0.01)

    def never() -> NaiveLifter:
        raise AssertionError("what is in the cache must not run again")

    again = lift_group("W", "w", [open_recording(wall)], {"naive": Method("naive", never, "v1")}, tmp_path / "cache")
    for key, value in first.lifted.items():
        np.testing.assert_array_equal(again.lifted[key].keypoints, value.keypoints)
    with pytest.raises(AssertionError, match="must not run"):
        lift_group("W", "w", [open_recording(wall)], {"naive": Method("naive", never, "v2")}, tmp_path / "cache")
    with pytest.raises(UnderstudyError, match="named alike"):
        lift_group("W", "w", [open_recording(wall)] * 2, methods, tmp_path / "cache")


def test_a_recording_without_detections_is_refused(flat_frame, tmp_path):
    write_recording(tmp_path / "r", [flat_frame], truth=Truth({0: ()}))
    with pytest.raises(UnderstudyError, match=r"r: the comparison needs .* no keypoints2d\.json"):
        lift_group("R", "r", [open_recording(tmp_path / "r")], {}, tmp_path / "cache")


def test_the_page_and_its_plots(group, tmp_path):
    pytest.importorskip("matplotlib")
    trainings = Trainings(("anny",), ("kitchen",), ("capsules: left out",), {"anny": 5120})
    write_report(tmp_path, [group], trainings, ["mlp: left out"])
    page, other = ((tmp_path / name).read_text() for name in ("README.md", comparison_report.TRAININGS))
    good, some = (17 * 0.95 + 18 * 0.4) / 35, (17 * 0.9 + 16 * 0.6) / 35
    assert f"| anny | 5,120 | {good:.3f} (6.7) |" in other and "These runs are shorter" in other
    assert f"| kitchen, Kitchen | - | {some:.3f} (4.9) | {good:.3f} (6.7) |" in other
    assert f"({comparison_report.TRAININGS})" in page
    assert "- mlp: left out\n- capsules: left out" in page and "Not detected: 1 people" in page
    assert f"| {OURS} on true 2D |" in page
    for name in PLOTS:
        png = (tmp_path / f"kitchen-{name}.png").read_bytes()
        assert png.startswith(PNG) and len(png) > 10_000 and f"(kitchen-{name}.png)" in page


def test_a_kept_out_sensor_stands_beside_a_training_as_long_with_it(group):
    with_it, without = group.lifted[DETECTIONS, f"{RUN}anny"], group.lifted[DETECTIONS, held_out_name("kitchen")]
    lifted = group.lifted | {(DETECTIONS, f"{RUN}both"): with_it}
    table = list(comparison_report._trainings([replace(group, lifted=lifted)], Trainings(("both",), ("kitchen",))))[-1]
    good, some = (17 * 0.95 + 18 * 0.4) / 35, (17 * 0.9 + 16 * 0.6) / 35
    assert without is not with_it and "| as long, trained with it (- people) |" in table
    assert f"| kitchen, Kitchen | - | {some:.3f} (4.9) | {good:.3f} (6.7) | {good:.3f} (6.7) |" in table


def test_the_page_on_trainings_stays_until_there_are_others(group, tmp_path, monkeypatch):
    monkeypatch.setattr(comparison_report, "draw", lambda group: {})
    write_report(tmp_path, [group], Trainings(), [])
    assert not (tmp_path / comparison_report.TRAININGS).exists()
    assert comparison_report.TRAININGS not in (tmp_path / "README.md").read_text()
    (tmp_path / comparison_report.TRAININGS).write_text("of last week")
    write_report(tmp_path, [group], Trainings(notes=("capsules: left out",)), [], {"mlp": "5 simulated people"})
    assert (tmp_path / comparison_report.TRAININGS).read_text() == "of last week"
    page = (tmp_path / "README.md").read_text()
    assert f"({comparison_report.TRAININGS})" in page and "- mlp: 5 simulated people" in page
    assert "capsules: left out" not in page  # it stands in the other page


def test_runs_of_the_papers_network_say_how_long_they_were_trained(tmp_path):
    pytest.importorskip("torch")
    about = {"config": {"network": "paper-fast", "batch": 2, "schedule": "steps", "decay_every": 50, "bf16": True,
                        "learning_rate": 1e-4}, "processes": 2}  # fmt: skip
    (tmp_path / "config.json").write_text(json.dumps(about))
    (tmp_path / "log.csv").write_text("step,hours,loss\n50,0.5,2\n75,1.26,1\n")
    with pytest.raises(UnderstudyError, match=r"weights\.safetensors"):
        methods._REGISTRY["paper-fast"]("paper-fast", Weights(paper_fast=tmp_path))
    (tmp_path / "weights.safetensors").write_bytes(b"any")
    method = methods._REGISTRY["paper-fast"]("paper-fast", Weights(paper_fast=tmp_path))
    assert method.trained == (
        "75 steps of 4 simulated people, 1.3 hours on cpu in bfloat16, learning rate 0.0001, a tenth of it after every "
        "50 steps"
    )


def test_missing_weights_are_noted(tmp_path):
    absent = tmp_path / "absent.safetensors"
    methods, notes = available(Weights(absent, absent, absent))
    assert list(methods) == ["naive", "naive-offset"]
    assert [n.partition(":")[0] for n in notes] == [n for n in NAMES if n not in methods]
    assert all("left out" in n for n in notes) and sum("absent.safetensors" in n for n in notes) == 5


def test_one_command(wall, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[1] / "benchmarks"), *sys.path])
    import paper_tables

    monkeypatch.setattr(comparison_report, "draw", lambda group: {})  # drawn in another test

    absent = str(tmp_path / "absent")
    paper_tables.main(
        ["--out", str(tmp_path / "out"), "--no-simulated", "--recordings", str(wall), "--cache", str(tmp_path / "c"),
         "--weights", absent, "--mlp", absent, "--runs", f"anny={absent}", "--held-out", f"azure={absent}"]
    )  # fmt: skip
    page = (tmp_path / "out" / "README.md").read_text()
    for text in ("run anny: left out", "run without azure: left out", "trained on both: left out", "| naive-offset |"):
        assert text in page
    with pytest.raises(UnderstudyError, match="NAME=RUN"):
        paper_tables.pairs("anny")
