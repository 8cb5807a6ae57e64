"""Furniture of the four tasks: sizes, how it moves, what it weighs. Numbers only; `mechanism.py` makes bodies of them.

World: z up, floor at z = 0. The closed front lies in the plane x = 0 and faces -x, where the person stands: a person
with heading 0 looks at it. The middle of the closed handle's grip is at y = 0. So the handle's frame at rest has its
x axis along -x of the world, and z up (upright bar) or along +y (level bar).

Sizes follow common furniture (kitchen fronts, wardrobes and room doors as sold in Europe).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError, one_of
from understudy.geometry import inverse, rigid
from understudy.objects.articulation import PRISMATIC, REVOLUTE, Articulation, Handle

UPRIGHT: Final = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
"""R_world_handle of an upright bar at rest."""
LEVEL: Final = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
"""R_world_handle of a level bar at rest."""

_GAP: Final = 0.004  # metres between things that pass each other
_BOARD: Final = 0.018  # metres, thickness of a carcass
_WALL_REACH: Final = 3.2  # metres to either side of the room door
_WALL_HEIGHT: Final = 2.6

Corner = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box."""

    name: str
    material: str
    """front, body, inside, wall or frame: what it is made of"""
    T_frame_box: Float[np.ndarray, "4 4"]
    """its middle; the frame is the world's for what stands still, the handle's for what moves"""
    half_m: tuple[float, float, float]
    """half of its sizes along its own axes"""

    def moved(self, T_new_frame: Float[np.ndarray, "4 4"]) -> Box:
        """The same in another frame."""
        return replace(self, T_frame_box=T_new_frame @ self.T_frame_box)


@dataclass(frozen=True)
class Dynamics:
    """What it takes to move the part: newtons for sliding, newton metres for turning."""

    mass_kg: float
    friction: float
    """dry friction: less than this does not move it (N or Nm)"""
    damping: float
    """N s/m or Nm s/rad"""
    stiffness: float = 0.0
    """of a closing spring (door closer): N/m or Nm/rad"""
    preload: float = 0.0
    """of that spring when closed (N or Nm)"""


@dataclass(frozen=True, eq=False)
class Furniture:
    """One piece of furniture with one moving part."""

    task: str
    """one of demonstration.tasks.TASKS"""
    articulation: Articulation
    """world; T_rest is the handle's frame when closed; range is (0, fully open)"""
    handle: Handle
    panel: Box
    """the front that carries the handle; handle's frame, axes along the world's at rest: thickness, width, height"""
    parts: tuple[Box, ...]
    """what else moves (a drawer's box); handle's frame"""
    blocks: tuple[Box, ...]
    """what stands still: carcass, walls, door frame; world. Nobody may stand there"""
    dynamics: Dynamics
    open_to: float
    """how far a demonstration should open it (radians or metres)"""

    @property
    def pushed(self) -> bool:
        """Whether it opens away from the person, who then walks through."""
        return self.task == "room_door"

    def moving(self, q: float) -> list[Box]:
        """Panel and parts at position q, in the world."""
        T = self.articulation.pose(np.array([q]))[0]
        return [box.moved(T) for box in (self.panel, *self.parts)]


def sample_furniture(task: str, seed: int) -> Furniture:
    """A piece of furniture of human sizes; the same for the same arguments. Raises UnderstudyError (unknown task)."""
    if task not in TASKS:
        raise UnderstudyError(f"task {task!r}: must be {one_of(TASKS)}")
    return _MAKERS[task](np.random.default_rng([seed, TASKS.index(task)]))


def _room_door(rng: np.random.Generator) -> Furniture:
    """A leaf in a wall, pushed open. Its hinge is at the far face's edge, so that it opens beyond 90 degrees."""
    width, height = rng.uniform(0.80, 0.95), rng.uniform(1.95, 2.10)
    thick, inset, side = 0.04, rng.uniform(0.065, 0.085), _side(rng)
    handle = Handle(rng.uniform(0.22, 0.40), rng.uniform(0.010, 0.014), rng.uniform(0.055, 0.07))
    T_rest = rigid(UPRIGHT, np.array([-handle.standoff_m, 0, rng.uniform(0.98, 1.10)]))
    leaf = _box("panel", "front", (0, -inset, 0.008), (thick, width - inset, height), side)
    low, high, top = -inset - _GAP, width - inset + _GAP, height + _GAP  # the opening
    near, lining, trim = -0.05, 0.03, 0.07  # wall's face at the person; frame inside and around the opening
    wall = [
        _box("wall_free", "wall", (near, -_WALL_REACH, 0), (thick, low - lining, _WALL_HEIGHT), side),
        _box("wall_hinge", "wall", (near, high + lining, 0), (thick, _WALL_REACH, _WALL_HEIGHT), side),
        _box("wall_above", "wall", (near, low - lining, top + lining), (thick, high + lining, _WALL_HEIGHT), side),
        _box("frame_free", "frame", (near, low - lining, 0), (thick, low, top), side),
        _box("frame_hinge", "frame", (near, high, 0), (thick, high + lining, top), side),
        _box("frame_above", "frame", (near, low - lining, top), (thick, high + lining, top + lining), side),
        _box("trim_free", "frame", (near - 0.012, low - trim, 0), (near, low - 0.005, top + trim), side),
        _box("trim_hinge", "frame", (near - 0.012, high + 0.005, 0), (near, high + trim, top + trim), side),
        _box("trim_above", "frame", (near - 0.012, low - trim, top + 0.005), (near, high + trim, top + trim), side),
    ]
    closer = rng.random() < 0.4
    dynamics = Dynamics(
        rng.uniform(15, 26),
        rng.uniform(0.8, 2.5),
        rng.uniform(1.0, 4.0),
        rng.uniform(0.5, 2.0) if closer else 0.0,
        rng.uniform(1.0, 3.0) if closer else 0.0,
    )
    turning = _turning(T_rest, (thick, side * (width - inset)), side, rng.uniform(1.5, 1.75))
    return _furniture("room_door", turning, handle, leaf, [], wall, dynamics, rng.uniform(1.15, 1.4))


def _swivel_door(rng: np.random.Generator) -> Furniture:
    """A cupboard's door, pulled open about an edge of its front face."""
    width, height = rng.uniform(0.32, 0.55), rng.uniform(0.45, 0.90)
    thick, inset, side = _BOARD, rng.uniform(0.035, 0.06), _side(rng)
    handle, level = _handle(rng, level=False)
    z = rng.uniform(0.75, 1.40)
    bottom = max(0.08, z - rng.uniform(0.25, 0.75) * height)
    top = bottom + height
    T_rest = rigid(level, np.array([-handle.standoff_m, 0, z]))
    leaf = _box("panel", "front", (0, -inset, bottom), (thick, width - inset, top), side)
    depth, crown = rng.uniform(0.32, 0.60), top + rng.choice([0.02, rng.uniform(0.1, 0.5)])
    low, high = -inset, width - inset
    blocks = _carcass(low, high, thick, depth, bottom, top, crown, side)
    blocks.append(
        _box("shelf", "inside", (thick + 0.05, low + _BOARD, z - 0.1), (depth - 0.02, high - _BOARD, z - 0.085), side)
    )
    if rng.random() < 0.6:  # another door beside the free edge
        wide = rng.uniform(0.3, 0.55)
        blocks.append(
            _box("beside", "body", (thick + _GAP, low - wide, 0.06), (depth, low - 0.001, crown), side),
        )
        blocks.append(_box("beside_front", "front", (0, low - wide, bottom), (thick, low - _GAP, top), side))
    dynamics = Dynamics(rng.uniform(2.5, 6), rng.uniform(0.5, 1.5), rng.uniform(0.2, 0.8))
    turning = _turning(T_rest, (0.0, side * high), -side, rng.uniform(1.65, 1.95))
    return _furniture("swivel_door", turning, handle, leaf, [], blocks, dynamics, rng.uniform(1.1, 1.45))


def _drawer(rng: np.random.Generator) -> Furniture:
    """A drawer in a chest of drawers."""
    width, height = rng.uniform(0.38, 0.80), rng.uniform(0.13, 0.24)
    travel, thick, z = rng.uniform(0.27, 0.45), _BOARD, rng.uniform(0.58, 1.0)
    handle, level = _handle(rng, level=True)
    T_rest = rigid(level, np.array([-handle.standoff_m, 0, z]))
    half, bottom, top = width / 2, z - height / 2, z + height / 2
    front = _box("panel", "front", (0, -half, bottom), (thick, half, top))
    depth = thick + travel + rng.uniform(0.08, 0.15)
    crown = top + rng.choice([0.02, height + 0.02])
    blocks = _carcass(-half, half, thick, depth, bottom, top, crown)
    # the drawer's box, clear of the carcass on all sides
    inner, back, base = half - _BOARD - 0.012, depth - 0.05, bottom + 0.02
    rim = top - 0.05
    box = [
        _box("drawer_base", "inside", (thick, -inner, base), (back, inner, base + 0.01)),
        _box("drawer_left", "inside", (thick, inner - 0.012, base + 0.01), (back, inner, rim)),
        _box("drawer_right", "inside", (thick, -inner, base + 0.01), (back, 0.012 - inner, rim)),
        _box("drawer_back", "inside", (back - 0.012, 0.012 - inner, base + 0.01), (back, inner - 0.012, rim)),
    ]
    dynamics = Dynamics(rng.uniform(2.5, 7), rng.uniform(2, 7), rng.uniform(4, 12))
    sliding = Articulation(PRISMATIC, T_rest, np.array([-1.0, 0, 0]), T_rest[:3, 3].copy(), (0.0, travel))
    return _furniture("drawer", sliding, handle, front, box, blocks, dynamics, travel * rng.uniform(0.75, 0.92))


def _sliding_door(rng: np.random.Generator) -> Furniture:
    """A wardrobe's panel that slides in front of its neighbour, away from the edge that its handle is at."""
    travel, inset, side = rng.uniform(0.38, 0.70), rng.uniform(0.05, 0.09), _side(rng)
    width, thick, z = travel + rng.uniform(0.12, 0.25), 0.022, rng.uniform(0.85, 1.25)
    handle, level = _handle(rng, level=False)
    T_rest = rigid(level, np.array([-handle.standoff_m, 0, z]))
    bottom, top = 0.07, rng.uniform(max(1.35, z + 0.3), 2.15)
    panel = _box("panel", "front", (0, -inset, bottom), (thick, width - inset, top), side)
    low, high, behind = -inset, 2 * width - inset, thick + 0.01
    depth = rng.uniform(0.45, 0.62)
    blocks = _carcass(low, high, behind + thick, depth, bottom, top, top + 0.03, side)
    blocks += [
        _box("fixed_front", "front", (behind, width - inset - 0.03, bottom), (behind + thick - _GAP, high, top), side),
        _box("cornice", "body", (-0.004, low, top + _GAP), (behind + thick, high, top + 0.03), side),
        _box("rail", "body", (-0.004, low, 0.0), (behind + thick, high, bottom - _GAP), side),
    ]
    dynamics = Dynamics(rng.uniform(8, 20), rng.uniform(3, 10), rng.uniform(5, 18))
    along = np.array([0.0, side, 0.0])
    sliding = Articulation(PRISMATIC, T_rest, along, T_rest[:3, 3].copy(), (0.0, travel))
    return _furniture("sliding_door", sliding, handle, panel, [], blocks, dynamics, travel * rng.uniform(0.8, 0.95))


_MAKERS: Final = MappingProxyType[str, Callable[[np.random.Generator], Furniture]](
    {"room_door": _room_door, "swivel_door": _swivel_door, "drawer": _drawer, "sliding_door": _sliding_door}
)


def _furniture(
    task: str,
    articulation: Articulation,
    handle: Handle,
    panel: Box,
    parts: list[Box],
    blocks: list[Box],
    dynamics: Dynamics,
    open_to: float,
) -> Furniture:
    """Puts what moves (given at rest, world) into the handle's frame."""
    T = inverse(articulation.T_rest)
    parts = [part.moved(T) for part in parts]
    return Furniture(task, articulation, handle, panel.moved(T), tuple(parts), tuple(blocks), dynamics, float(open_to))


def _side(rng: np.random.Generator) -> int:
    """1: the hinge (or the way of sliding) is on the person's left, towards +y; -1: on the right."""
    return int(rng.choice([-1, 1]))


def _handle(rng: np.random.Generator, level: bool) -> tuple[Handle, np.ndarray]:
    """A cupboard's handle and R_world_handle: mostly a bar, sometimes a knob, which is a short thick one."""
    if rng.random() < 0.2:
        return Handle(rng.uniform(0.028, 0.036), rng.uniform(0.013, 0.016), rng.uniform(0.034, 0.042)), LEVEL
    bar = Handle(rng.uniform(0.11, 0.26), rng.uniform(0.005, 0.008), rng.uniform(0.036, 0.05))
    return bar, LEVEL if level else UPRIGHT


def _turning(T_rest: np.ndarray, hinge_xy: tuple[float, float], sense: int, most: float) -> Articulation:
    """About an upright axis; sense 1: counter-clockwise from above."""
    point = np.array([*hinge_xy, T_rest[2, 3]])
    return Articulation(REVOLUTE, T_rest, np.array([0.0, 0, sense]), point, (0.0, float(most)))


def _box(name: str, material: str, low: Corner, high: Corner, side: int = 1) -> Box:
    """From its least and greatest corner, metres; side -1 mirrors it to the other side (y -> -y)."""
    a, b = np.array(low, np.float64), np.array(high, np.float64)
    middle, half = (a + b) / 2, (b - a) / 2
    middle[1] *= side
    return Box(name, material, rigid(np.eye(3), middle), (float(half[0]), float(half[1]), float(half[2])))


def _carcass(
    low: float, high: float, front: float, depth: float, bottom: float, top: float, crown: float, side: int = 1
) -> list[Box]:
    """A cupboard from y = low to high, open at the front between z = bottom and top, closed below and above."""
    x, b = front + 0.003, _BOARD
    boxes = [
        _box("side_low", "body", (x, low, 0), (depth, low + b, crown), side),
        _box("side_high", "body", (x, high - b, 0), (depth, high, crown), side),
        _box("back", "inside", (depth - 0.008, low + b, 0.06), (depth, high - b, crown - b), side),
        _box("top", "body", (x, low + b, crown - b), (depth, high - b, crown), side),
        _box("bottom", "inside", (x, low + b, bottom - 0.002), (depth - 0.008, high - b, bottom + 0.014), side),
    ]
    if bottom > 0.12:
        boxes.append(_box("front_below", "front", (0, low, 0.06), (front, high, bottom - _GAP), side))
    if crown - top > 0.05:
        boxes.append(_box("front_above", "front", (0, low, top + _GAP), (front, high, crown), side))
    return boxes
