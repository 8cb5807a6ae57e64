"""Results as a folder: `adaptation.json` (grasp, calibration, metrics, course) and one `NNN.npz` per demonstration."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.adaptation.calibration import Calibration
from understudy.adaptation.metrics import Metrics, as_numbers
from understudy.adaptation.platform import JointPath
from understudy.adaptation.result import AdaptationResult, Adapted, Report
from understudy.adaptation.solver import Convergence, Iteration
from understudy.errors import RecordingError
from understudy.files import read_json, write_atomically
from understudy.geometry import is_rigid

FILE: Final = "adaptation.json"
FORMAT: Final = 2
_ARRAYS: Final = ("times_s", "T_world_tool", "base", "torso", "achievable", "collision_free", "grasp")
_ENERGY: Final = "energy:"
_JOINTS: Final = "joints:"


def save(folder: Path, result: AdaptationResult, metrics: Mapping[str, Metrics] | None = None) -> None:
    """Writes a result; the JSON file last, so that a folder that has one is whole."""
    folder = Path(folder)
    for i, d in enumerate(result.demonstrations):
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {name: getattr(d, name) for name in _ARRAYS}
        arrays |= {_ENERGY + kind: values for kind, values in d.energies.items()}
        if d.joints is not None:
            arrays |= {_JOINTS + f.name: getattr(d.joints, f.name) for f in fields(JointPath)}
        np.savez_compressed(buffer, **arrays)
        write_atomically(folder / f"{i:03d}.npz", buffer.getvalue())
    convergence = result.report.convergence
    data = {
        "format": FORMAT,
        "task": result.task,
        "robot": result.robot,
        "demonstrations": len(result.demonstrations),
        "T_object_tool": result.grasp.tolist(),
        "T_hand_tool": result.calibration.T_hand_tool.tolist(),
        "T_left_tool": None if result.calibration.T_left_tool is None else result.calibration.T_left_tool.tolist(),
        "torso_base": result.calibration.torso_base.tolist(),
        "rounds": result.report.rounds,
        "notes": list(result.report.notes),
        "converged": convergence.converged,
        "seconds": convergence.seconds,
        "process_seconds": convergence.process_seconds,
        "iterations": [vars(i) for i in convergence.iterations],
        "metrics": {when: as_numbers(m) for when, m in (metrics or {}).items()},
    }
    write_atomically(folder / FILE, json.dumps(data, indent=1))


def load(folder: Path) -> AdaptationResult:
    """Reads what `save` wrote. Raises RecordingError that names the file."""
    folder = Path(folder)
    path = folder / FILE
    data = read_json(path)
    if data.get("format") != FORMAT:
        raise RecordingError(f"{path}: format: must be {FORMAT}, got {data.get('format')!r}")
    try:
        left = None if data["T_left_tool"] is None else _rigid(data, "T_left_tool", path)
        calibration = Calibration(_rigid(data, "T_hand_tool", path), _array(data, "torso_base", (3,), path), left)
        iterations = tuple(Iteration(**i) for i in data["iterations"])
        seconds = float(data["seconds"]), float(data["process_seconds"])
        report = Report(
            Convergence(iterations, bool(data["converged"]), *seconds), int(data["rounds"]), tuple(data["notes"])
        )
        return AdaptationResult(
            str(data["task"]),
            str(data["robot"]),
            tuple(_demonstration(folder / f"{i:03d}.npz") for i in range(int(data["demonstrations"]))),
            _rigid(data, "T_object_tool", path),
            calibration,
            report,
        )
    except KeyError as e:
        raise RecordingError(f"{path}: no field {e}") from e
    except TypeError as e:
        raise RecordingError(f"{path}: {e}") from e


def _array(data: dict[str, Any], name: str, shape: tuple[int, ...], path: Path) -> Float[np.ndarray, "..."]:
    try:
        value = np.array(data[name], np.float64)
    except ValueError as e:
        raise RecordingError(f"{path}: {name}: must be numbers") from e
    if value.shape != shape or not np.isfinite(value).all():
        raise RecordingError(f"{path}: {name}: must be finite numbers of shape {shape}, got shape {value.shape}")
    return value


def _rigid(data: dict[str, Any], name: str, path: Path) -> Float[np.ndarray, "4 4"]:
    T = _array(data, name, (4, 4), path)
    if not is_rigid(T):
        raise RecordingError(f"{path}: {name}: must be a rigid 4x4 transform")
    return T


def _demonstration(path: Path) -> Adapted:
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as e:
        raise RecordingError(f"{path}: not readable: {e}") from e
    missing = [name for name in _ARRAYS if name not in arrays]
    if missing:
        raise RecordingError(f"{path}: no array {missing[0]!r}")
    t = arrays["times_s"].shape[0] if arrays["times_s"].ndim else 0
    shapes = {"times_s": (t,), "T_world_tool": (t, 4, 4), "base": (t, 3), "grasp": (4, 4)}
    shapes |= {
        _JOINTS + "q": (t, *arrays.get(_JOINTS + "q", np.zeros((t, 0))).shape[1:2]),
        _JOINTS + "linked": (t - 1,),
    }
    for name in arrays:
        if arrays[name].shape != shapes.get(name, (t,)):
            raise RecordingError(f"{path}: {name}: must have shape {shapes.get(name, (t,))}, got {arrays[name].shape}")
    energies = {name.removeprefix(_ENERGY): a for name, a in arrays.items() if name.startswith(_ENERGY)}
    found = {f.name: arrays[_JOINTS + f.name] for f in fields(JointPath) if _JOINTS + f.name in arrays}
    joints = JointPath(**found) if len(found) == len(fields(JointPath)) else None
    return Adapted(**{name: arrays[name] for name in _ARRAYS}, energies=energies, joints=joints)
