"""A learnt action on disk: a folder with skill.json, which people can read, and skill.npz, which holds the mixtures.

skill.json
    format        "skill/1"
    task, robot   names
    object        articulation of the demonstrated object (in the floor frame of its handle at rest), how far it went
    handle        its dimensions
    gripper       planes of symmetry
    segments      for each: duration, number of components, and where mixtures and charts lie in skill.npz
    progress      share of the opening over the time of the manipulation
    arrays        SHA-256 of skill.npz, so that halves of two skills are never read as one
    provenance    whatever the writer says: demonstrations, versions, dates
skill.npz
    SEGMENT/weights, means, covariances, R_mean
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from understudy.actions.features import FEATURES, Chart
from understudy.actions.mixture import Mixture
from understudy.actions.model import ActionModel, SegmentModel
from understudy.actions.objects import ObjectMotion
from understudy.actions.segments import SEGMENTS
from understudy.errors import RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.geometry import is_rigid
from understudy.objects.articulation import Articulation, Handle

FORMAT: Final = "skill/1"
JSON, NPZ = "skill.json", "skill.npz"

_ARRAYS: Final = ("weights", "means", "covariances", "R_mean")


@dataclass(frozen=True, eq=False)
class Skill:
    """An action model and where it is from."""

    model: ActionModel
    task: str
    robot: str
    provenance: dict[str, Any] = field(default_factory=dict)
    """plain data for JSON"""


def save_skill(folder: Path, skill: Skill) -> None:
    """Writes a skill. The old one stays readable until skill.json, the last file, is in place."""
    model, buffer = skill.model, io.BytesIO()
    arrays: dict[str, np.ndarray] = {}
    for name, segment in model.segments.items():
        mixture = segment.mixture
        values = (mixture.weights, mixture.means, mixture.covariances, segment.chart.R_mean)
        arrays |= {f"{name}/{key}": value for key, value in zip(_ARRAYS, values, strict=True)}
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # numpy's stubs take names for its own flag
    content = buffer.getvalue()
    data = {"format": FORMAT, "task": skill.task, "robot": skill.robot, **_describe(model)}
    data |= {"arrays": {"file": NPZ, "sha256": hashlib.sha256(content).hexdigest()}, "provenance": skill.provenance}
    try:
        text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError) as e:
        raise UnderstudyError(f"skill: provenance must be plain data for JSON: {e}") from e
    folder = Path(folder)
    write_atomically(folder / NPZ, content)
    write_atomically(folder / JSON, text)


def load_skill(folder: Path) -> Skill:
    """Reads a skill. Raises RecordingError that names the file and the field."""
    path = Path(folder) / JSON
    if not path.is_file():
        raise RecordingError(f"{folder}: no skill: {JSON} is not there")
    data = read_json(path)
    if data.get("format") != FORMAT:
        raise RecordingError(f"{path}: format is {data.get('format')!r}, this version of understudy reads {FORMAT!r}")
    try:
        arrays = _read_arrays(Path(folder) / NPZ, str(data["arrays"]["sha256"]))
        model = _model(data, arrays)
        return Skill(model, str(data["task"]), str(data["robot"]), dict(data["provenance"]))
    except KeyError as e:
        raise RecordingError(f"{path}: no {e}") from e
    except RecordingError:
        raise
    except (TypeError, ValueError, AttributeError) as e:
        raise RecordingError(f"{path}: {e}") from e


def _describe(model: ActionModel) -> dict[str, Any]:
    thing, handle = model.object, model.handle
    segments = {
        name: {
            "duration_s": list(segment.duration_s),
            "components": len(segment.mixture),
            "base_yaw_mean": segment.chart.yaw_mean,
        }
        for name, segment in model.segments.items()
    }
    return {
        "demonstrations": model.demonstrations,
        "object": {
            "articulation": thing.articulation.to_json(),
            "T_start": thing.T_start.tolist(),
            "q_start": thing.q_start,
            "q_goal": thing.q_goal,
        },
        "handle": {"length_m": handle.length_m, "radius_m": handle.radius_m, "standoff_m": handle.standoff_m},
        "gripper": {"planes": model.planes},
        "features": ["phase", *FEATURES],
        "segments": segments,
        "progress": model.progress.tolist(),
    }


def _read_arrays(path: Path, digest: str) -> dict[str, np.ndarray]:
    try:
        content = path.read_bytes()
    except OSError as e:
        raise RecordingError(f"{path}: not readable: {e}") from e
    if hashlib.sha256(content).hexdigest() != digest:
        raise RecordingError(f"{path}: not the file that {JSON} was written with (damaged, or of another skill)")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: np.asarray(file[name], np.float64) for name in file.files}
    except (ValueError, OSError, zipfile.BadZipFile) as e:
        raise RecordingError(f"{path}: {e}") from e


def _model(data: dict[str, Any], arrays: dict[str, np.ndarray]) -> ActionModel:
    if data["features"] != ["phase", *FEATURES]:
        raise ValueError(f"features are {data['features']}, should be {['phase', *FEATURES]}")
    segments = {}
    for name in SEGMENTS:
        entry = data["segments"][name]
        weights, means, covariances, R_mean = (arrays[f"{name}/{key}"] for key in _ARRAYS)
        if means.ndim != 2 or means.shape[1] != 1 + len(FEATURES):
            raise ValueError(f"{name}/means must have {1 + len(FEATURES)} columns, got shape {means.shape}")
        mean_s, spread_s = (float(x) for x in entry["duration_s"])
        if not (mean_s > 0 and spread_s >= 0):
            raise ValueError(f"segments: {name}: duration_s must be positive, got {entry['duration_s']}")
        chart = Chart(R_mean, float(entry["base_yaw_mean"]))
        segments[name] = SegmentModel(Mixture(weights, means, covariances), chart, (mean_s, spread_s))
    progress = np.array(data["progress"], np.float64)
    if progress.shape != (33,) or progress[0] != 0 or progress[-1] != 1 or (np.diff(progress) < 0).any():
        raise ValueError("progress must be 33 numbers that rise from 0 to 1")
    thing = data["object"]
    articulation = Articulation.from_json(thing["articulation"], "object")
    T_start = np.array(thing["T_start"], np.float64)
    if T_start.shape != (4, 4) or not is_rigid(T_start):
        raise ValueError("object: T_start must be a rigid 4x4 transform")
    motion = ObjectMotion(articulation, T_start, float(thing["q_start"]), float(thing["q_goal"]))
    handle = Handle(*(float(data["handle"][key]) for key in ("length_m", "radius_m", "standoff_m")))
    planes, demonstrations = str(data["gripper"]["planes"]), int(data["demonstrations"])
    return ActionModel(segments, progress, motion, handle, planes, demonstrations)
