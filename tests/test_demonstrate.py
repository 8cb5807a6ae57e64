"""Recordings to demonstrations from end to end, on a simulated person who opens a drawer."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from moving_part_scenes import COLOR, Recording, record

from understudy import recordings, runtime
from understudy.benchmark.demonstrations import TrueDemonstration, score
from understudy.camera import RGBDCamera
from understudy.cli import main
from understudy.demonstration import making, storage
from understudy.demonstration.build import DemonstrationConfig, build
from understudy.demonstration.run import ESTIMATION, PICTURE, demonstrate, load_all
from understudy.errors import RecordingError, UnderstudyError
from understudy.geometry import inverse
from understudy.people_file import PeopleFile
from understudy.pipeline import JOURNAL, PEOPLE
from understudy.recordings.writer import FolderWriter
from understudy.types import Frame, Keypoints2D

N, HZ = 45, 5.0
BROKEN, ALONE = 20, range(30, 33)
TASK = DemonstrationConfig("drawer")


def write(folder: Path, simulated: Recording, without: range = range(0)) -> Path:
    """As a recording folder with 2D keypoints; in frames `without`, nobody is found."""
    camera = RGBDCamera.aligned(COLOR)
    keypoints: dict[int, list[Keypoints2D]] = {}
    with FolderWriter(folder, camera, fps=HZ) as writer:
        for i, (frame, people) in enumerate(zip(simulated.frames, simulated.people, strict=True)):
            writer.write(Frame(frame.color, frame.depth.z, camera, i, float(simulated.times_s[i])))
            keypoints[i] = [] if i in without else [p.keypoints_2d for p in people]
        writer.close(keypoints2d=keypoints)
    return folder


def truth_of(r: Recording) -> TrueDemonstration:
    T_cam_world, t = inverse(r.T_world_cam), len(r.q)
    hand = np.tile(np.eye(4), (t, 1, 1))
    hand[:, :3, 3] = r.hand
    return TrueDemonstration(
        r.task,
        r.times_s,
        "right",
        T_cam_world @ hand,
        np.ones(t, bool),
        T_cam_world @ hand,
        T_cam_world @ r.T_world_handle,
        r.scene.articulation.moved(T_cam_world),
        r.q,
    )


@pytest.fixture(scope="module")
def simulated() -> Recording:
    return record("drawer", 2, n=N, hz=HZ)


@pytest.fixture(scope="module")
def made(simulated: Recording, tmp_path_factory: pytest.TempPathFactory):
    """A recording with a broken frame, and with some in which nobody is found; and what became of it."""
    folder = tmp_path_factory.mktemp("demonstrate")
    path = write(folder / "drawer_1", simulated, ALONE)
    depth = path / "depth" / f"{BROKEN:06d}.png"
    depth.write_bytes(depth.read_bytes()[:500])
    results = demonstrate([path], folder / "demos", TASK, detector="recording", hands="depth")
    return path, folder / "demos", results[0]


def test_a_broken_frame_and_a_lost_person_do_not_stop_it(made, simulated):
    _, _, result = made
    demo = result.demonstration
    assert result.failed is None and demo is not None
    assert demo.source["frames_skipped"] == 1
    at = np.searchsorted(demo.times_s, simulated.times_s[BROKEN] - 1e-6)
    assert not demo.object.observed[at] and demo.object.known[at], "filled in, and said so"
    gap = np.searchsorted(demo.times_s, simulated.times_s[ALONE[1]])
    assert not demo.hand.observed[gap]
    assert np.diff(demo.times_s) == pytest.approx(0.1), "at least ten samples a second"


def test_object_and_segments_are_what_happened(made, simulated):
    errors = score(made[2].demonstration, truth_of(simulated))
    assert errors.kind_right and errors.acting_right
    assert np.median(errors.motion_m) < 0.02 and np.percentile(errors.object_m, 95) < 0.05
    assert errors.axis_rad < np.radians(4) and errors.range_share < 0.12
    assert np.abs(errors.boundaries_s).max() < 0.3 + 1 / HZ
    assert np.median(errors.hand_m) < 0.10


def test_a_second_run_takes_over_what_is_done(made, simulated, tmp_path):
    path, out, first = made
    before = (out / path.name / storage.ARRAYS).stat().st_mtime_ns
    again = demonstrate([path], out, TASK, detector="recording", hands="depth")[0].demonstration
    assert (out / path.name / storage.ARRAYS).stat().st_mtime_ns == before
    np.testing.assert_array_equal(again.hand.T_world_x, first.demonstration.hand.T_world_x)
    journal = out / path.name / ESTIMATION / JOURNAL
    lines = journal.read_text()
    (out / path.name / storage.INFO).unlink()  # as after a kill between estimation and the end
    rebuilt = demonstrate([path], out, TASK, detector="recording", hands="depth")[0].demonstration
    np.testing.assert_array_equal(rebuilt.object.T_world_x, first.demonstration.object.T_world_x)
    grown = journal.read_text()[len(lines) :].splitlines()
    assert len(grown) <= 1, "only the broken frame is looked at again"


def test_one_recording_that_fails_does_not_stop_the_others(made, tmp_path):
    path, out, _ = made
    results = demonstrate([tmp_path / "nothing", path], out, TASK, detector="recording", hands="depth", jobs=1)
    assert "nothing" in results[0].failed and results[0].demonstration is None
    assert results[1].demonstration is not None
    assert len(load_all([out])) == 1
    with pytest.raises(RecordingError, match="holds no demonstration"):
        load_all([tmp_path])


def test_several_at_a_time_are_the_same_bit_for_bit(made, tmp_path):
    """With the broken frame and the lost person; and one that fails sooner."""
    path, _, alone = made
    paths = [tmp_path / path.name, tmp_path / "nothing"]
    shutil.copytree(path, paths[0])
    reported: list[str] = []
    results = demonstrate(
        paths, tmp_path / "demos", TASK, detector="recording", hands="depth", jobs=2,
        report=lambda r: reported.append(r.recording),
    )  # fmt: skip
    assert [r.recording for r in results] == list(map(str, paths)), "in the order of the inputs"
    assert reported == list(map(str, paths[::-1])), "as they come"
    assert results[1].demonstration is None and "nothing" in results[1].failed
    for file in (storage.ARRAYS, storage.INFO, f"{ESTIMATION}/{PEOPLE}"):
        made_together = (results[0].folder / file).read_bytes()
        expected = (alone.folder / file).read_bytes().replace(str(path).encode(), str(paths[0]).encode())
        if file != storage.INFO:
            assert made_together == expected, file
        else:  # its key is that of a file that names the recording
            now, before = (json.loads(text) for text in (made_together, expected))
            assert now["source"].pop("key") != before["source"].pop("key")
            assert now == before and now["source"]["frames_skipped"] == 1
    np.testing.assert_array_equal(results[0].demonstration.hand.T_world_x, alone.demonstration.hand.T_world_x)


def short(folder: Path, simulated: Recording) -> Path:
    """The first three frames."""
    return write(folder, replace(simulated, frames=simulated.frames[:3], people=simulated.people[:3]))


def test_a_recording_that_is_named_twice_is_made_once(made):
    path, out, _ = made
    reported: list[str] = []
    one, two = demonstrate(
        [path, path.parent / "." / path.name], out, TASK, detector="recording", hands="depth", jobs=2,
        report=lambda r: reported.append(r.recording),
    )  # fmt: skip
    assert one is two and one.demonstration is not None and reported == [str(path)]


def test_what_should_not_happen_costs_one_recording(simulated, tmp_path, monkeypatch):
    monkeypatch.setattr(making, "build", lambda *arguments: [][1])
    path = short(tmp_path / "drawer_1", simulated)
    result = demonstrate([path], tmp_path / "demos", TASK, method="naive", detector="recording", hands="off")[0]
    assert result.demonstration is None and "unexpected IndexError" in result.failed


def test_networks_are_loaded_once(simulated, tmp_path, monkeypatch):
    paths = [short(tmp_path / name, simulated) for name in ("drawer_1", "drawer_2")]
    loaded: list[Path] = []
    load = runtime.load_rows
    monkeypatch.setattr(runtime, "load_rows", lambda path, **options: loaded.append(path) or load(path, **options))
    demonstrate(paths, tmp_path / "demos", TASK, detector="recording", hands="off", jobs=1)
    assert len(loaded) == 1
    people = [PeopleFile.read(tmp_path / "demos" / p.name / ESTIMATION / PEOPLE) for p in paths]
    assert all(len(frame.people) == 1 for file in people for frame in file.frames)


def test_bad_numbers_are_refused(tmp_path):
    with pytest.raises(UnderstudyError, match="2 configs for 1 recordings"):
        demonstrate(["drawer_1"], tmp_path, [TASK, TASK])
    with pytest.raises(UnderstudyError, match="drawer_1: is named twice, with different configs"):
        demonstrate(["drawer_1", "./drawer_1"], tmp_path, [TASK, DemonstrationConfig("room_door")])
    with pytest.raises(UnderstudyError, match="jobs 0: must be 1 or more"):
        demonstrate(["drawer_1"], tmp_path, TASK, jobs=0)


def test_nobody_and_no_clock_are_explained(made, simulated, tmp_path):
    path, out, _ = made
    with recordings.open(path) as recording:
        frames = PeopleFile.read(out / path.name / ESTIMATION / PEOPLE).frames
        with pytest.raises(UnderstudyError, match="nobody"):
            build(recording, [replace(f, people=()) for f in frames], TASK)
        recording.fps = None
        with pytest.raises(UnderstudyError, match="fps"):
            build(recording, [replace(f, timestamp_s=None) for f in frames], TASK)
    with pytest.raises(UnderstudyError, match="rgbd.*markers"):
        DemonstrationConfig(object="magic")
    with pytest.raises(UnderstudyError, match="--markers"):
        DemonstrationConfig(teacher="markers")


def test_command_line(made, tmp_path, capsys):
    path, out, _ = made
    copy = tmp_path / "demos"
    shutil.copytree(out, copy)
    assert main(["demonstrate", str(path), "--out", str(copy), "--task", "drawer", "--detector", "recording",
                 "--hands", "depth"]) == 0  # fmt: skip
    printed = capsys.readouterr()
    assert "1 of 1 recordings" in printed.out and "1 frames could not be read" in printed.err
    assert main(["demo", "show", str(copy / path.name), "--out", str(tmp_path / "look.png")]) == 0
    assert "prismatic" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "look.png"))
    assert picture is not None and picture.shape[1] > 800 and picture.std() > 20
    assert (copy / path.name / PICTURE).exists()
    assert main(["demonstrate", str(tmp_path / "no"), "--out", str(tmp_path / "x")]) == 1
    assert main(["demo", "show", str(tmp_path)]) == 2
