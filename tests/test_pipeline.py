"""A recording -> a folder: resumed, broken frames, other settings; and the command line on top of it."""

import json

import cv2
import numpy as np
import pytest

from understudy import recordings
from understudy.camera import Camera, RGBDCamera
from understudy.cli import main
from understudy.errors import RecordingError, UnderstudyError
from understudy.estimator import Estimator
from understudy.people_file import PeopleFile
from understudy.pipeline import estimate_recording
from understudy.skeleton import N_JOINTS
from understudy.tracking import IdentityTracker
from understudy.types import Frame, Keypoints2D

CAMERA = RGBDCamera.aligned(Camera.from_fov(160, 120, 1.0))
FRAMES = 5


def seen(x: float) -> Keypoints2D:
    rng = np.random.default_rng(0)
    return Keypoints2D.from_rows(
        np.column_stack([x + rng.uniform(0, 20, N_JOINTS), rng.uniform(20, 100, N_JOINTS), np.ones(N_JOINTS)])
    )


@pytest.fixture
def recording(tmp_path):
    """Two people cross a wall that has depth only in its left part; the second is written first in odd frames."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 110:] = 0
    frames = [Frame(np.full((120, 160, 3), 90, np.uint8), depth, CAMERA, i, 0.1 * i) for i in range(FRAMES)]
    keypoints = {}
    for i in range(FRAMES):
        two = [seen(10 + 4 * i), seen(60 + 20 * (i == 4))]
        keypoints[i] = two[::-1] if i % 2 else two
    path = tmp_path / "REC"
    recordings.write_recording(path, frames, fps=10.0, color_format="png", keypoints2d=keypoints)
    return path


def run(recording, out, **options):
    """By the naive method, whose joints are known exactly."""
    return estimate_recording(
        recordings.open(recording), out, **{"method": "naive", "detector": "recording", "hands": "depth", **options}
    )


def test_whole_recording(recording, tmp_path):
    out = tmp_path / "out"
    result = run(recording, out)
    assert [f.index for f in result.frames] == list(range(FRAMES))
    assert [f.timestamp_s for f in result.frames] == pytest.approx([0.1 * i for i in range(FRAMES)])
    left = [next(p for p in f.people if p.id == 0) for f in result.frames]
    assert np.all(np.diff([p.keypoints_2d.uv[0, 0] for p in left]) == pytest.approx(4))  # ids follow the people
    assert {len(f.people) for f in result.frames} == {2}
    read = PeopleFile.read(out / "people.json")
    np.testing.assert_allclose(read.frames[2].people[0].keypoints, result.frames[2].people[0].keypoints, atol=1e-4)
    assert sorted(p.name for p in out.iterdir()) == ["config.json", "journal.jsonl", "overlays", "people.json"]
    assert len(list((out / "overlays").glob("*.png"))) == FRAMES
    picture = cv2.imread(str(out / "overlays" / "000000.png"))
    assert picture.shape[0] == 120 and picture.std() > 5
    config = json.loads((out / "config.json").read_text())
    assert config["recording"] == str(recording) and config["method"] == "naive" and config["detector"] == "recording"


def test_resumes_where_it_stopped(recording, tmp_path, monkeypatch):
    """Killed after two frames, started again: the same file as an unbroken run's, and no frame estimated twice."""
    whole = run(recording, tmp_path / "whole", overlays=False)
    estimate, calls = Estimator.estimate, []

    def interrupted(self, frame):
        calls.append(frame.index)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return estimate(self, frame)

    monkeypatch.setattr(Estimator, "estimate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(recording, tmp_path / "out", overlays=False)
    assert len(PeopleFile.read(tmp_path / "out" / "people.json").frames) == 2  # can be looked at already
    journal = tmp_path / "out" / "journal.jsonl"
    assert len(journal.read_text().splitlines()) == 2
    journal.write_text(journal.read_text() + '{"index": 2, "peop')  # as a crash in mid-line leaves it
    (tmp_path / "out" / "people.json").unlink()
    again = run(recording, tmp_path / "out", overlays=False)
    assert calls == [0, 1, 2, 2, 3, 4]
    assert (tmp_path / "out" / "people.json").read_text() == (tmp_path / "whole" / "people.json").read_text()
    assert len(again.frames) == len(whole.frames)
    run(recording, tmp_path / "out", overlays=False)
    assert len(calls) == 6  # nothing left to do


def test_several_frames_at_a_time_are_the_same(recording, tmp_path):
    (recording / "depth" / "000001.png").write_bytes(b"")
    alone, steps = run(recording, tmp_path / "alone"), []
    run(recording, tmp_path / "together", threads=3, step=lambda *n: steps.append(n))
    assert [f.index for f in alone.frames if f.skipped] == [1]
    for name in ("people.json", "journal.jsonl", "overlays/000004.png"):
        assert (tmp_path / "together" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    assert steps == [(done, FRAMES) for done in range(FRAMES + 1)]


def test_interrupting_a_repeated_run_loses_nothing(recording, tmp_path, monkeypatch):
    whole = run(recording, tmp_path / "out", overlays=False)
    before = (tmp_path / "out" / "people.json").read_text()
    update, calls = IdentityTracker.update, []

    def interrupted(self, people, time_s=None):
        calls.append(people)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return update(self, people, time_s)

    monkeypatch.setattr(IdentityTracker, "update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(recording, tmp_path / "out", overlays=False)
    assert (tmp_path / "out" / "people.json").read_text() == before
    assert len(whole.frames) == FRAMES


def test_other_settings_do_not_mix(recording, tmp_path):
    run(recording, tmp_path / "out", overlays=False)
    with pytest.raises(RecordingError, match=r"other settings \(min_score differs: 0.2 then, 0.5 now\).*--restart"):
        run(recording, tmp_path / "out", min_score=0.5)
    assert len(run(recording, tmp_path / "out", min_score=0.5, restart=True).frames) == FRAMES


def test_broken_frames_are_reported_and_skipped(recording, tmp_path, capsys):
    (recording / "depth" / "000001.png").unlink()
    data = (recording / "color" / "000003.png").read_bytes()
    (recording / "color" / "000003.png").write_bytes(data[: len(data) // 2])
    result = run(recording, tmp_path / "out")
    skipped = {f.index: f.skipped for f in result.frames if f.skipped}
    assert set(skipped) == {1, 3} and "000001.png" in skipped[1] and "000003.png" in skipped[3]
    saved = json.loads((tmp_path / "out" / "people.json").read_text())["frames"]
    assert saved[1]["people"] == [] and "000001.png" in saved[1]["skipped"]
    assert main(["estimate", str(recording), "--detector", "recording", "--out", str(tmp_path / "out2")]) == 0
    captured = capsys.readouterr()
    assert "frame 1 skipped" in captured.err and "frame 3 skipped" in captured.err and "(2 skipped)" in captured.out
    (recording / "color" / "000003.png").write_bytes(data)  # mended: the same command takes it in
    again = run(recording, tmp_path / "out")
    assert [f.index for f in again.frames if f.skipped] == [1]


def test_a_mended_frame_fits_in(recording, tmp_path):
    """A frame that was broken in the first run: after the second, all is as if it had never been broken."""
    whole = run(recording, tmp_path / "whole")
    path = recording / "color" / "000000.png"
    data = path.read_bytes()
    path.write_bytes(data[:200])
    broken = run(recording, tmp_path / "out")
    assert broken.frames[0].skipped and not (tmp_path / "out" / "overlays" / "000000.png").exists()
    path.write_bytes(data)
    run(recording, tmp_path / "out")
    assert (tmp_path / "out" / "people.json").read_text() == (tmp_path / "whole" / "people.json").read_text()
    for picture in (tmp_path / "whole" / "overlays").iterdir():
        mended = cv2.imread(str(tmp_path / "out" / "overlays" / picture.name)).astype(int)
        # results are kept to a tenth of a millimetre, so lines may differ at their rims; other ids have other colours
        assert np.abs(mended - cv2.imread(str(picture))).mean() < 0.5
    assert len(whole.frames) == FRAMES


def test_changed_images_are_estimated_again(recording, tmp_path, monkeypatch):
    first = run(recording, tmp_path / "out")
    cv2.imwrite(str(recording / "depth" / "000002.png"), np.full((120, 160), 3000, np.uint16))
    calls, estimate = [], Estimator.estimate
    monkeypatch.setattr(Estimator, "estimate", lambda self, f: calls.append(f.index) or estimate(self, f))
    second = run(recording, tmp_path / "out")
    assert calls == [2]
    assert np.nanmedian(first.frames[2].people[0].keypoints[:, 2]) == pytest.approx(2)
    assert np.nanmedian(second.frames[2].people[0].keypoints[:, 2]) == pytest.approx(3)


def test_changed_keypoints_or_cameras_need_a_restart(recording, tmp_path):
    run(recording, tmp_path / "out")
    keypoints = recording / "keypoints2d.json"
    keypoints.write_text(keypoints.read_text().replace(" ", "") + " ")
    with pytest.raises(RecordingError, match="detector_input differs"):
        run(recording, tmp_path / "out")
    run(recording, tmp_path / "out", restart=True)
    info = json.loads((recording / "recording.json").read_text())
    info["color"]["K"][0][0] = info["depth"]["K"][0][0] = info["color"]["K"][0][0] + 10
    (recording / "recording.json").write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=r"cameras differs.*--restart"):
        run(recording, tmp_path / "out")
    run(recording, tmp_path / "out", restart=True)
    info["depth"]["unit_m"] *= 2
    info["timestamps_s"] = [t + 5 for t in info["timestamps_s"]]
    (recording / "recording.json").write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=r"unit_m differs: 0.001 then, 0.002 now.*--restart"):
        run(recording, tmp_path / "out")
    info["depth"]["unit_m"] /= 2
    (recording / "recording.json").write_text(json.dumps(info))
    assert [f.timestamp_s for f in run(recording, tmp_path / "out").frames][:2] == pytest.approx([5.0, 5.1])


def test_frames_that_vanished_are_left_out_with_a_word(recording, tmp_path):
    run(recording, tmp_path / "out")
    for kind in ("color", "depth"):
        (recording / kind / "000004.png").unlink()
    info = json.loads((recording / "recording.json").read_text())
    (recording / "recording.json").write_text(json.dumps({**info, "timestamps_s": info["timestamps_s"][:4]}))
    with pytest.warns(UserWarning, match="1 frames are no longer in"):
        assert len(run(recording, tmp_path / "out").frames) == 4


def test_missing_pictures_are_drawn_without_estimating(recording, tmp_path, monkeypatch):
    run(recording, tmp_path / "out", overlays=False)
    assert not (tmp_path / "out" / "overlays").exists()
    monkeypatch.setattr(Estimator, "estimate", lambda self, frame: pytest.fail("estimated again"))
    run(recording, tmp_path / "out")
    assert len(list((tmp_path / "out" / "overlays").glob("*.png"))) == FRAMES


@pytest.mark.parametrize("name", ["config.json", "people.json", "overlays", "journal.jsonl", "pair"])
@pytest.mark.parametrize("restart", [False, True])
def test_what_is_not_ours_stays(recording, tmp_path, name, restart):
    out = tmp_path / "out"
    out.mkdir()
    if "." in name:
        (out / name).write_text('{"mine": 1}')
    else:
        (out / name).mkdir()
        (out / name / "000000.png").write_bytes(b"mine")
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    with pytest.raises(RecordingError, match=f"holds {name}, which .* did not write there"):
        run(recording, out, restart=restart)
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_restart_removes_only_its_own_pictures(recording, tmp_path):
    run(recording, tmp_path / "out")
    photo = tmp_path / "out" / "overlays" / "0_photo.png"
    photo.write_bytes(b"mine")
    run(recording, tmp_path / "out", restart=True, overlays=False)
    assert [p.name for p in (tmp_path / "out" / "overlays").iterdir()] == ["0_photo.png"]


def test_damaged_journal(recording, tmp_path):
    run(recording, tmp_path / "out", overlays=False)
    journal = tmp_path / "out" / "journal.jsonl"
    journal.write_text('{"index": 0, "people": ' + 100_000 * "[" + "\n")
    with pytest.raises(RecordingError, match=r"journal\.jsonl: line 1: not readable as JSON.*--restart"):
        run(recording, tmp_path / "out", overlays=False)


def test_a_frame_without_a_keypoint_file_is_skipped(recording, tmp_path):
    """OpenPose writes a file for every frame; one that is missing or damaged costs its own frame only."""
    folder = tmp_path / "openpose"
    folder.mkdir()
    rows = seen(10).rows().ravel().tolist()
    for i in (0, 1, 3, 4):
        (folder / f"{i}_keypoints.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": rows}]}))
    (folder / "3_keypoints.json").write_text("{")
    result = estimate_recording(
        recordings.open(recording), tmp_path / "out", detector=f"openpose-json:{folder}", overlays=False
    )
    skipped = {f.index: f.skipped for f in result.frames if f.skipped}
    assert set(skipped) == {2, 3} and "no file for frame 2" in skipped[2] and "3_keypoints.json" in skipped[3]
    assert [len(f.people) for f in result.frames] == [1, 1, 0, 0, 1]


@pytest.fixture
def no_depth(tmp_path):
    """One frame with two people and not a single depth."""
    frame = Frame(np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160), np.float32), CAMERA)
    recordings.write_recording(tmp_path / "REC", [frame], keypoints2d={0: [seen(10), seen(60)]})
    return ["estimate", str(tmp_path / "REC"), "--detector", "recording", "--out", str(tmp_path / "out")]


def test_without_depth_naive_lists_everybody_as_failed(no_depth, tmp_path, capsys):
    assert main([*no_depth, "--method", "naive"]) == 0
    people = json.loads((tmp_path / "out" / "people.json").read_text())["frames"][0]["people"]
    assert [p["failed"] for p in people] == ["no depth near any of the 2D keypoints"] * 2
    assert "2 of them could not be lifted" in capsys.readouterr().out


def test_without_depth_the_network_infers_everybody(no_depth, tmp_path):
    assert main(no_depth) == 0
    people = json.loads((tmp_path / "out" / "people.json").read_text())["frames"][0]["people"]
    assert [set(p["source"]) for p in people] == [{"inferred"}] * 2
    assert all(len(row) == 3 for p in people for row in p["keypoints"])


def test_estimator_refuses_what_it_does_not_know():
    with pytest.raises(UnderstudyError, match="method 'magic': must be one of 'voxelposenet', 'naive'"):
        Estimator("magic")
    with pytest.raises(UnderstudyError, match="min_score 2"):
        Estimator(min_score=2)


# --- command line ---


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["estimate", "/absent", "--out", "OUT"], "/absent: no such file or folder"),
        (["estimate", "--out", "OUT"], "give RECORDING, or a single colour/depth pair"),
        (["estimate", "REC", "--color", "c.png", "--out", "OUT"], "--color goes with a pair of images"),
        (["info", "REC", "--unit", "0.001"], "--unit goes with a pair of images"),
        (["estimate", "REC", "--out", "OUT", "--detector", "yolo"], "detector 'yolo': must be one of"),
        (
            ["estimate", "REC", "--out", "OUT", "--method", "magic"],
            "method 'magic': must be one of 'voxelposenet', 'naive'",
        ),
        (["view", "OUT"], "people.json"),
        (["benchmark", "REC", "--out", "OUT"], "truth.json"),
        (["benchmark", "REC", "--methods", "magic"], "method 'magic'"),
        (["models", "list", "--wheel", "x.whl"], "--wheel goes with"),
        (["info", "OUT"], "no such file or folder"),
    ],
)
def test_wrong_input_ends_with_2_and_a_reason(recording, tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("understudy: error: ") and message in err
    assert "Traceback" not in err


def test_info(recording, capsys):
    assert main(["info", str(recording), "--check"]) == 0
    out = capsys.readouterr().out
    assert "frames      5 (numbers 0 to 4), 10 fps, 0 s to 0.4 s" in out
    assert "registered  yes" in out and "keypoints2d 5 frames" in out and "5 of 5 frames can be read" in out
    (recording / "depth" / "000002.png").write_bytes(b"")
    assert main(["info", str(recording), "--check"]) == 1
    assert "frame 2:" in capsys.readouterr().err


def test_pair_of_images(tmp_path, capsys, models):
    cv2.imwrite(str(tmp_path / "c.png"), np.full((120, 160, 3), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "d.png"), np.full((120, 160), 2000, np.uint16))
    arguments = ["estimate", "--color", str(tmp_path / "c.png"), "--depth", str(tmp_path / "d.png")]
    arguments += ["--intrinsics", "140", "140", "79.5", "59.5", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    assert main(arguments) == 0  # again: nothing to do
    assert json.loads((tmp_path / "out" / "people.json").read_text())["frames"][0]["people"] == []
    assert len(recordings.open(tmp_path / "out" / "pair")) == 1
    assert json.loads((tmp_path / "out" / "people.json").read_text())["recording"] == "c.png"
    fine = [*arguments[:-1], str(tmp_path / "fine"), "--unit", "0.000125"]
    assert main(fine) == 0
    kept = recordings.open(tmp_path / "fine" / "pair")[0].depth
    np.testing.assert_allclose(kept, 2000 * 0.000125, rtol=1e-6)
    assert main([*arguments[:-1], str(tmp_path / "o2"), "--unit", "0"]) == 2
    assert "unit_m" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "d.png"), np.full((120, 160), 3000, np.uint16))
    assert main(arguments) == 0  # another image: estimated anew
    assert recordings.open(tmp_path / "out" / "pair")[0].depth[0, 0] == pytest.approx(3)
    arguments[arguments.index("140")] = "150"
    assert main(arguments) == 2
    assert "cameras differs" in capsys.readouterr().err
    assert main([*arguments, "--restart"]) == 0
    assert recordings.open(tmp_path / "out" / "pair").camera.color.fx == 150
    cv2.imwrite(str(tmp_path / "d.png"), np.full((120, 160), 200, np.uint8))
    assert main([*arguments[:-1], str(tmp_path / "o3")]) == 2
    assert "d.png" in capsys.readouterr().err


def test_models_list(capsys):
    assert main(["models"]) == 0
    out = capsys.readouterr().out
    assert "pose_detection" in out and "pose_landmark_full" in out and "Apache-2.0" in out and "cache: " in out
