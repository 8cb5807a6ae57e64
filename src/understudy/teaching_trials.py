"""A skill, tried in simulation: other furniture of the task, another place to start from, errors of localisation.

The only file of `teaching` that knows simulator and execution.
"""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from jaxtyping import Float

from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically

if TYPE_CHECKING:
    from understudy.actions import Skill
    from understudy.execution.outcome import Outcome
    from understudy.execution.trials import TrialSetup

TRIAL, TRAJECTORY, VIDEO, SHEET = "trial.json", "trajectory.npz", "video.mp4", "video.jpg"
FORMAT: Final = "taught-trial/1"
CURVES: Final = ("times_s", "opened", "force", "opening_m")
"""of the trajectory: what the report draws"""

_SHEET_WIDTH: Final = 320


@dataclass(frozen=True)
class Trial:
    """What came of one trial."""

    folder: Path
    number: int
    success: bool
    reason: str
    detail: str
    opened_share: float
    """of the goal"""
    retries: int
    max_force_n: float
    """between gripper and part"""
    duration_s: float
    """simulated"""
    seed: int
    """of furniture, start and noise (`execution.trials.TrialSetup`)"""
    note: str = ""
    """why there is no video"""

    @property
    def video(self) -> Path | None:
        """The mp4, if there is one."""
        return path if (path := self.folder / VIDEO).exists() else None

    @property
    def sheet(self) -> Path | None:
        """Frames of the video side by side (jpg), if there are any."""
        return path if (path := self.folder / SHEET).exists() else None


def layouts(task: str, count: int, seed: int) -> list[TrialSetup]:
    """`count` layouts of a task that no recording of the stage has."""
    from understudy.execution.trials import setups

    return setups(task, count, seed) if count else []


def run_trial(skill: Skill, robot_name: str, setup: TrialSetup, number: int, folder: Path, *, film: bool) -> Trial:
    """Runs one trial and saves it in `folder`. film: also a video, where OpenGL and a video encoder are there.

    Raises UnderstudyError when the task is none of the stage's.
    """
    from understudy.adaptation.robots import platform_of
    from understudy.execution import trials

    shutil.rmtree(folder, ignore_errors=True)  # of another skill, or of a run that was stopped
    robot = trials.trial_robot(robot_name)
    given = (skill.model, robot, platform_of(robot), setup)
    outcome, note = None, "not filmed"
    if film:
        try:
            outcome, note = trials.run_trial(*given, video=folder / VIDEO), ""
            write_atomically(folder / SHEET, _sheet(folder / VIDEO))
        except (UnderstudyError, MissingExtraError, OSError) as e:
            # no OpenGL, no encoder: the trial itself needs neither
            note = f"no video: {e}"
    outcome = outcome or trials.run_trial(*given)
    write_atomically(folder / TRAJECTORY, _packed(outcome))
    trial = Trial(
        folder,
        number,
        outcome.success,
        str(outcome.reason),
        outcome.detail,
        round(outcome.opened_share, 4),
        outcome.retries,
        round(outcome.max_force, 1),
        round(outcome.duration_s, 2),
        setup.seed,
        note,
    )
    data: dict[str, Any] = {name: getattr(trial, name) for name in _FIELDS}
    write_atomically(folder / TRIAL, json.dumps({"format": FORMAT, **data}, indent=1) + "\n")
    return trial


_FIELDS: Final = tuple(name for name in Trial.__dataclass_fields__ if name != "folder")


def load_trial(folder: Path) -> Trial:
    """Reads what `run_trial` saved. Raises RecordingError that names the file and the field."""
    path = folder / TRIAL
    data = read_json(path)
    if data.get("format") != FORMAT:
        raise RecordingError(f"{path}: format must be {FORMAT!r}, got {data.get('format')!r}")
    try:
        load_curves(folder)
        return Trial(folder, **{name: data[name] for name in _FIELDS})
    except KeyError as e:
        raise RecordingError(f"{path}: field {e} is missing") from e
    except (TypeError, ValueError) as e:
        raise RecordingError(f"{path}: {e}") from e


def load_curves(folder: Path) -> dict[str, Float[np.ndarray, " t"]]:
    """`CURVES` of a trial: seconds, radians or metres, newtons, metres. Raises RecordingError."""
    path = folder / TRAJECTORY
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in CURVES}
    except Exception as e:  # a broken zip file raises many kinds
        raise RecordingError(f"{path}: not readable: {e}") from e


def _packed(outcome: Outcome) -> bytes:
    arrays = {name: getattr(outcome.trajectory, name) for name in outcome.trajectory.__dataclass_fields__}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _sheet(video: Path) -> bytes:
    """Frames of a video side by side, as a JPEG. Raises UnderstudyError if it cannot be read."""
    from understudy.robot.simulator_video import contact_sheet

    capture, frames = cv2.VideoCapture(str(video)), []
    while (read := capture.read())[0]:
        scale = _SHEET_WIDTH / read[1].shape[1]
        frames.append(cv2.resize(read[1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    capture.release()
    if not frames:
        raise UnderstudyError(f"{video}: cannot be read back")
    done, data = cv2.imencode(".jpg", contact_sheet(frames), [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    return data.tobytes()
