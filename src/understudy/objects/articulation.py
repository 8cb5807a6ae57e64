"""How a part of a piece of furniture moves: not at all, along a line (drawer, sliding door) or about an axis (door)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError, one_of
from understudy.geometry import inverse, is_rigid, transform_points
from understudy.lie import wrapped

FIXED, PRISMATIC, REVOLUTE = KINDS = ("fixed", "prismatic", "revolute")
"""Kinds of articulation."""

_UNIT_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Handle:
    """What the hand takes hold of. Its frame is the object's frame, everywhere.

    Origin at the middle of the grip; x out of the front that carries the handle (towards who opens it); z along the
    bar, upwards, or, for a level bar, such that y = z x x points up. A knob is a short bar.
    """

    length_m: float
    """of the grip, along z"""
    radius_m: float
    """of the grip"""
    standoff_m: float
    """between the front's surface and the grip's middle"""


@dataclass(frozen=True, eq=False)
class Articulation:
    """One degree of freedom of a rigid part. World frame (or the camera's: whichever its poses were given in).

    q is an angle (radians) or a way (metres) from the rest pose; opening is positive.
    """

    kind: str
    """one of KINDS"""
    T_rest: Float[np.ndarray, "4 4"]
    """pose of the part at q = 0"""
    direction: Float[np.ndarray, "3"]
    """unit vector: of sliding, or of the axis, right-handed"""
    point: Float[np.ndarray, "3"]
    """metres; on the axis, the one nearest to the part's origin at rest; the part's origin for other kinds"""
    range: tuple[float, float]
    """least and greatest q that were seen"""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnderstudyError(f"articulation: kind {self.kind!r} is not {one_of(KINDS)}")
        if self.T_rest.shape != (4, 4) or not is_rigid(self.T_rest):
            raise UnderstudyError("articulation: T_rest must be a rigid 4x4 transform")
        if self.direction.shape != (3,) or abs(float(np.linalg.norm(self.direction)) - 1) > _UNIT_TOLERANCE:
            raise UnderstudyError("articulation: direction must be a unit vector of 3 numbers")
        if self.point.shape != (3,) or not np.isfinite(self.point).all():
            raise UnderstudyError("articulation: point must be 3 finite numbers")
        if not self.range[0] <= self.range[1]:
            raise UnderstudyError(f"articulation: range must be (least, greatest), got {self.range}")

    @property
    def radius_m(self) -> float:
        """Distance of the part's origin from the axis; 0 for kinds without one."""
        if self.kind != REVOLUTE:
            return 0.0
        offset = self.T_rest[:3, 3] - self.point
        return float(np.linalg.norm(offset - self.direction * (offset @ self.direction)))

    def pose(self, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Poses of the part at positions q (radians or metres)."""
        q = np.asarray(q, np.float64)
        T = np.tile(self.T_rest, (len(q), 1, 1))
        if self.kind == PRISMATIC:
            T[:, :3, 3] += q[:, None] * self.direction
        elif self.kind == REVOLUTE:
            R = Rotation.from_rotvec(q[:, None] * self.direction).as_matrix()
            T[:, :3, :3] = R @ self.T_rest[:3, :3]
            T[:, :3, 3] = (R @ (self.T_rest[:3, 3] - self.point)) + self.point
        return T

    def position(self, T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
        """q of poses that lie on (or near) the articulation: the inverse of `pose`, for angles in (-pi, pi]."""
        if self.kind == FIXED:
            return np.zeros(len(T))
        if self.kind == PRISMATIC:
            return np.asarray((T[:, :3, 3] - self.T_rest[:3, 3]) @ self.direction)
        # the nearest rotation about the axis: swing-twist of R, which does not care where the axis is ...
        turn = Rotation.from_matrix(T[:, :3, :3] @ self.T_rest[:3, :3].T).as_quat()
        angle = 2 * np.arctan2(turn[:, :3] @ self.direction, turn[:, 3])
        return wrapped(angle)

    def moved(self, T_new_old: Float[np.ndarray, "4 4"]) -> Articulation:
        """The same in another frame."""
        return Articulation(
            self.kind,
            T_new_old @ self.T_rest,
            T_new_old[:3, :3] @ self.direction,
            transform_points(T_new_old, self.point),
            self.range,
        )

    def in_part(self) -> Articulation:
        """The same in the frame of the part at rest."""
        return self.moved(inverse(self.T_rest))

    def to_json(self) -> dict[str, Any]:
        """Plain lists and numbers, for a file."""
        return {
            "kind": self.kind,
            "T_rest": self.T_rest.tolist(),
            "direction": self.direction.tolist(),
            "point": self.point.tolist(),
            "range": list(self.range),
        }

    @classmethod
    def from_json(cls, data: dict[str, Any], where: str) -> Articulation:
        """The inverse of `to_json`. Raises UnderstudyError that begins with `where`."""
        try:
            T_rest, direction, point = (np.array(data[k], np.float64) for k in ("T_rest", "direction", "point"))
            low, high = (float(x) for x in data["range"])
            return cls(str(data["kind"]), T_rest, direction, point, (low, high))
        except KeyError as e:
            raise UnderstudyError(f"{where}: articulation has no {e}") from e
        except (TypeError, ValueError) as e:
            raise UnderstudyError(f"{where}: {e}") from e
