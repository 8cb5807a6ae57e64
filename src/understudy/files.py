"""Reading JSON with errors that name the file; writing files whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from understudy.errors import RecordingError


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file. Raises RecordingError that names the file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        data = json.loads(text, parse_int=_whole_number, parse_constant=_no_number)
    except FileNotFoundError as e:
        raise RecordingError(f"{path}: no such file") from e
    except (OSError, ValueError, RecursionError) as e:  # ValueError: bad UTF-8, bad JSON and what the hooks refuse
        raise RecordingError(f"{path}: not readable as JSON: {e}") from e
    if not isinstance(data, dict):
        raise RecordingError(f"{path}: must hold a JSON object")
    return data


def _whole_number(digits: str) -> int:
    if len(digits) > 300:  # no float can hold it: what reads the data need not think of overflow
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


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
