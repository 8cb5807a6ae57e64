"""The known formats, and which of them a path is.

To add a format: one new file with a subclass of `Recording`, and one line in `FORMATS`.
"""

import inspect
from pathlib import Path
from typing import Any

from understudy.errors import RecordingError
from understudy.recordings.base import Recording
from understudy.recordings.folder import FolderRecording
from understudy.recordings.k4a import KinectRecording
from understudy.recordings.tum import TumRecording

FORMATS: tuple[type[Recording], ...] = (
    FolderRecording,
    TumRecording,
    KinectRecording,
)
"""Asked in this order; the first that recognizes a path opens it."""

SAMPLES = {"sample": "room", "sample-drawer": "drawer"}
"""Names that stand for the bundled recordings (a folder of such a name is opened as './sample'), and their folders:
people in a room; a person who opens a drawer."""


def sample_path(name: str = "sample") -> Path:
    """A recording that comes with the package: one of `SAMPLES`."""
    return Path(__file__).resolve().parents[1] / "samples" / SAMPLES[name]


def open(path: str | Path, **options: Any) -> Recording:  # shadows the builtin here, on purpose: recordings.open(...)
    """Opens a recording of any known format; 'sample' and 'sample-drawer' come with the package.

    `options` go to the format (for example `K` for a TUM sequence). Raises RecordingError if the path does not exist,
    is of no known format or cannot be read as a whole.
    """
    place = sample_path(str(path)) if str(path) in SAMPLES else Path(path)
    try:
        exists = place.exists()
    except (OSError, ValueError) as e:  # names with a NUL, too long names
        raise RecordingError(f"{str(path)!r} is not a path: {e}") from e
    if not exists:
        raise RecordingError(f"{place}: no such file or folder")
    for kind in FORMATS:
        if kind.recognizes(place):
            return _construct(kind, place, options)
    known = "".join(f"\n  {kind.format_name}: {kind.looks_for}" for kind in FORMATS)
    raise RecordingError(
        f"{place}: not a recording of a known format. The known formats and what each looks for:{known}"
    )


def _construct(kind: type[Recording], path: Path, options: dict[str, Any]) -> Recording:
    valid = list(inspect.signature(kind).parameters)[1:]
    unknown = [name for name in options if name not in valid]
    if unknown:
        raise RecordingError(
            f"{path}: a {kind.format_name} has no option {unknown[0]!r}; "
            + (f"its options are {', '.join(valid)}" if valid else "it has no options")
        )
    return kind(path, **options)
