"""Recordings of an RGB-D camera, whatever they are stored in.

    recording = open("RECORDING")          # the format is guessed from the path; open("sample") is the bundled one
    for frame in recording.frames(on_error=lambda index, error: print(error)):
        ...

One file per format. To add a format: write a subclass of `base.Recording` in a file of its own (`tum.py` is a short
example: two class attributes, `recognizes`, `_read`) and add one line to `FORMATS` in `registry.py`.

    base.py      what every recording can do              images.py      PNG and JPEG files, damage detected
    registry.py  the known formats, open(), the sample    intrinsics.py  cameras from plain numbers
    folder.py    the recording folder, read               pairing.py     which colour image goes with which depth image
    writer.py    the recording folder, written            truth.py       truth.json
    tum.py       TUM RGB-D sequences                      keypoints.py   keypoints2d.json
    k4a.py       Azure Kinect .mkv                        k4a_calibration.py  its calibration.json
    pair.py      one colour image and one depth image
"""

from understudy.recordings.base import Recording
from understudy.recordings.folder import FolderRecording
from understudy.recordings.pair import open_pair
from understudy.recordings.registry import FORMATS, open, sample_path
from understudy.recordings.truth import Truth, TruthPerson
from understudy.recordings.writer import FolderWriter, write_recording

__all__ = [
    "FORMATS",
    "FolderRecording",
    "FolderWriter",
    "Recording",
    "Truth",
    "TruthPerson",
    "open",
    "open_pair",
    "sample_path",
    "write_recording",
]
