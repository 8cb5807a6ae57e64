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


@pytest.mark.parametrize("who", range(4))
def test_shoulder_widths(men, who):
    """Two of them stand in profile: a depth under the far shoulder is the near one's."""
    assert 0.25 < shoulder_width(men[who]) < 0.55


@pytest.mark.parametrize("who", range(4))
def test_both_sides_are_alike(men, who):
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
        right, left = (
            np.linalg.norm(men[who].keypoints[JOINT[f"{side}_{a}"]] - men[who].keypoints[JOINT[f"{side}_{b}"]])
            for side in ("right", "left")
        )
        assert abs(right - left) < 0.15 * max(right, left), (a, b)


@pytest.mark.parametrize("who", range(4))
def test_statures_of_men(men, who):
    """Along the bones from the soles to the top of the head; ankles are 0.08 m high, and 0.11 m is above the eyes."""
    joint = dict(zip(JOINT, men[who].keypoints, strict=True))
    hips, eyes = ((joint[f"right_{n}"] + joint[f"left_{n}"]) / 2 for n in ("hip", "eye"))

    def length(*places: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())

    legs = [length(joint[f"{s}_hip"], joint[f"{s}_knee"], joint[f"{s}_ankle"]) for s in ("right", "left")]
    assert 1.55 < length(eyes, joint["neck"], hips) + float(np.mean(legs)) + 0.08 + 0.11 < 1.95


def test_naive_joints_project_onto_their_keypoints(models, freiburg):
    recording = recordings.open(freiburg)
    camera = recording.camera.color
    for p in Estimator("naive").estimate(recording[0]):
        given = np.isfinite(p.keypoints).all(1)
        np.testing.assert_allclose(camera.project(p.keypoints[given]), p.keypoints_2d.uv[given], atol=1e-6)


def test_sample_is_found_where_it_is(models):
    """The bundled recording: both people in every frame, all joints near their true places, hidden ones too."""
    from understudy.metrics import evaluate
    from understudy.people_file import FramePeople

    recording = recordings.open("sample")
    estimator = Estimator()
    frames = [FramePeople(i, tuple(estimator.estimate(recording.frame(i)))) for i in recording.indices[::4]]
    assert recording.truth is not None
    truth = type(recording.truth)({f.index: recording.truth.frames[f.index] for f in frames})
    scores = evaluate(frames, truth)
    assert (scores.counts.missed, scores.counts.false) == (0, 0)
    assert scores.joints["visible"].epe_m < 0.05
    assert scores.joints["occluded"].epe_m < 0.12
    assert scores.joints["visible"].coverage == scores.joints["occluded"].coverage == 1


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
    estimator = Estimator("naive", detector)
    people = estimator.estimate(flat_frame)
    assert [p.id for p in people] == [0, 1] and detector.indices == [0]
    again = estimator.estimate(estimator.register(flat_frame))  # registered already
    np.testing.assert_array_equal(again[0].keypoints, people[0].keypoints)
    np.testing.assert_allclose(people[1].keypoints[:, 2], 2.0)
