"""The contract that every back-end keeps (detectors/base.py), whatever it is made of."""

import json

import numpy as np
import pytest

from understudy import recordings
from understudy.detectors import Detector, create
from understudy.detectors.precomputed import RecordingKeypoints
from understudy.registration import register
from understudy.skeleton import JOINT, rows
from understudy.types import Keypoints2D, RegisteredFrame


@pytest.fixture(scope="module")
def frame() -> RegisteredFrame:
    return register(recordings.open("sample")[3])


@pytest.fixture(scope="module")
def seen(frame) -> list[Keypoints2D]:
    """Both people of the frame, exactly, from its truth."""
    truth = recordings.open("sample").truth
    assert truth is not None
    return [Keypoints2D.where(frame.camera.project(p.keypoints), np.ones(18)) for p in truth.frames[frame.index]]


@pytest.fixture(params=["blazepose", "recording", "openpose-json"])
def detector(request, frame, seen, tmp_path) -> Detector:
    if request.param == "blazepose":
        request.getfixturevalue("models")
        return create("blazepose")
    if request.param == "recording":
        return RecordingKeypoints({frame.index: seen})
    people = [{"pose_keypoints_2d": p.rows().ravel().tolist()} for p in seen]
    (tmp_path / f"{frame.index:012d}_keypoints.json").write_text(json.dumps({"people": people}))
    return create(f"openpose-json:{tmp_path}")


def test_contract(detector, frame, seen):
    assert isinstance(detector, Detector) and isinstance(detector.name, str)
    color, z = frame.color.copy(), frame.depth.z.copy()
    found = detector.detect(frame.color, frame.depth, frame.index)
    np.testing.assert_array_equal(frame.color, color)  # inputs are left as they are
    np.testing.assert_array_equal(frame.depth.z, z)
    assert len(found) == 2  # everybody, nobody twice
    found.sort(key=lambda p: -p.uv[JOINT["neck"], 0])
    for person, true in zip(found, sorted(seen, key=lambda p: -p.uv[JOINT["neck"], 0]), strict=True):
        assert isinstance(person, Keypoints2D)
        assert (person.uv[~person.found] == 0).all()
        torso = np.linalg.norm(true.uv[JOINT["neck"]] - true.uv[rows("right_hip", "left_hip")].mean(0))
        trusted = person.score > 0.5
        assert trusted.sum() >= 10
        off = np.linalg.norm(person.uv - true.uv, axis=1)[trusted]
        assert (off < 0.25 * torso).all()  # colour pixels, COCO-18 order, left and right right
        shoulders = rows("right_shoulder", "left_shoulder")
        np.testing.assert_allclose(person.uv[JOINT["neck"]], person.uv[shoulders].mean(0), atol=2)  # 2D or 3D midpoint


def test_depth_is_optional_and_results_repeat(detector, frame):
    a = detector.detect(frame.color, index=frame.index)
    b = detector.detect(frame.color, None, frame.index)
    assert len(a) == len(b) == 2
    for p, q in zip(a, b, strict=True):
        np.testing.assert_array_equal(p.rows(), q.rows())
