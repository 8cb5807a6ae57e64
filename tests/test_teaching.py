"""Teaching: smooth openings, stages that survive being killed, and the whole course from demonstrations to a trial."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import adaptation_scenes as scenes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.errors import RecordingError, UnderstudyError
from understudy.teaching_stages import Stages, digest

for package in ("pinocchio", "sklearn", "mujoco", "numba"):
    pytest.importorskip(package, reason=f"{package} is not installed (extra 'robot')")

import teaching_scenes  # noqa: E402

from understudy import recordings, teaching, teaching_motions  # noqa: E402
from understudy.actions import Skill, learn, load_skill, save_skill  # noqa: E402
from understudy.adaptation.errors import InfeasibleError  # noqa: E402
from understudy.adaptation.result import AdaptationResult  # noqa: E402
from understudy.demonstration.demonstration import Demonstration  # noqa: E402
from understudy.teaching import TeachConfig, teach  # noqa: E402
from understudy.teaching_folder import Seen  # noqa: E402
from understudy.trajectories import PoseTrack  # noqa: E402

WHOLE = ("skill.json", "skill.npz", "adaptation/000.npz")
"""Files of a teaching that hold no times of day."""


def _minimum_jerk(t: np.ndarray) -> np.ndarray:
    return t**3 * (10 - 15 * t + 6 * t**2)


@pytest.mark.parametrize("n", [8, 13, 40])
def test_smooth_share_is_near_to_the_truth(n: int) -> None:
    time_, fine = np.linspace(0, 1, n), np.linspace(0, 1, 2001)
    for seed in range(5):
        noisy = _minimum_jerk(time_) + 0.01 * np.random.default_rng(seed).normal(size=n)
        curve = teaching_motions.smooth_share(time_, noisy)
        assert np.sqrt(np.mean((curve(fine) - _minimum_jerk(fine)) ** 2)) < 0.015
        greatest = np.abs(curve.derivative(2)(fine)).max()
        assert greatest < 2.5 * 5.78  # of minimum jerk
        assert greatest < 0.5 * np.abs(np.diff(noisy, 2)).max() * (n - 1) ** 2 or n < 40


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=40))
def test_smooth_share_rises_from_rest_to_rest(values: list[float]) -> None:
    curve = teaching_motions.smooth_share(np.linspace(0, 1, len(values)), np.array(values))
    fine = curve(np.linspace(0, 1, 501))
    assert (np.diff(fine) >= -1e-9).all()
    ends = np.array([0.0, 1.0])
    np.testing.assert_allclose(curve(ends), ends, atol=1e-9)
    np.testing.assert_allclose(curve.derivative(1)(ends), 0, atol=1e-6)
    np.testing.assert_allclose(curve.derivative(2)(ends), 0, atol=1e-4)


def _noisy(task: str, sigma: float) -> tuple[Demonstration, np.ndarray]:
    """A demonstration whose object is off by sigma along its way, and unknown at times; and its true opening."""
    d = scenes.demonstration(task, samples=60)
    true = d.articulation.position(d.object.T_world_x)
    rng = np.random.default_rng(3)
    T = d.articulation.pose(true + sigma * rng.normal(size=len(d)))
    T[[0, 30, 31, 59]] = np.nan
    seen = np.isfinite(T).all(axis=(1, 2))
    return replace(d, object=PoseTrack(T, d.object.covariance, seen, seen)), true


@pytest.mark.parametrize(("task", "sigma"), [("drawer", 0.003), ("room_door", 0.005)])
def test_smooth_opening(task: str, sigma: float) -> None:
    d, true = _noisy(task, sigma)
    q = teaching_motions.smooth_opening(d, d.times_s, d.times_s)
    grasp, release = d.segments.grasp, d.segments.release
    assert np.abs(q - true).max() < 4 * sigma
    assert np.ptp(q[: grasp + 1]) == 0 and np.ptp(q[release:]) == 0
    assert (np.diff(q) >= -1e-12).all()


def test_motions_keep_what_was_adapted() -> None:
    d, _ = _noisy("drawer", 0.003)
    a = teaching_scenes.as_shown(d)
    m = teaching_motions.robot_motion(d, a)
    grasp, release = d.segments.grasp, d.segments.release
    assert m.times_s[m.segments.grasp] == a.times_s[grasp]
    assert m.times_s[m.segments.release] == a.times_s[release]
    free = np.r_[0 : grasp + 1, release : len(d)]
    at = np.searchsorted(m.times_s, a.times_s[free])
    np.testing.assert_allclose(m.T_world_tool[at], a.T_world_tool[free], atol=1e-9)
    np.testing.assert_allclose(m.xy_yaw[at], a.base[free], atol=1e-9)
    held = m.times_s[m.segments.grasp : m.segments.release]
    assert np.allclose(np.diff(held), np.diff(held)[0]) and np.diff(held)[0] < 1.1 / teaching_motions.RATE_HZ


def test_what_is_learnt_accelerates_as_was_shown() -> None:
    d, true = _noisy("drawer", 0.003)
    a = teaching_scenes.as_shown(d)
    model = learn([teaching_motions.robot_motion(d, a)])
    run = model.reproduce(model.object.T_start, rate_hz=50)
    dt = a.times_s[1] - a.times_s[0]
    shown = np.abs(np.diff(true, 2)).max() / dt**2
    assert np.abs(np.diff(run.q, 2)).max() * 50**2 < 2 * shown


def test_motions_need_their_own_demonstrations() -> None:
    d = scenes.demonstration("drawer", samples=60)
    with pytest.raises(UnderstudyError, match="1 demonstrations, but 2"):
        teaching_motions.robot_motions([d], teaching_scenes.as_if_adapted([d, d]))


def test_stages_are_done_once(tmp_path: Path) -> None:
    made, value = [], tmp_path / "value"

    def make(word: str) -> str:
        made.append(word)
        value.write_text(word)
        return word

    def load() -> str:
        if not value.exists():
            raise RecordingError("gone")
        return value.read_text()

    def run(key: str, word: str) -> str:
        return Stages(tmp_path).run("a", key, load, lambda: make(word))

    assert run("k", "x") == "x" and run("k", "y") == "x" and made == ["x"]
    assert run("other", "y") == "y"  # made from something else
    value.unlink()
    assert run("other", "z") == "z"  # damaged
    (tmp_path / "stages.json").write_text("{")
    assert run("other", "w") == "w" and made == ["x", "y", "z", "w"]


def test_stages_say_that_they_were_stopped(tmp_path: Path) -> None:
    def stop() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stages(tmp_path).run("a", "k", lambda: "old", stop)
    stages = Stages(tmp_path)
    assert not stages.entries["a"].finished
    assert stages.run("a", "k", lambda: "old", lambda: time.sleep(0.02) or "new") == "new"
    entry = Stages(tmp_path).entries["a"]
    assert entry.finished and entry.resumed and entry.seconds >= 0.02


def test_digest_sees_every_change() -> None:
    config = TeachConfig()
    words = [
        digest(config),
        digest(replace(config, seed=1)),
        digest(replace(config, adaptation=replace(config.adaptation, rounds=7))),
        digest(b"a", b"bc"),
        digest(b"ab", b"c"),
        digest({"a": np.arange(3)}),
    ]
    assert len(set(words)) == len(words)
    assert digest(TeachConfig()) == words[0]


def test_a_robot_is_taught(tmp_path: Path) -> None:
    """All stages, one recording that holds nothing, and a trial in physics."""
    out = tmp_path / "skill"
    result = teaching_scenes.taught(out, ("one", "bad", "two"), trials=1, drawn=True)
    assert [s.failed is None for s in result.seen] == [True, False, True]
    assert len(result.demonstrations) == len(result.motions) == result.skill.model.demonstrations == 2
    assert result.metrics["after"].achievable_percent >= 99.5
    assert result.outcomes[0].success, result.outcomes[0]
    assert load_skill(out).model.demonstrations == 2
    assert result.report.exists() and (out / "trials/000/trajectory.npz").exists()
    assert json.loads((out / "config.json").read_text())["adaptation"]["rounds"] == 8
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.npz")}
    again = teaching_scenes.taught(out, ("one", "bad", "two"), trials=1)
    after = {p: p.stat().st_mtime_ns for p in out.rglob("*.npz")}
    redone = {p.relative_to(out).parts[0] for p in before if before[p] != after[p]}
    assert redone <= {"demonstrations"}  # tried again, as one had failed
    assert again.outcomes == result.outcomes
    assert again.timings["adapt"] == result.timings["adapt"]
    assert not teaching_scenes.taught(out, ("one", "bad", "two")).outcomes
    assert not (out / "trials/000").exists()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_and_started_again(tmp_path: Path) -> None:
    """In every stage, one after the other. The same files as of a run that nobody disturbed, none half-written."""
    whole = teaching_scenes.taught(tmp_path / "whole", trials=1)
    out = tmp_path / "killed"
    here = Path(__file__).resolve().parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(here), *sys.path])}
    times = dict[str, int]()
    for stage in ("demonstrate", "adapt", "learn", "trial 000", "report"):
        process = subprocess.Popen([sys.executable, here / "teaching_scenes.py", out], env=environment)
        deadline = time.monotonic() + 120
        while not _is_in(out, stage) and process.poll() is None:
            assert time.monotonic() < deadline, stage
            time.sleep(0.002)
        process.kill()
        assert process.wait() == -signal.SIGKILL, stage
        assert not (out / "report.html").exists()
        done = {str(p): p.stat().st_mtime_ns for p in map(out.__truediv__, WHOLE) if p.exists()}
        assert done.items() >= times.items()  # what was finished is not made again
        times = done if stage in ("trial 000", "report") else {}  # before, what is there may be half of a stage
    result = teaching_scenes.taught(out, trials=1)
    assert result.timings["learn"].resumed and result.timings["trial 000"].resumed
    assert [replace(t, folder=out) for t in result.outcomes] == [replace(t, folder=out) for t in whole.outcomes]
    for name in (*WHOLE, "trials/000/trial.json"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    files = {p.relative_to(out) for p in out.rglob("*") if not p.name.startswith(".")}
    assert files == {p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole").rglob("*")}


def _is_in(out: Path, stage: str) -> bool:
    """Whether a run has begun that stage and not finished it, by its own book."""
    if not (out / "stages.json").exists():
        return False
    entries = json.loads((out / "stages.json").read_text())["stages"]
    if stage == "report":  # in no book: it is made each time, when all others are done
        return bool(entries.get("trial 000", {}).get("finished"))
    return stage in entries and not entries[stage]["finished"]


def test_what_the_robot_cannot_do_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = [scenes.demonstration("drawer", seed, samples=60) for seed in (0, 1, 2)]
    calls = []

    def adapt(demonstrations: list[Demonstration], *args: object, **options: object) -> AdaptationResult:
        calls.append(len(demonstrations))
        if any(d is shown[1] for d in demonstrations):
            raise InfeasibleError("too high")
        return teaching_scenes.as_if_adapted(demonstrations)

    monkeypatch.setattr("understudy.adaptation.most.adapt", adapt)
    course = teaching.Course(["a", "b", "c"], tmp_path / "out", "drawer", "pr2", TeachConfig(), False)
    used = [Seen(name, name) for name in "abc"]
    result, left_out = course.feasible(used, shown)
    assert len(result.demonstrations) == 2 and left_out == {"b": "too high"}
    assert calls == [3, 1, 1, 1, 2]
    with pytest.raises(InfeasibleError, match="too high"):
        course.feasible(used[1:2], shown[1:2])
    d = shown[2]
    brief = replace(d, segments=replace(d.segments, release=len(d) - 2))
    assert course.feasible(used, [shown[0], brief, shown[2]])[1].keys() == {"b"}
    with pytest.raises(UnderstudyError, match="release has 2 samples only"):
        course.feasible(used[1:2], [brief])


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(UnderstudyError, match="at least one recording"):
        teach([], tmp_path / "out", task="drawer")
    with pytest.raises(UnderstudyError, match="trials and seed"):
        TeachConfig(trials=-1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    with pytest.raises(UnderstudyError, match="did not write"):
        teach(["sample"], tmp_path / "mine", task="drawer")
    with pytest.raises(UnderstudyError, match=r"no recording shows a demonstration:\n  bad: bad: nobody"):
        teaching_scenes.taught(tmp_path / "out", ("bad",))
    with pytest.raises(UnderstudyError, match="pr9"):
        teach(["sample"], tmp_path / "other", task="drawer", robot="pr9")
    assert not (tmp_path / "other").exists()


def test_other_tasks_are_not_tried(tmp_path: Path) -> None:
    course = teaching.Course(["a"], tmp_path / "out", "pulling", "pr2", TeachConfig(), False)
    motions = [teaching_motions.robot_motion(d, teaching_scenes.as_shown(d)) for d in [scenes.demonstration("drawer")]]
    save_skill(tmp_path / "out", skill := Skill(learn(motions), "pulling", "pr2_right"))
    assert course.reproduce(skill) == ()
    assert any("no furniture for the task 'pulling'" in note for note in course.notes)


def test_the_bundled_recording() -> None:
    with recordings.open("sample-drawer") as recording:
        assert recording.path.parts[-2:] == ("samples", "drawer")
        files = [p for p in recording.path.rglob("*") if p.is_file()]
        assert sum(p.stat().st_size for p in files) <= 9e6
        assert recording.fps == 5 and len(recording) > 30
        depth = recording[0].depth
        assert 0.9 < np.mean(depth > 0) <= 1 or np.median(depth[depth > 0]) > 1
