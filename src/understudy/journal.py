"""The journal of an estimation: one line per finished frame, and which files it was made from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from understudy.errors import RecordingError
from understudy.files import parse_json, write_atomically
from understudy.people_file import FramePeople, frame_from_json, frame_to_json


@dataclass(frozen=True)
class Entry:
    """A line of the journal."""

    frame: FramePeople
    made_from: str
    """`signature` of the files"""

    def line(self) -> str:
        """As it is written."""
        return json.dumps({"made_from": self.made_from, **frame_to_json(self.frame)}, allow_nan=False) + "\n"


def read_journal(path: Path) -> dict[int, Entry]:
    """Finished frames by index; of several lines for a frame the last counts. A line that a crash has cut short is
    removed. Raises RecordingError when the journal is damaged otherwise.
    """
    if not path.exists():
        return {}
    *complete, rest = path.read_bytes().split(b"\n")
    done: dict[int, Entry] = {}
    for n, line in enumerate(complete, 1):
        where = f"{path}: line {n}"
        try:
            data = parse_json(line, where)
            frame = frame_from_json(data, where)
        except RecordingError as e:
            raise RecordingError(f"{e}. The journal is damaged; begin anew with --restart") from e
        done[frame.index] = Entry(frame, str(data.get("made_from")))
    if rest:
        write_atomically(path, b"\n".join([*complete, b""]))
    return done


def signature(files: Sequence[Path]) -> str:
    """A word that changes when files are replaced, edited or removed: from their names, sizes and times."""
    parts = []
    for path in files:
        try:
            state = path.stat()
            parts.append(f"{path.name}:{state.st_size}:{state.st_mtime_ns}")
        except OSError:
            parts.append(f"{path.name}:missing")
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:16]
