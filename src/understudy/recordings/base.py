"""What every recording can do, whatever it is stored in."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import ClassVar, SupportsIndex

import numpy as np
from jaxtyping import Float32, UInt8

from understudy.camera import RGBDCamera
from understudy.errors import FrameError, RecordingError
from understudy.recordings.truth import Truth
from understudy.types import Frame, Keypoints2D


class Recording(ABC):
    """The frames of one RGB-D camera, in order. Images are read only when a frame is asked for.

    Behaves like a sequence: `len(r)`, `r[0]`, `r[-1]`, `for frame in r`. Positions count the frames there are;
    `frame(index)` goes by the frame's own number, which may have gaps.
    """

    format_name: ClassVar[str]
    """how the format is called in messages"""
    looks_for: ClassVar[str]
    """what `recognizes` looks for, in words"""
    unit_m: float = 0.001
    """metres per stored depth value"""

    def __init__(
        self,
        path: str | Path,
        camera: RGBDCamera,
        indices: Sequence[int],
        timestamps_s: Sequence[float] | None = None,
        fps: float | None = None,
    ):
        self.path = Path(path)
        self.camera = camera
        self.indices: tuple[int, ...] = tuple(indices)
        """frame numbers, ascending"""
        self.timestamps_s: tuple[float, ...] | None = None if timestamps_s is None else tuple(timestamps_s)
        """seconds, one per frame, ascending; None where the recording has no clock"""
        self.fps = fps
        """frames per second; None where unknown"""
        self._positions = {index: position for position, index in enumerate(self.indices)}
        assert len(self._positions) == len(self.indices) and list(self.indices) == sorted(self.indices)
        assert self.timestamps_s is None or len(self.timestamps_s) == len(self.indices)

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
        """Whether the path looks like this format. Must be cheap and must not raise."""

    @abstractmethod
    def _read(self, position: int) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "hd wd"]]:
        """Colour (RGB) and depth (metres) of the frame at a position. Raises FrameError that names the file."""

    def sources(self, position: int) -> tuple[Path, ...]:
        """The files that the frame at a position is read from; some may be missing."""
        return (self.path,)

    @property
    def name(self) -> str:
        """The file's or folder's name."""
        return self.path.resolve().name

    @property
    def truth(self) -> Truth | None:
        """Ground truth; None where there is none. Raises RecordingError if it cannot be read."""
        return None

    @property
    def keypoints2d(self) -> dict[int, list[Keypoints2D]] | None:
        """Frame number -> 2D keypoints that came with the recording; None where there are none."""
        return None

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: SupportsIndex) -> Frame:
        """The frame at a position (negative: from the end). Raises FrameError if it is broken, IndexError beyond."""
        i = operator.index(position)
        n = len(self)
        if not -n <= i < n:
            raise IndexError(f"{self.name} has {n} frames: there is no frame at position {i}")
        i %= n
        color, depth = self._read(i)
        timestamp = None if self.timestamps_s is None else self.timestamps_s[i]
        return Frame(color, depth, self.camera, self.indices[i], timestamp)

    def frame(self, index: int) -> Frame:
        """The frame with a number. Raises FrameError if it is broken, RecordingError if there is none."""
        if index not in self._positions:
            raise RecordingError(
                f"{self.path}: there is no frame {index}; "
                + (f"the frames are {self.indices[0]} ... {self.indices[-1]}" if self.indices else "it has no frames")
            )
        return self[self._positions[index]]

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def frames(self, on_error: Callable[[int, FrameError], object] | None = None) -> Iterator[Frame]:
        """The frames in order, one at a time.

        A broken one raises FrameError; with `on_error` it is reported as `on_error(index, error)` and left out instead.
        """
        for position, index in enumerate(self.indices):
            try:
                frame = self[position]
            except FrameError as error:
                if on_error is None:
                    raise
                on_error(index, error)
                continue
            yield frame

    def close(self) -> None:  # noqa: B027 (most formats hold nothing open)
        """Releases what is held open; the recording cannot be read afterwards."""

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self.path)!r}: {len(self)} frames>"
