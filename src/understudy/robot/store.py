"""What is computed for a robot is kept under its checksum: in the package (shipped) or in the cache folder."""

from __future__ import annotations

import hashlib
import io
import logging
import zipfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np

from understudy import assets
from understudy.files import write_atomically
from understudy.robot.model import Robot

Arrays = Mapping[str, np.ndarray]

log = logging.getLogger(__name__)


def key(robot: Robot, kind: str, settings: str) -> str:
    """Changes with the robot's files, the kind of data and the settings it is made with."""
    return hashlib.sha256(f"{robot.checksum} {kind} {settings}".encode()).hexdigest()[:24]


def cache_path(robot: Robot, kind: str, settings: str) -> Path:
    """Where the data is kept, or will be."""
    return assets.cache_dir() / "robots" / f"{robot.name}-{kind}-{key(robot, kind, settings)}.npz"


def load(robot: Robot, kind: str, settings: str) -> dict[str, np.ndarray] | None:
    """The arrays, if they were kept for this very robot and these settings; else None."""
    shipped = files("understudy.robot") / "descriptions" / f"{robot.name}-{kind}.npz"
    if shipped.is_file():
        arrays = _unpack(shipped.read_bytes())
        if arrays is not None and str(arrays.get("key")) == key(robot, kind, settings):
            return arrays
    path = cache_path(robot, kind, settings)
    if not path.is_file():
        return None
    arrays = _unpack(path.read_bytes())
    if arrays is None:
        log.warning("%s: not readable; it is made anew", path)
    return arrays


def pack(robot: Robot, kind: str, settings: str, arrays: Arrays) -> bytes:
    """A compressed .npz that says what it was made for."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, key=np.array(key(robot, kind, settings)), **dict(arrays))  # type: ignore[arg-type]
    return buffer.getvalue()


def save(robot: Robot, kind: str, settings: str, arrays: Arrays) -> None:
    """Keeps the arrays in the cache folder; a cache that cannot be written costs time only."""
    path = cache_path(robot, kind, settings)
    try:
        write_atomically(path, pack(robot, kind, settings, arrays))
    except OSError as e:
        log.warning("%s: not written (%s): it will be computed again next time", path, e)


def _unpack(content: bytes) -> dict[str, np.ndarray] | None:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
