import json

import numpy as np
import pytest
from conftest import SHARED

from understudy.detectors import create
from understudy.detectors.precomputed import OpenPoseJson, RecordingKeypoints
from understudy.errors import DetectorError
from understudy.skeleton import JOINT, LAYOUTS, to_coco18
from understudy.types import Keypoints2D

IMAGE = np.zeros((100, 200, 3), np.uint8)


def body(layout: str, seed: int = 0) -> np.ndarray:
    """Somebody standing, in the named skeleton: shoulders, hips and neck where they are on a person."""
    rng = np.random.default_rng(seed)
    n, mapping = LAYOUTS[layout]
    rows = np.column_stack([rng.uniform(20, 40, n), rng.uniform(60, 90, n), rng.uniform(0.5, 1, n)])
    place = {"nose": (40, 30), "right_eye": (38, 28), "left_eye": (42, 28), "right_ear": (36, 29), "left_ear": (44, 29)}
    place |= {"right_shoulder": (30, 40), "left_shoulder": (50, 40), "right_hip": (34, 70), "left_hip": (46, 70)}
    for name, (u, v) in place.items():
        rows[mapping[JOINT[name]], :2] = u, v
    if layout == "body_25":
        rows[1, :2], rows[8, :2] = (40, 40), (40, 70)
    return rows


def write(path, *people: np.ndarray) -> None:
    path.write_text(json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in people]}))


@pytest.mark.parametrize("layout", ["coco_18", "coco_17", "body_25", "body_25b"])
def test_every_layout_is_recognised(tmp_path, layout):
    rows = body(layout)
    write(tmp_path / "video_000000000003_keypoints.json", rows, body(layout, 1))
    detector = create(f"openpose-json:{tmp_path}")
    people = detector.detect(IMAGE, None, 3)
    assert len(people) == 2
    np.testing.assert_allclose(people[0].rows(), to_coco18(rows, layout))
    named = create(f"openpose-json:{tmp_path}:{layout}").detect(IMAGE, index=3)
    np.testing.assert_array_equal(named[0].rows(), people[0].rows())


def test_people_without_keypoints_are_not_people(tmp_path):
    write(tmp_path / "0.json", np.zeros((18, 3)))
    assert OpenPoseJson(tmp_path).detect(IMAGE, index=0) == []


@pytest.mark.parametrize(
    "content, message",
    [
        ("{", "0.json: not OpenPose's JSON"),
        ('{"persons": []}', "0.json: not OpenPose's JSON"),
        ('{"people": [{"pose_keypoints_2d": [1, 2]}]}', "0.json: not OpenPose's JSON"),
        ('{"people": [{"pose_keypoints_2d": [1, 2, 0.5]}]}', "has 1 keypoints; known: .17, 18, 25"),
        ('{"people": [{"pose_keypoints_2d": [null, 2, 0.5]}]}', "not numbers"),
        ('{"people": [{"pose_keypoints_2d": [NaN, 2, 0.5]}]}', "NaN is not JSON"),
        ('{"people": [{"pose_keypoints_2d": [1e999, 2, 0.5]}]}', "the number 1e999"),
        ('{"people": ' + 100_000 * "[", "not readable as JSON"),
    ],
)
def test_damaged_files(tmp_path, content, message):
    (tmp_path / "0.json").write_text(content)
    with pytest.raises(DetectorError, match=message):
        OpenPoseJson(tmp_path).detect(IMAGE, index=0)


def test_folders_that_will_not_do(tmp_path):
    with pytest.raises(DetectorError, match="holds no .json files"):
        OpenPoseJson(tmp_path)
    with pytest.raises(DetectorError, match="no such folder"):
        OpenPoseJson(tmp_path / "absent")
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(DetectorError, match="notes.json: no frame number"):
        OpenPoseJson(tmp_path)
    (tmp_path / "notes.json").unlink()
    write(tmp_path / "a_1.json", body("coco_18"))
    with pytest.raises(DetectorError, match="no file for frame 2"):
        OpenPoseJson(tmp_path).detect(IMAGE, index=2)
    with pytest.raises(DetectorError, match="layout 'smpl': must be one of 'auto'"):
        OpenPoseJson(tmp_path, "smpl")
    write(tmp_path / "b_01.json", body("coco_18"))
    with pytest.raises(DetectorError, match="same frame number twice"):
        OpenPoseJson(tmp_path)


def test_recording_keypoints():
    known = Keypoints2D.from_rows(body("coco_18"))
    detector = RecordingKeypoints({4: [known]})
    assert detector.detect(IMAGE, None, 4) == [known]
    assert detector.detect(IMAGE, None, 5) == []
    with pytest.raises(DetectorError, match="has no keypoints2d.json"):
        RecordingKeypoints(None, "REC")


@pytest.mark.parametrize("name", ["openpose", "blazepose:x", "openpose-json:", "recording:3", ""])
def test_names_of_detectors(name):
    with pytest.raises(DetectorError, match="must be one of 'blazepose', 'recording', 'openpose-json:FOLDER'"):
        create(name)


def test_real_body_25b_is_recognised():
    folder = SHARED / "pose2sim" / "balancing_openpose_trc" / "pose" / "cam1_json"
    if not folder.is_dir():
        pytest.skip(f"the real keypoints {folder} are not on this machine")
    assert OpenPoseJson(folder).layout == "body_25b"


def test_agrees_with_openpose_on_a_real_video(models):
    """A man balancing on one leg, a colour video without depth: our 2D against OpenPose's, every tenth frame."""
    data = SHARED / "pose2sim"
    if not data.is_dir():
        pytest.skip(f"the real video in {data} is not on this machine")
    av = pytest.importorskip("av", reason="reading the video needs the extra 'kinect'")
    openpose = OpenPoseJson(data / "balancing_openpose_trc" / "pose" / "cam1_json")
    ours = create("blazepose")
    errors = []
    with av.open(str(data / "Pose2Sim" / "Demo_SinglePerson" / "videos" / "cam01.mp4")) as video:
        for k, image in enumerate(video.decode(video=0)):
            if k % 10:
                continue
            color = image.to_ndarray(format="rgb24")
            true = openpose.detect(color, index=k)[0]
            found = ours.detect(color, index=k)
            assert 1 <= len(found) <= 2  # he, and at times the woman in the background; never he twice
            torso = np.linalg.norm(true.uv[JOINT["neck"]] - true.uv[[JOINT["right_hip"], JOINT["left_hip"]]].mean(0))
            apart = [np.linalg.norm(p.uv - true.uv, axis=1) / torso for p in found]
            best = int(np.argmin([np.median(a) for a in apart]))
            errors.append(apart[best][(found[best].score > 0.5) & (true.score > 0.5)])
    assert len(errors) == 10
    pooled = np.concatenate(errors)
    assert len(pooled) > 120 and (pooled < 0.2).mean() > 0.97
