"""Stages that survive being killed: each is done once for the same inputs and settings, and its time is kept."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from understudy.errors import RecordingError, UnderstudyError
from understudy.files import read_json, write_atomically

FILE: Final = "stages.json"
FORMAT: Final = "stages/1"

T = TypeVar("T")


@dataclass(frozen=True)
class Stage:
    """What is known of one stage."""

    key: str
    """changes with everything that the stage is made from"""
    finished: bool = False
    seconds: float = 0.0
    """by the clock, of runs that finished"""
    process_seconds: float = 0.0
    """of all cores"""
    resumed: bool = False
    """an earlier run was stopped in the midst of it; its time is not counted"""


class Stages:
    """The stages of a folder, in `stages.json`."""

    def __init__(self, folder: Path):
        self._path = Path(folder) / FILE
        self.entries: dict[str, Stage] = _read(self._path)

    def run(self, name: str, key: str, load: Callable[[], T], make: Callable[[], T]) -> T:
        """What `make` makes; taken from `load` if it was made from the same before, and is still whole.

        make: saves its result itself. load: raises UnderstudyError or OSError when it finds it damaged.
        """
        before = self.entries.get(name, Stage(""))
        same = before.key == key
        if same and before.finished:
            try:
                return load()
            except (UnderstudyError, OSError):
                pass  # it is made again
        stage = replace(before, finished=False, resumed=before.resumed or not before.finished) if same else Stage(key)
        self._write(name, stage)
        began, processor = time.perf_counter(), time.process_time()
        result = make()
        seconds, process_seconds = time.perf_counter() - began, time.process_time() - processor
        stage = replace(
            stage,
            finished=True,
            seconds=round(stage.seconds + seconds, 3),
            process_seconds=round(stage.process_seconds + process_seconds, 3),
        )
        self._write(name, stage)
        return result

    def keep(self, names: set[str]) -> None:
        """Forgets all other stages."""
        self.entries = {name: stage for name, stage in self.entries.items() if name in names}

    def _write(self, name: str, stage: Stage) -> None:
        self.entries[name] = stage
        entries = {name: asdict(stage) for name, stage in self.entries.items()}
        write_atomically(self._path, json.dumps({"format": FORMAT, "stages": entries}, indent=1) + "\n")


def _read(path: Path) -> dict[str, Stage]:
    """None of a file that is damaged: all stages are made again then, from what lies beside it."""
    if not path.exists():
        return {}
    try:
        data = read_json(path)
        if data.get("format") != FORMAT:
            return {}
        return {str(name): Stage(**entry) for name, entry in data["stages"].items()}
    except (RecordingError, KeyError, TypeError, AttributeError):
        return {}


def digest(*parts: Any) -> str:
    """A word that changes with any of the parts: bytes, or data that `plain` knows."""
    hashes = [
        hashlib.sha256(p if isinstance(p, bytes) else json.dumps(plain(p), sort_keys=True).encode()).digest()
        for p in parts
    ]
    return hashlib.sha256(b"".join(hashes)).hexdigest()[:24]


def plain(value: Any) -> Any:
    """Settings as JSON knows them."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value
