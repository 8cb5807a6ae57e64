"""Methods side by side."""

import cv2
import numpy as np
import pytest

from understudy import recordings
from understudy.cli import main
from understudy.registration import register
from understudy.side_view import draw_methods, hidden_errors
from understudy.types import OBSERVED, Keypoints2D, Person


@pytest.fixture(scope="module")
def scene():
    recording = recordings.open("sample")
    return register(recording.frame(2)), recording.truth.frames[2]


def people(truth, offset=(0.0, 0.0, 0.0)) -> list[Person]:
    nothing = Keypoints2D(np.zeros((18, 2)), np.zeros(18))
    return [
        Person(nothing, t.keypoints + offset, np.ones(18), np.full(18, 0.05), (OBSERVED,) * 18, id=i)
        for i, t in enumerate(truth)
    ]


def test_errors_of_hidden_joints(scene):
    _, truth = scene
    moved = people(truth, (0, 0, 0.3))
    errors = hidden_errors(moved, truth)
    assert len(errors) == sum((t.occluded & t.in_view).sum() for t in truth) > 5
    np.testing.assert_allclose(errors, 0.3)
    moved[0].keypoints[truth[0].occluded] = np.nan
    assert np.isnan(hidden_errors(moved, truth)).sum() == (truth[0].occluded & truth[0].in_view).sum()
    assert len(hidden_errors([], truth)) == len(hidden_errors(moved, ())) == 0


def test_every_method_has_a_view_in_which_depth_errors_show(scene):
    frame, truth = scene
    one = draw_methods(frame, {"right": people(truth)}, truth)
    two = draw_methods(frame, {"right": people(truth), "wrong": people(truth, (0, 0, 0.25))}, truth)
    assert two.shape[0] == one.shape[0] == frame.color.shape[0] and two.shape[1] > one.shape[1] > frame.color.shape[1]
    width = (two.shape[1] - frame.color.shape[1] - 8) // 2
    right, wrong = two[:, -2 * width - 4 : -width - 4].astype(int), two[:, -width:].astype(int)
    assert (np.abs(right - wrong).max(-1) > 60).sum() > 500


def test_nobody_and_no_truth(scene):
    frame, _ = scene
    assert draw_methods(frame, {"naive": []}).shape[1] > frame.color.shape[1]


def test_command(models, tmp_path, capsys):
    assert main(["compare", "sample", "--out", str(tmp_path / "c.png")]) == 0
    assert "frame 2:" in capsys.readouterr().out  # where most joints are hidden
    assert cv2.imread(str(tmp_path / "c.png")).shape[0] == 540
    for arguments, message in (
        (["--frame", "99"], "has frames 0 to 11"),
        (["--methods", "magic"], "must be one of 'voxelposenet', 'naive'"),
        (["--out", "c.jpg"], "must end in one of '.png'"),
    ):
        assert main(["compare", "sample", "--out", str(tmp_path / "d.png"), *arguments]) == 2
        assert message in capsys.readouterr().err
