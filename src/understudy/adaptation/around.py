"""What is around the robot's arm: fields of distances to what stands still and to the part that moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.adaptation.fields import DistanceField, point_field

_BEYOND_M: Final = 0.3  # of a field around the part


@dataclass(frozen=True, eq=False)
class Around:
    """Fields of distances; None: nothing is known to be there."""

    scene: DistanceField | None
    """to what stands still; world"""
    part: DistanceField | None
    """to the part that moves; its own frame"""


@dataclass(frozen=True, eq=False)
class Surrounded:
    """What is around the robot at each of t samples of a motion."""

    around: Around
    base: Float[np.ndarray, "t 3"]
    T_world_object: Float[np.ndarray, "t 4 4"]
    spare_m: float = 0.0
    """of the links' surfaces to a cell in which something is; to that itself, it is half a cell more"""


def points_around(
    points: Float[np.ndarray, "n 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cell_m: float
) -> DistanceField | None:
    """Distances to the points within a box; None if there are none."""
    inside = points[((points > low) & (points < high)).all(axis=1)].astype(np.float64)
    return point_field(inside, low, high, cell_m) if len(inside) else None


def part_around(part: Float[np.ndarray, "n 3"], cell_m: float) -> DistanceField | None:
    """Distances to the points of a part, in its frame; None if there are none."""
    if not len(part):
        return None
    return points_around(part, part.min(axis=0) - _BEYOND_M, part.max(axis=0) + _BEYOND_M, cell_m)
