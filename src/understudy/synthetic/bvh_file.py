"""Motion-capture files (BVH): reading and forward kinematics. `bvh` makes postures of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.errors import RecordingError

Array = np.ndarray
Frames = Iterable[int] | np.ndarray | slice | None

CHANNELS: Final = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
_CHANNEL_INDEX: Final = {name.lower(): i for i, name in enumerate(CHANNELS)}
MAX_JOINTS: Final = 1000


@dataclass(frozen=True)
class Bvh:
    """One motion-capture file.

    Attributes:
        names: joints, parents before children; an end site is its parent's name with `_end`.
        parents: index of each joint's parent, -1 for the root.
        offsets: (J, 3) rest position in the parent's frame, file units.
        channels: for each joint the indices into `CHANNELS`, in the file's order.
        frames: (F, C) channel values; angles in degrees, as in the file.
        frame_time_s: seconds between frames.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "j 3"]
    channels: tuple[tuple[int, ...], ...]
    frames: Float[np.ndarray, "f c"]
    frame_time_s: float

    @cached_property
    def _starts(self) -> list[int]:
        return [0, *np.cumsum([len(c) for c in self.channels]).tolist()]

    def solve(self, frames: Frames = None) -> tuple[Array, Array]:
        """Positions (F, J, 3) and absolute rotations (F, J, 3, 3) of the joints."""
        rows = (
            self.frames if frames is None else self.frames[frames if isinstance(frames, slice) else np.asarray(frames)]
        )
        n = len(rows)
        positions, rotations = np.zeros((n, len(self.names), 3)), np.zeros((n, len(self.names), 3, 3))
        for j, (parent, channels) in enumerate(zip(self.parents, self.channels, strict=True)):
            shift, turn = np.broadcast_to(self.offsets[j], (n, 3)), None
            for k, channel in enumerate(channels):
                value = rows[:, self._starts[j] + k]
                if channel < 3:
                    shift = shift.copy()
                    shift[:, channel] = value  # position channels replace the offset
                else:
                    step = _rotation(channel - 3, np.radians(value))
                    turn = step if turn is None else turn @ step
            turn = np.broadcast_to(np.eye(3), (n, 3, 3)) if turn is None else turn
            if parent < 0:
                positions[:, j], rotations[:, j] = shift, turn
            else:
                positions[:, j] = positions[:, parent] + (rotations[:, parent] @ shift[..., None])[..., 0]
                rotations[:, j] = rotations[:, parent] @ turn
        return positions, rotations

    def positions(self, frames: Frames = None) -> Float[np.ndarray, "f j 3"]:
        """Joints in the file's world and units; all frames, or the given ones."""
        return self.solve(frames)[0]

    def rotations(self, frames: Frames = None) -> Float[np.ndarray, "f j 3 3"]:
        """Absolute rotation of each joint."""
        return self.solve(frames)[1]


def _rotation(axis: int, angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((*angle.shape, 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = 1
    out[..., i, i], out[..., i, j], out[..., j, i], out[..., j, j] = c, -s, s, c
    return out


# -- reading -------------------------------------------------------------------------------------------------------


class _Lines:
    """The file's non-empty lines with their numbers."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self.lines = [(i, line.strip()) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
        self.at = 0

    def fail(self, what: str, number: int | None = None) -> RecordingError:
        if number is None:
            number = self.lines[min(max(self.at - 1, 0), len(self.lines) - 1)][0] if self.lines else 1
        return RecordingError(f"{self.path}, line {number}: {what}")

    def next(self, expected: str) -> list[str]:
        if self.at >= len(self.lines):
            raise self.fail(f"the file ends where {expected} should be")
        self.at += 1
        return self.lines[self.at - 1][1].split()

    def expect(self, *words: str) -> list[str]:
        found = self.next(" ".join(words))
        if [w.lower() for w in found[: len(words)]] != [w.lower() for w in words]:
            raise self.fail(f"expected {' '.join(words)!r}, found {' '.join(found)[:60]!r}")
        return found[len(words) :]

    def number(self, words: list[str], count: int, what: str) -> list[float]:
        if len(words) != count:
            raise self.fail(f"{what} must be {count} number(s), found {len(words)}")
        try:
            values = [float(w) for w in words]
        except ValueError:
            raise self.fail(f"{what} must be {count} number(s), found {' '.join(words)[:60]!r}") from None
        if not all(math.isfinite(v) for v in values):
            raise self.fail(f"{what} must be finite")
        return values


def read_bvh(path: str | Path) -> Bvh:
    """Read a BVH file; a `RecordingError` names the file, the line and what is wrong with it."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as e:
        raise RecordingError(f"{path}: cannot be read: {e.strerror or e}") from None
    lines = _Lines(path, text)
    lines.expect("HIERARCHY")
    names, parents, offsets, channels = _read_hierarchy(lines)
    width = sum(map(len, channels))
    n = lines.number(lines.expect("Frames:"), 1, "Frames:")[0]
    if n != int(n) or n < 1:
        raise lines.fail(f"Frames: must be a whole number above 0, found {n:g}")
    frame_time = lines.number(lines.expect("Frame", "Time:"), 1, "Frame Time:")[0]
    if frame_time <= 0:
        raise lines.fail(f"Frame Time: must be above 0, found {frame_time:g}")
    frames = _read_frames(lines, int(n), width)
    return Bvh(tuple(names), tuple(parents), np.array(offsets), tuple(channels), frames, frame_time)


def _read_hierarchy(lines: _Lines) -> tuple[list[str], list[int], list[list[float]], list[tuple[int, ...]]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[tuple[int, ...]] = []
    known: set[str] = set()
    stack: list[int] = []
    while True:
        words = lines.next("a joint or MOTION")
        kind = words[0].lower()
        if kind == "motion":
            if stack:
                raise lines.fail(f"MOTION while joint {names[stack[-1]]!r} is not closed with }}")
            if not names:
                raise lines.fail("no ROOT before MOTION")
            return names, parents, offsets, channels
        if kind == "}":
            if not stack:
                raise lines.fail("one } too many")
            stack.pop()
            continue
        end = kind == "end" and len(words) == 2 and words[1].lower() == "site"
        if (kind == "root" and stack) or (kind == "root" and names):
            raise lines.fail("a second ROOT: only one person to a file")
        if kind != "root" and not stack:
            raise lines.fail(f"expected ROOT or MOTION, found {' '.join(words)[:60]!r}")
        if not (kind in ("root", "joint") or end):
            raise lines.fail(f"expected JOINT, End Site or }}, found {' '.join(words)[:60]!r}")
        if len(words) < 2:
            raise lines.fail(f"{words[0]} without a name")
        name = f"{names[stack[-1]]}_end" if end else " ".join(words[1:]).removesuffix("{").strip()
        name = f"{name}{sum(n == name for n in names) + 1}" if end and name in known else name
        if name in known:
            raise lines.fail(f"joint {name!r} appears twice")
        if len(names) >= MAX_JOINTS:
            raise lines.fail(f"more than {MAX_JOINTS} joints")
        if end or not words[-1].endswith("{"):
            lines.expect("{")
        known.add(name)
        names.append(name)
        parents.append(stack[-1] if stack else -1)
        offsets.append(lines.number(lines.expect("OFFSET"), 3, f"OFFSET of {name!r}"))
        stack.append(len(names) - 1)
        channels.append(() if end else _read_channels(lines, name))


def _read_channels(lines: _Lines, name: str) -> tuple[int, ...]:
    words = lines.expect("CHANNELS")
    count = lines.number(words[:1], 1, f"CHANNELS of {name!r}")[0]
    unknown = [w for w in words[1:] if w.lower() not in _CHANNEL_INDEX]
    if unknown:
        raise lines.fail(f"channel {unknown[0]!r} of {name!r}: must be one of {', '.join(CHANNELS)}")
    if count != len(words) - 1:
        raise lines.fail(f"CHANNELS of {name!r} announces {count:g} channels, then names {len(words) - 1}")
    found = tuple(_CHANNEL_INDEX[w.lower()] for w in words[1:])
    if len(set(found)) != len(found):
        raise lines.fail(f"a channel of {name!r} appears twice")
    return found


def _read_frames(lines: _Lines, n: int, width: int) -> Array:
    rows = lines.lines[lines.at :]
    if not width:
        raise lines.fail("no joint has channels")
    if len(rows) < n:
        raise lines.fail(f"Frames: announces {n} frames, the file holds {len(rows)}")
    if len(rows) > n:
        raise lines.fail(f"more than the announced {n} frames", rows[n][0])
    try:
        frames = np.array(" ".join(text for _, text in rows).split(), dtype=np.float64)
        if frames.size == n * width and all(len(t.split()) == width for _, t in rows) and np.isfinite(frames).all():
            return frames.reshape(n, width)
    except ValueError:
        pass
    for number, text in rows:  # say where
        words = text.split()
        if len(words) != width:
            raise lines.fail(f"a frame must have {width} numbers, found {len(words)}", number)
        for word in words:
            try:
                fine = math.isfinite(float(word))
            except ValueError:
                fine = False
            if not fine:
                raise lines.fail(f"{word[:30]!r} is not a finite number", number)
    raise lines.fail("the frames cannot be read")
