"""What the robot knows of a place: the object as it was observed, and what stands around."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from understudy.adaptation.around import Around, part_around, points_around
from understudy.demonstration.demonstration import FREE, OCCUPIED, OccupancyMap
from understudy.geometry import inverse, transform_points
from understudy.objects.articulation import Articulation, Handle
from understudy.stage.furniture import Box, Furniture

_CELL_M: Final = 0.02
_BOUNDS: Final = ((-3.6, 2.4), (-2.7, 2.7))  # metres: x, y
_ROBOT_M: Final = 1.7  # what hangs higher stands in no robot's way
_SPACING_M: Final = 0.03
_ARM_CELL_M: Final = 0.025  # of the fields that the arm keeps clear of
_AROUND_M: Final = np.array([[-1.3, -1.3, -0.8], [1.3, 1.3, 0.6]])  # from the handle, to their corners
_NEAR_M: Final = 1.2  # of the handle: points beyond are of no interest to the hand


@dataclass(frozen=True, eq=False)
class Observed:
    """An object to be moved and its surroundings. World frame."""

    T_world_object: Float[np.ndarray, "4 4"]
    """of the handle, now"""
    articulation: Articulation
    handle: Handle
    map: OccupancyMap
    """without the part that moves"""
    scene: Float32[np.ndarray, "n 3"]
    """points of what stands still, around the handle"""
    part: Float32[np.ndarray, "m 3"]
    """points of what moves, handle's frame"""

    def placed(self, T_world_object: Float[np.ndarray, "4 4"]) -> Observed:
        """The object (with its articulation) seen elsewhere than before; the map stays."""
        q = self.articulation.position(T_world_object[None])
        T_new_old = T_world_object @ inverse(self.articulation.pose(q)[0])
        return Observed(
            T_world_object, self.articulation.moved(T_new_old), self.handle, self.map, self.scene, self.part
        )

    def around(self) -> Around:
        """What the arm must keep clear of."""
        middle = self.T_world_object[:3, 3]
        scene = points_around(self.scene, middle + _AROUND_M[0], middle + _AROUND_M[1], _ARM_CELL_M)
        return Around(scene, part_around(self.part, _ARM_CELL_M))


def observe(furniture: Furniture, T_world_object: Float[np.ndarray, "4 4"], opened: float = 0.0) -> Observed:
    """What a robot would know that measured the handle at a pose: everything is off by as much as that is.

    T_world_object: as measured, with the part at `opened`.
    """
    T = T_world_object @ inverse(furniture.articulation.pose(np.array([opened]))[0])
    part = np.concatenate([_surface(box) for box in (furniture.panel, *furniture.parts)])
    still = [box.moved(T) for box in furniture.blocks]
    scene = np.concatenate([_surface(box) for box in still])
    near = np.linalg.norm(scene - T_world_object[:3, 3], axis=1) < _NEAR_M
    return Observed(
        T_world_object,
        furniture.articulation.moved(T),
        furniture.handle,
        _map(still),
        scene[near].astype(np.float32),
        part.astype(np.float32),
    )


def _map(boxes: list[Box]) -> OccupancyMap:
    (x0, x1), (y0, y1) = _BOUNDS
    columns, rows = round((x1 - x0) / _CELL_M) + 1, round((y1 - y0) / _CELL_M) + 1
    x, y = np.meshgrid(x0 + _CELL_M * np.arange(columns), y0 + _CELL_M * np.arange(rows))
    state = np.full((rows, columns), FREE, np.uint8)
    for box in boxes:
        if box.T_frame_box[2, 3] - box.half_m[2] > _ROBOT_M:
            continue
        local = np.stack([x - box.T_frame_box[0, 3], y - box.T_frame_box[1, 3]], -1) @ box.T_frame_box[:2, :2]
        half = np.maximum(box.half_m[:2], _CELL_M / 2)
        state[(np.abs(local) <= half).all(axis=-1)] = OCCUPIED
    return OccupancyMap(state, np.array([x0, y0]), _CELL_M)


def _surface(box: Box) -> Float[np.ndarray, "n 3"]:
    """Points on a box's sides."""
    axes = [np.linspace(-h, h, max(2, int(np.ceil(2 * h / _SPACING_M)) + 1)) for h in box.half_m]
    parts = []
    for i in range(3):
        for end in (-box.half_m[i], box.half_m[i]):
            grid = [axes[k] if k != i else np.array([end]) for k in range(3)]
            parts.append(np.stack(np.meshgrid(*grid, indexing="ij"), -1).reshape(-1, 3))
    return transform_points(box.T_frame_box, np.concatenate(parts))
