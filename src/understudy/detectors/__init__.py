"""2D keypoints of every person. One Protocol (`base.py`), one file per back-end, `create` to get one by name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from understudy.detectors.base import Detector
from understudy.errors import DetectorError, one_of

if TYPE_CHECKING:
    from understudy.recordings.base import Recording

NAMES = ("blazepose", "recording", "openpose-json:FOLDER")
"""What `create` takes."""


def create(name: str, recording: Recording | None = None) -> Detector:
    """A detector by name.

    name: `blazepose`; `recording` (the keypoints2d.json of `recording`); `openpose-json:FOLDER`, or
    `openpose-json:FOLDER:LAYOUT` to name the skeleton. Raises DetectorError that lists the names.
    """
    kind, _, argument = name.partition(":")
    if kind == "blazepose" and not argument:
        from understudy.detectors.blazepose import BlazePoseDetector

        return BlazePoseDetector()
    if kind == "recording" and not argument:
        from understudy.detectors.precomputed import RecordingKeypoints

        if recording is None:
            raise DetectorError("detector 'recording' needs a recording to read keypoints2d.json from")
        return RecordingKeypoints(recording.keypoints2d, str(recording.path))
    if kind == "openpose-json" and argument:
        from understudy.detectors.precomputed import OpenPoseJson

        if Path(argument).is_dir() or ":" not in argument:
            return OpenPoseJson(Path(argument))
        folder, _, layout = argument.rpartition(":")
        return OpenPoseJson(Path(folder), layout)
    raise DetectorError(f"detector {name!r}: must be {one_of(NAMES)}")


__all__ = ["NAMES", "Detector", "create"]
