"""The folder of `teaching`: what its stages leave there, and read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from understudy import recordings
from understudy.adaptation import metrics as measures
from understudy.adaptation import storage as adaptations
from understudy.adaptation.metrics import Metrics
from understudy.adaptation.result import AdaptationResult
from understudy.demonstration import storage
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import Result
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.pipeline import signature
from understudy.teaching_stages import plain

if TYPE_CHECKING:
    from understudy.adaptation.platform import Platform
    from understudy.robot.model import Robot

CONFIG, REPORT = "config.json", "report.html"
DEMONSTRATIONS, ADAPTATION, TRIALS = "demonstrations", "adaptation", "trials"
RESULTS: Final = "results.json"
"""in demonstrations/: what became of each recording; in adaptation/: what was left out"""
FORMAT: Final = "teaching/1"


@dataclass(frozen=True)
class Seen:
    """What became of one recording."""

    recording: str
    name: str
    """of its folder under demonstrations/"""
    failed: str | None = None
    """why it was left out"""


def require_ours(out: Path) -> None:
    """Raises UnderstudyError if the folder holds something that `teach` did not write."""
    if out.exists() and not out.is_dir():
        raise UnderstudyError(f"{out}: is a file; the skill needs a folder")
    if not out.is_dir() or not any(out.iterdir()):
        return
    config = out / CONFIG
    if not config.exists() or read_json(config).get("format") != FORMAT:
        raise UnderstudyError(f"{out}: holds something that `understudy teach` did not write; choose another folder")


def robot_named(name: str) -> tuple[Robot, Platform]:
    """A robot, and as the adaptation sees it. Raises RobotError; MissingExtraError without the extra 'robot'."""
    from understudy.cli.common import needs_extra

    with needs_extra("robots", "robot"):
        from understudy.adaptation.robots import platform_of
        from understudy.robot.model import load_robot
    robot = load_robot(name)
    return robot, platform_of(robot)


def state_of(recording: str) -> str:
    """A word that changes with a recording's files; of one that cannot be opened, the reason."""
    try:
        with recordings.open(recording) as opened:
            return signature([path for i in range(len(opened)) for path in opened.sources(i)])
    except UnderstudyError as e:
        return str(e)


def save_seen(folder: Path, results: Sequence[Result]) -> tuple[Seen, ...]:
    """What became of the recordings."""
    seen = tuple(Seen(r.recording, r.folder.name, r.failed) for r in results)
    content = {"format": FORMAT, "recordings": [plain(s) for s in seen]}
    write_atomically(folder / RESULTS, json.dumps(content, indent=1) + "\n")
    return seen


def load_seen(folder: Path) -> tuple[Seen, ...]:
    """Reads it. Raises RecordingError if a demonstration is damaged, or a recording had failed: it is tried again."""
    path = folder / RESULTS
    try:
        seen = tuple(Seen(**entry) for entry in read_json(path)["recordings"])
    except (KeyError, TypeError) as e:
        raise RecordingError(f"{path}: {e}") from e
    for s in seen:
        if s.failed:
            raise RecordingError(f"{s.recording}: {s.failed}")
    load_shown(folder, seen)
    return seen


def load_shown(folder: Path, seen: Sequence[Seen]) -> tuple[Demonstration, ...]:
    """The demonstrations of recordings that have one."""
    return tuple(storage.load(folder / s.name) for s in seen if not s.failed)


def arrays(folder: Path, seen: Sequence[Seen]) -> list[bytes]:
    """The demonstrations' trajectories as they lie on disk."""
    return [(folder / s.name / storage.ARRAYS).read_bytes() for s in seen]


def skill_files(out: Path) -> list[bytes]:
    """The skill as it lies on disk."""
    from understudy.actions.skill import JSON, NPZ

    return [(out / name).read_bytes() for name in (JSON, NPZ)]


def save_adaptation(
    folder: Path,
    demonstrations: Sequence[Demonstration],
    result: AdaptationResult,
    platform: Platform,
    left_out: dict[str, str],
) -> None:
    """With metrics, pictures (where matplotlib is there), and what was left out (name, reason)."""
    from understudy.adaptation.plots import pictures

    metrics = measures.evaluate(demonstrations, result, platform)
    try:
        for name, picture in pictures(demonstrations, result, platform, metrics).items():
            write_atomically(folder / name, picture)
    except MissingExtraError:
        pass  # pictures are optional, as matplotlib is
    write_atomically(folder / RESULTS, json.dumps({"left_out": left_out}, indent=1) + "\n")
    adaptations.save(folder, result, metrics)


def load_left_out(folder: Path) -> dict[str, str]:
    """Name -> reason. Raises RecordingError if the adaptation is damaged."""
    load_adaptation(folder)
    try:
        return {str(k): str(v) for k, v in read_json(folder / RESULTS)["left_out"].items()}
    except (KeyError, AttributeError) as e:
        raise RecordingError(f"{folder / RESULTS}: {e}") from e


def load_adaptation(folder: Path) -> tuple[AdaptationResult, dict[str, Metrics]]:
    """The result, and its metrics 'before' and 'after'. Raises RecordingError that names the file."""
    path = folder / adaptations.FILE
    result = adaptations.load(folder)
    try:
        metrics = {
            when: Metrics(**{name: float("nan") if value is None else float(value) for name, value in values.items()})
            for when, values in read_json(path)["metrics"].items()
        }
    except (KeyError, TypeError, AttributeError) as e:
        raise RecordingError(f"{path}: metrics: {e}") from e
    if set(metrics) != {"before", "after"}:
        raise RecordingError(f"{path}: metrics: must be of 'before' and 'after', got {sorted(metrics)}")
    return result, metrics
