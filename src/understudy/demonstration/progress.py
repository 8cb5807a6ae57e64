"""How far the making of several demonstrations is, as a bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

_NAMED = 3  # recordings in work that the bar names


@dataclass
class Progress:
    """A bar on stderr: finished recordings, frames, and what is in work. A context manager.

    The number of frames of recordings that were not opened yet is taken to be that of the others on average.
    """

    names: Sequence[str]
    """of the recordings"""
    show: bool
    _steps: dict[int, tuple[int, int]] = field(default_factory=dict)  # frames that are done, and all; by recording
    _finished: set[int] = field(default_factory=set)
    _bar: Any = None

    def __enter__(self) -> Progress:
        if self.show:
            from tqdm import tqdm

            self._bar = tqdm(desc=self._head(), unit="frame", dynamic_ncols=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()

    def step(self, number: int, done: int, frames: int) -> None:
        """So many of the frames of a recording are done; after them, its object, hands and scene are looked for."""
        self._steps[number] = done, frames
        self._draw()

    def finished(self, number: int) -> None:
        """A recording is finished, or has failed: no more frames of it will come."""
        self._finished.add(number)
        done, _ = self._steps.get(number, (0, 0))
        self._steps[number] = done, done
        self._draw()

    @property
    def frames(self) -> tuple[int, int]:
        """How many are done, and how many there are, as far as that is known."""
        done, known = (sum(column) for column in zip(*self._steps.values(), strict=True)) if self._steps else (0, 0)
        unknown = len(self.names) - len(self._steps)
        return done, round(known * (1 + unknown / max(1, len(self._steps))))

    def words(self) -> str:
        """What is in work."""
        working = sorted((n, *step) for n, step in self._steps.items() if n not in self._finished)
        said = [f"{self.names[n]} " + (f"{done}/{of}" if done < of else "object") for n, done, of in working]
        return ", ".join(said[:_NAMED]) + (", ..." if len(said) > _NAMED else "")

    def _head(self) -> str:
        return f"demonstrate: {len(self._finished)} of {len(self.names)} recordings"

    def _draw(self) -> None:
        if self._bar is None:
            return
        done, self._bar.total = self.frames
        self._bar.set_description_str(self._head(), refresh=False)
        self._bar.set_postfix_str(self.words(), refresh=False)
        self._bar.update(done - self._bar.n)
