"""Shared names: puts tools/make_sample on the path, and holds the random person's frame of work.

World frame: x to the right of the camera, y into the room, z up, floor at z = 0; the camera stands over the origin.
A person's own frame: hips over the origin, x to the person's left, y to the back, z up.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.dont_write_bytecode = True
SAMPLE = Path(__file__).resolve().parents[1] / "make_sample"
if str(SAMPLE) not in sys.path:
    sys.path.insert(0, str(SAMPLE))

Array = NDArray[np.float64]
Rng = np.random.Generator
OUT = Path("/tmp/rooms")
SEED = 4711


def turn(yaw: float) -> Array:
    """Rotation about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
