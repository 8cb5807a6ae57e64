"""Recordings in several processes: what becomes of results, of processes that die, and of interruptions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from process_tasks import act

from understudy.demonstration.progress import Progress
from understudy.processes import in_processes


def run(folder: Path, jobs: int, *names: str) -> tuple[dict[int, str], list[tuple[int, ...]]]:
    """What became of each task: its answer, or why its process died; and what was told."""
    answers: dict[int, str] = {}
    told: list[tuple[int, ...]] = []
    in_processes(
        [folder / name for name in names],
        act,
        jobs,
        told=lambda number, words: told.append((number, *words)),
        done=answers.__setitem__,
        died=answers.__setitem__,
    )
    return answers, told


def pid_of(folder: Path) -> int:
    return int((folder / "pid").read_text())


def alive(pid: int) -> bool:
    """Whether it runs (a process that ended and was not waited for does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def until(true: Callable[[], bool], timeout_s: float = 60) -> None:
    end = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def test_answers_and_what_is_told_by_number(tmp_path, monkeypatch):
    monkeypatch.setenv("UNDERSTUDY_THREADS", "2")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    names = [f"works_{i}" for i in range(5)]
    answers, told = run(tmp_path, 2, *names)
    assert answers == {i: f"{name}: 1 1" for i, name in enumerate(names)}, "each has its share of the threads"
    assert [words for words in told if words[0] == 3] == [(3, 1, 2), (3, 2, 2)]
    pids = {pid_of(tmp_path / name) for name in names}
    assert len(pids) <= 2 and os.getpid() not in pids, "processes are used again"
    assert not any(map(alive, pids))


def test_a_process_that_dies_costs_its_own_task_only(tmp_path):
    answers, _ = run(tmp_path, 2, "dies_1", "works_1", "exits_1", "dies_2", "works_2")
    assert "SIGKILL" in answers[0] and "SIGKILL" in answers[3] and "exit status 3" in answers[2]
    assert answers[1].startswith("works") and answers[4].startswith("works")


def test_warnings_of_the_processes_are_warnings_here(tmp_path):
    with pytest.warns(UserWarning, match="palms are hard"):
        assert run(tmp_path, 1, "warns")[0][0].startswith("warns")


def heard() -> None:
    """Where the tests run in the background of a script, an interruption would be ignored by all that they start."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def started(folder: Path, *names: str) -> subprocess.Popen:
    """Another program that makes these in two processes, and has begun."""
    code = f"from test_processes import *\nrun(Path({str(folder)!r}), 2, *{names!r})"  # there is no main module
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, start_new_session=True,
        stderr=subprocess.PIPE, text=True, preexec_fn=heard,
    )  # fmt: skip
    until(lambda: all((folder / name / "begun").exists() for name in names))
    return process


@pytest.mark.parametrize("to", ["the group", "the parent", "the parent, for good"])
def test_an_interruption_stops_all_and_keeps_what_there_is(tmp_path, to):
    names = ["waits_1", "waits_2"]
    parent = started(tmp_path, *names)
    if to == "the group":  # as Ctrl-C in a terminal does
        os.killpg(parent.pid, signal.SIGINT)
    else:
        parent.send_signal(signal.SIGINT if to == "the parent" else signal.SIGKILL)
    until(lambda: not any(alive(pid_of(tmp_path / name)) for name in names), 15)
    assert all((tmp_path / name / "kept").exists() for name in names)
    _, said = parent.communicate(timeout=15)
    assert parent.returncode == (-signal.SIGKILL if to.endswith("good") else -signal.SIGINT)
    assert said.count("Traceback") == (0 if to.endswith("good") else 1), "the parent's alone"


def test_progress_adds_up():
    progress = Progress(["a", "b", "c"], show=False)
    assert progress.frames == (0, 0)
    progress.step(0, 0, 10)
    assert progress.frames == (0, 30), "the others are likely as long"
    progress.step(1, 5, 20)
    assert progress.frames == (5, 45) and progress.words() == "a 0/10, b 5/20"
    progress.step(0, 10, 10)
    assert progress.words() == "a object, b 5/20"
    progress.finished(0)
    progress.finished(1)  # failed at frame 5
    assert progress.frames == (15, 22) and progress.words() == ""
    progress.finished(2)  # failed before it was opened
    assert progress.frames == (15, 15)


def test_bar_on_stderr(capsys):
    with Progress(["a", "b"], show=True) as progress:
        progress.step(0, 2, 8)
        progress.finished(0)
    said = capsys.readouterr().err
    assert "0 of 2 recordings" in said and "1 of 2 recordings" in said and "2/4" in said
