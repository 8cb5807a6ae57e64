"""Reading JSON with errors that name the file; writing files whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from understudy.errors import RecordingError

LARGEST = 1e12
"""of the numbers in any file: seconds since 1970 fit, and everything in metres and pixels"""


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file. Raises RecordingError that names the file."""
    try:
        return parse_json(Path(path).read_bytes(), str(path))
    except FileNotFoundError as e:
        raise RecordingError(f"{path}: no such file") from e
    except OSError as e:
        raise RecordingError(f"{path}: not readable: {e}") from e


def parse_json(content: bytes, where: str) -> dict[str, Any]:
    """A JSON object. Raises RecordingError that begins with `where`; also for numbers that no quantity here can have,
    so that what reads the data need not think of overflow.
    """
    try:
        data = json.loads(
            content.decode("utf-8"), parse_int=_whole_number, parse_float=_number, parse_constant=_no_number
        )
    except (ValueError, RecursionError) as e:  # ValueError: bad UTF-8, bad JSON and what the hooks refuse
        raise RecordingError(f"{where}: not readable as JSON: {e}") from e
    if not isinstance(data, dict):
        raise RecordingError(f"{where}: must hold a JSON object")
    return data


def _whole_number(digits: str) -> int:
    if len(digits) > 13:
        raise ValueError(f"a number of {len(digits)} digits; the largest that makes sense here is {LARGEST:g}")
    return int(digits)


def _number(digits: str) -> float:
    value = float(digits)
    if not abs(value) <= LARGEST:
        raise ValueError(f"the number {digits[:20]}; the largest that makes sense here is {LARGEST:g}")
    return value


def _no_number(word: str) -> None:
    raise ValueError(f"{word} is not JSON; an unknown value is null")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file beside its place and moves it there, so that a reader never meets half a file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as f:
            f.write(content.encode() if isinstance(content, str) else content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
