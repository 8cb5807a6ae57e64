"""A demonstration on disk: one folder with demonstration.json (what one reads) and demonstration.npz (the arrays)."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from understudy.demonstration.demonstration import Demonstration, OccupancyMap, Segments
from understudy.errors import RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.objects.articulation import Articulation, Handle
from understudy.trajectories import PlanarTrack, PoseTrack

FORMAT = "demonstration/1"
INFO, ARRAYS = "demonstration.json", "demonstration.npz"

_ARRAYS = (
    "times_s", "hand_T", "hand_covariance", "hand_observed", "hand_oriented",
    "object_T", "object_covariance", "object_observed", "object_oriented",
    "torso_xy_yaw", "torso_covariance", "torso_observed",
    "joints", "scene", "part", "map_state", "map_origin_xy", "T_world_cam",
)  # fmt: skip


def save(folder: Path, demo: Demonstration) -> Path:
    """Writes the folder. The json comes last: a folder without it is not finished."""
    folder = Path(folder)
    arrays = {
        "times_s": demo.times_s,
        "torso_xy_yaw": demo.torso.xy_yaw,
        "torso_covariance": demo.torso.covariance,
        "torso_observed": demo.torso.observed,
        "joints": demo.joints,
        "scene": demo.scene,
        "part": demo.part,
        "map_state": demo.map.state,
        "map_origin_xy": demo.map.origin_xy,
        "T_world_cam": demo.T_world_cam,
    }
    for name, track in (("hand", demo.hand), ("object", demo.object)):
        arrays |= {
            f"{name}_T": track.T_world_x,
            f"{name}_covariance": track.covariance,
            f"{name}_observed": track.observed,
            f"{name}_oriented": track.oriented,
        }
    assert set(arrays) == set(_ARRAYS)
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    write_atomically(folder / ARRAYS, content.getvalue())
    info = {
        "format": FORMAT,
        "task": demo.task,
        "acting": demo.acting,
        "segments": {
            "grasp": demo.segments.grasp,
            "release": demo.segments.release,
            "grasp_s": float(demo.times_s[demo.segments.grasp]),
            "release_s": float(demo.times_s[min(demo.segments.release, len(demo) - 1)]),
        },
        "articulation": demo.articulation.to_json(),
        "handle": {
            "length_m": demo.handle.length_m,
            "radius_m": demo.handle.radius_m,
            "standoff_m": demo.handle.standoff_m,
        },
        "map_resolution_m": demo.map.resolution_m,
        "source": demo.source,
    }
    write_atomically(folder / INFO, json.dumps(info, indent=1, allow_nan=False) + "\n")
    return folder


def load(folder: Path) -> Demonstration:
    """Reads the folder. Raises RecordingError that names the file and the field."""
    folder = Path(folder)
    where = folder / INFO
    if not where.exists():
        raise RecordingError(f"{folder}: holds no {INFO}; `understudy demonstrate` writes such folders")
    info = read_json(where)
    if info.get("format") != FORMAT:
        raise RecordingError(f"{where}: field 'format' must be {FORMAT!r}, got {info.get('format')!r}")
    a = _arrays(folder / ARRAYS)
    try:
        handle = info["handle"]
        return Demonstration(
            task=str(info["task"]),
            times_s=a["times_s"],
            acting=str(info["acting"]),
            hand=_track(a, "hand"),
            torso=PlanarTrack(a["torso_xy_yaw"], a["torso_covariance"], a["torso_observed"]),
            object=_track(a, "object"),
            articulation=Articulation.from_json(info["articulation"], str(where)),
            handle=Handle(*(float(handle[k]) for k in ("length_m", "radius_m", "standoff_m"))),
            segments=Segments(int(info["segments"]["grasp"]), int(info["segments"]["release"])),
            map=OccupancyMap(a["map_state"], a["map_origin_xy"], float(info["map_resolution_m"])),
            scene=a["scene"],
            T_world_cam=a["T_world_cam"],
            joints=a["joints"],
            part=a["part"],
            source=dict(info.get("source") or {}),
        )
    except KeyError as e:
        raise RecordingError(f"{where}: field {e} is missing") from e
    except RecordingError:
        raise
    except (UnderstudyError, TypeError, ValueError) as e:
        raise RecordingError(f"{where}: {e}") from e


def _track(a: dict[str, np.ndarray], name: str) -> PoseTrack:
    return PoseTrack(a[f"{name}_T"], a[f"{name}_covariance"], a[f"{name}_observed"], a[f"{name}_oriented"])


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in _ARRAYS if name not in file]
            if missing:
                raise RecordingError(f"{path}: array {missing[0]!r} is missing")
            return {name: file[name] for name in _ARRAYS}
    except FileNotFoundError as e:
        raise RecordingError(f"{path}: no such file") from e
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as e:
        if isinstance(e, RecordingError):
            raise
        raise RecordingError(f"{path}: not readable: {e}") from e
