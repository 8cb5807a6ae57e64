"""What is exactly true of a recording from the stage: `stage_truth.json` and `stage_truth.npz` beside recording.json.

World frame: see `furniture.py` (z up, floor at z = 0, the closed front in the plane x = 0). Sample i is frame i.
The json holds what does not change: task, seed, furniture, markers, segments, the camera's pose. The npz holds the
trajectories: times_s (t), q (t), T_world_object, T_world_left_hand, T_world_right_hand (t, 4, 4), torso_xy_yaw (t, 3),
joints (t, 18, 3).
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.demonstration.demonstration import Segments
from understudy.errors import RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.objects.articulation import Articulation, Handle
from understudy.objects.marker_setup import MarkerSetup
from understudy.stage.furniture import Box, Dynamics, Furniture

FACTS: Final = "stage_truth.json"
TRAJECTORIES: Final = "stage_truth.npz"
FORMAT: Final = "stage-truth/1"
SIDES: Final = ("left", "right")

_ARRAYS: Final = {
    "times_s": (),
    "q": (),
    "T_world_object": (4, 4),
    "T_world_left_hand": (4, 4),
    "T_world_right_hand": (4, 4),
    "torso_xy_yaw": (3,),
    "joints": (18, 3),
}


@dataclass(frozen=True, eq=False)
class StageTruth:
    """The truth of one recorded demonstration. World frame."""

    furniture: Furniture
    seed: int
    settings: Mapping[str, Any]
    """what the recording was made with: sensor, fps ..."""
    T_world_cam: Float[np.ndarray, "4 4"]
    """of the colour camera, which does not move"""
    times_s: Float[np.ndarray, " t"]
    q: Float[np.ndarray, " t"]
    """how far the part is open, radians or metres"""
    T_world_object: Float[np.ndarray, "t 4 4"]
    """of the handle's frame"""
    T_world_hand: Mapping[str, Float[np.ndarray, "t 4 4"]]
    """left and right"""
    torso_xy_yaw: Float[np.ndarray, "t 3"]
    """metres, metres, radians"""
    joints: Float[np.ndarray, "t 18 3"]
    """of the person"""
    acting: str
    """which hand: left or right"""
    segments: Segments
    markers: MarkerSetup | None = None

    @property
    def task(self) -> str:
        """One of demonstration.tasks.TASKS."""
        return self.furniture.task


def write_stage_truth(folder: Path, truth: StageTruth) -> None:
    """Writes both files into a recording's folder."""
    facts = {
        "format": FORMAT,
        "task": truth.task,
        "seed": truth.seed,
        "settings": dict(truth.settings),
        "T_world_cam": truth.T_world_cam.tolist(),
        "acting": truth.acting,
        "segments": {"grasp": truth.segments.grasp, "release": truth.segments.release},
        "furniture": furniture_to_json(truth.furniture),
        "markers": None if truth.markers is None else truth.markers.to_json(),
    }
    write_atomically(folder / FACTS, json.dumps(facts, indent=1, allow_nan=False))
    arrays = {
        "times_s": truth.times_s,
        "q": truth.q,
        "T_world_object": truth.T_world_object,
        "T_world_left_hand": truth.T_world_hand["left"],
        "T_world_right_hand": truth.T_world_hand["right"],
        "torso_xy_yaw": truth.torso_xy_yaw,
        "joints": truth.joints,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomically(folder / TRAJECTORIES, buffer.getvalue())


def read_stage_truth(folder: str | Path) -> StageTruth:
    """The truth of a recording from the stage. Raises RecordingError that names the file and the field."""
    path = Path(folder) / FACTS
    facts = read_json(path)
    if facts.get("format") != FORMAT:
        raise RecordingError(f"{path}: format must be {FORMAT!r}, got {facts.get('format')!r}")
    arrays = _read_arrays(Path(folder) / TRAJECTORIES)
    try:
        return StageTruth(
            furniture_from_json(facts["furniture"], str(path)),
            int(facts["seed"]),
            dict(facts["settings"]),
            np.array(facts["T_world_cam"], np.float64),
            arrays["times_s"],
            arrays["q"],
            arrays["T_world_object"],
            {side: arrays[f"T_world_{side}_hand"] for side in SIDES},
            arrays["torso_xy_yaw"],
            arrays["joints"],
            str(facts["acting"]),
            Segments(int(facts["segments"]["grasp"]), int(facts["segments"]["release"])),
            None if facts["markers"] is None else MarkerSetup.from_json(facts["markers"], f"{path}: markers"),
        )
    except UnderstudyError:
        raise
    except KeyError as e:
        raise RecordingError(f"{path}: field {e} is missing") from e
    except (TypeError, ValueError) as e:
        raise RecordingError(f"{path}: {e}") from e


def furniture_to_json(furniture: Furniture) -> dict[str, Any]:
    """Plain lists and numbers."""
    return {
        "task": furniture.task,
        "articulation": furniture.articulation.to_json(),
        "handle": asdict(furniture.handle),
        "panel": _box_to_json(furniture.panel),
        "parts": [_box_to_json(box) for box in furniture.parts],
        "blocks": [_box_to_json(box) for box in furniture.blocks],
        "dynamics": asdict(furniture.dynamics),
        "open_to": furniture.open_to,
    }


def furniture_from_json(data: Mapping[str, Any], where: str) -> Furniture:
    """The inverse of `furniture_to_json`. Raises UnderstudyError that begins with `where`."""
    try:
        return Furniture(
            str(data["task"]),
            Articulation.from_json(data["articulation"], where),
            Handle(**{name: float(value) for name, value in data["handle"].items()}),
            _box_from_json(data["panel"]),
            tuple(_box_from_json(box) for box in data["parts"]),
            tuple(_box_from_json(box) for box in data["blocks"]),
            Dynamics(**{name: float(value) for name, value in data["dynamics"].items()}),
            float(data["open_to"]),
        )
    except UnderstudyError:
        raise
    except KeyError as e:
        raise RecordingError(f"{where}: furniture has no {e}") from e
    except (TypeError, ValueError, AttributeError) as e:
        raise RecordingError(f"{where}: furniture: {e}") from e


def _box_to_json(box: Box) -> dict[str, Any]:
    return {
        "name": box.name,
        "material": box.material,
        "T_frame_box": box.T_frame_box.tolist(),
        "half_m": list(box.half_m),
    }


def _box_from_json(data: Mapping[str, Any]) -> Box:
    x, y, z = (float(v) for v in data["half_m"])
    return Box(str(data["name"]), str(data["material"]), np.array(data["T_frame_box"], np.float64), (x, y, z))


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in _ARRAYS}
    except KeyError as e:
        raise RecordingError(f"{path}: {e}") from e
    except Exception as e:  # a broken zip file raises many kinds
        raise RecordingError(f"{path}: not readable: {e}") from e
    t = len(arrays["times_s"])
    for name, shape in _ARRAYS.items():
        if arrays[name].shape != (t, *shape):
            raise RecordingError(f"{path}: {name} must have the shape {(t, *shape)}, got {arrays[name].shape}")
    return arrays
