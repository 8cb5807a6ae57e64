"""Frame in, people out, on a real frame: what has to be true of four men standing on a street."""

import numpy as np
import pytest

from understudy import Estimator, recordings
from understudy.skeleton import FACE, JOINT, TORSO, rows
from understudy.types import Frame, Keypoints2D, Person

TORSO_Z = (3.68, 3.61, 4.29, 2.59)  # metres, left to right: the recording's SOURCE.txt


@pytest.fixture(scope="module")
def men(models, freiburg) -> list[Person]:
    people = Estimator().estimate(recordings.open(freiburg)[0])
    return sorted(people, key=lambda p: p.keypoints_2d.uv[JOINT["neck"], 0])


def test_four_people_none_twice_at_their_distances(men):
    assert len(men) == 4
    assert sorted(p.id for p in men) == [0, 1, 2, 3]
    z = [float(np.nanmedian(p.keypoints[TORSO, 2])) for p in men]
    np.testing.assert_allclose(z, TORSO_Z, atol=0.15)


def test_heads_are_above_feet(men):
    for p in men:
        head, feet = p.keypoints[FACE, 1], p.keypoints[rows("right_ankle", "left_ankle"), 1]
        assert 1.2 < np.nanmin(feet) - np.nanmax(head) < 1.8  # y points down; eyes and ankles of a standing man


def shoulder_width(p: Person) -> float:
    return float(np.linalg.norm(p.keypoints[JOINT["right_shoulder"]] - p.keypoints[JOINT["left_shoulder"]]))


@pytest.mark.parametrize("who", [2, 3])
def test_shoulder_widths_of_those_who_face_the_camera(men, who):
    assert 0.25 < shoulder_width(men[who]) < 0.55


@pytest.mark.parametrize("who", [0, 1])
@pytest.mark.xfail(strict=True, reason="naive lifting puts the far shoulder of a man in profile on his near side")
def test_shoulder_widths_of_those_in_profile(men, who):
    """Known miss of the baseline (0.12 and 0.20 m); the voxel network has to mend it, and then this test says so."""
    assert 0.25 < shoulder_width(men[who]) < 0.55


def test_joints_project_onto_their_keypoints(men, freiburg):
    camera = recordings.open(freiburg).camera.color
    for p in men:
        given = np.isfinite(p.keypoints).all(1)
        np.testing.assert_allclose(camera.project(p.keypoints[given]), p.keypoints_2d.uv[given], atol=1e-6)


def test_sample_is_found_where_it_is(models):
    """The bundled recording: both people in every frame, visible joints at their true places within naive's limits."""
    from understudy.metrics import evaluate
    from understudy.people_file import FramePeople

    recording = recordings.open("sample")
    estimator = Estimator()
    frames = [FramePeople(i, tuple(estimator.estimate(recording.frame(i)))) for i in recording.indices[::4]]
    assert recording.truth is not None
    truth = type(recording.truth)({f.index: recording.truth.frames[f.index] for f in frames})
    scores = evaluate(frames, truth)
    assert (scores.counts.missed, scores.counts.false) == (0, 0)
    assert scores.joints["visible"].epe_m < 0.07
    assert scores.joints["visible"].coverage > 0.97


class Fixed:
    """A detector that always sees the same."""

    name = "fixed"

    def __init__(self, *people: Keypoints2D):
        self.people = list(people)
        self.indices: list[int] = []

    def detect(self, color, depth=None, index=0):
        self.indices.append(index)
        return self.people


def test_any_detector_will_do(flat_frame: Frame):
    rows_ = np.column_stack([np.linspace(100, 800, 18), np.linspace(100, 500, 18), np.ones(18)])
    detector = Fixed(Keypoints2D.from_rows(rows_), Keypoints2D.from_rows(rows_ - (5, 5, 0)))
    estimator = Estimator(detector=detector)
    people = estimator.estimate(flat_frame)
    assert [p.id for p in people] == [0, 1] and detector.indices == [0]
    again = estimator.estimate(estimator.register(flat_frame))  # registered already
    np.testing.assert_array_equal(again[0].keypoints, people[0].keypoints)
    np.testing.assert_allclose(people[1].keypoints[:, 2], 2.0)
