"""The room around the furniture: floor, walls, lights and things that stand about. Different for every seed.

Things stand along the walls only; the middle of the room, where the person acts and the camera looks, stays free.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np

from understudy.stage import textures
from understudy.stage.furniture import Furniture
from understudy.stage.palette import PAINTS, WALLS, WOODS, Palette
from understudy.stage.things import Thing, add_box

HEIGHT: Final = 2.6
"""of the walls, metres"""
BEYOND: Final = 4.5
"""How far behind a room door the next room reaches, metres."""


def add_room(palette: Palette, furniture: Furniture, materials: dict[str, str]) -> None:
    """Adds floor, walls, lights and things to the scene, in place."""
    rng, world = palette.rng, palette.spec.worldbody
    side = rng.uniform(3.9, 4.6)
    back = 0.0 if furniture.pushed else max(_reach(furniture)) + 0.02
    end = BEYOND if furniture.pushed else back
    _add_floor(palette)
    low = -5.5
    walls = [((end, -side), (end + 0.1, side)), ((low, side), (end, side + 0.1)), ((low, -side - 0.1), (end, -side))]
    walls.append(((low - 0.1, -side), (low, side)))
    for i, (a, b) in enumerate(walls):
        add_box(world, f"room_wall{i}", materials["wall"], (*a, 0), (*b, HEIGHT))
    if furniture.pushed:  # the door's wall ends before the room does
        for i, sign in enumerate((-1, 1)):
            reach = max(abs(b.T_frame_box[1, 3]) + b.half_m[1] for b in furniture.blocks)
            y = sorted((sign * reach, sign * side))
            add_box(world, f"door_wall{i}", materials["wall"], (-0.05, y[0], 0), (0.04, y[1], HEIGHT))
    palette.spec.add_texture(
        name="ceiling",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=palette.tone(WALLS[:1]),
        width=64,
        height=64,
    )
    _add_lights(palette.spec, rng)
    _add_things(palette, furniture, back, side)


def _reach(furniture: Furniture) -> list[float]:
    return [float(b.T_frame_box[0, 3] + b.half_m[0]) for b in furniture.blocks]


def _add_floor(palette: Palette) -> None:
    rng = palette.rng
    if rng.random() < 0.6:
        image, repeat = textures.planks(rng, palette.tone(WOODS)), 0.5
    elif rng.random() < 0.5:
        image, repeat = textures.tiles(rng, palette.tone(PAINTS[1:])), 0.6
    else:
        image, repeat = textures.fabric(rng, palette.tone(((0.45, 0.43, 0.40), (0.35, 0.38, 0.42)))), 2.0
    material = palette.add("floor", image, cube=False, repeat=repeat, shine=0.05)
    palette.spec.material(material).texuniform = True
    palette.spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[12, 12, 0.1], material=material
    )


def _add_lights(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """One lamp or window with shadows from the person's side of the room, two without, and light from everywhere."""
    warm = np.array([1.0, rng.uniform(0.92, 1.0), rng.uniform(0.82, 1.02)])
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    key = rng.uniform(0.42, 0.56)
    toward = np.array([rng.uniform(0.15, 0.5), rng.uniform(-0.45, 0.45), -1.0])
    world = spec.worldbody
    place = np.array([-0.6, 0, 0]) - 3.2 * toward
    world.add_light(
        name="key", type=directional, pos=place, dir=toward, diffuse=key * warm, specular=[0.15] * 3, castshadow=True
    )
    for i, y in enumerate((-1.0, 1.0)):
        fill = rng.uniform(0.16, 0.26) * warm
        sideways = [rng.uniform(0.2, 0.9), y, rng.uniform(-0.6, -0.2)]
        world.add_light(
            name=f"fill{i}",
            type=directional,
            pos=[-3, -4 * y, 2],
            dir=sideways,
            diffuse=fill,
            specular=[0] * 3,
            castshadow=False,
        )
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [rng.uniform(0.38, 0.46)] * 3, [0.08] * 3, [0] * 3


def _add_things(palette: Palette, furniture: Furniture, back: float, side: float) -> None:
    rng = palette.rng
    taken = [
        b.T_frame_box[1, 3] + s * b.half_m[1]
        for b in furniture.blocks
        if not b.name.startswith("wall")
        for s in (-1, 1)
    ]
    low, high = min(taken) - 0.12, max(taken) + 0.12
    if furniture.pushed:
        back, low, high = -0.06, low - 0.5, high + 0.5
    thing = Thing(palette)
    beside: list[Callable[..., None]] = [thing.shelf, thing.chest, thing.chest, thing.poster, thing.plant]
    along: list[Callable[..., None]] = [thing.shelf, thing.chest, thing.plant, thing.poster, thing.sofa]
    for sign, edge in ((-1, -low), (1, high)):  # along the furniture's wall, beside it
        at = edge + rng.uniform(0.0, 0.5)
        while at < side - 0.8:
            wide = rng.uniform(0.5, min(1.3, side - at - 0.2))
            kind = beside[rng.integers(len(beside))]
            kind((back, sign * (at + wide / 2)), wide, np.array([-1.0, 0]))
            at += wide + rng.uniform(0.1, 0.7)
    for sign in (-1, 1):  # along the walls to the left and right
        at = -4.2
        while at < -1.0:
            wide = rng.uniform(0.6, 1.5)
            kind = along[rng.integers(len(along))]
            kind((at + wide / 2, sign * side), wide, np.array([0, -float(sign)]))
            at += wide + rng.uniform(0.1, 0.9)
    if furniture.pushed:  # the next room's far wall
        thing.poster((BEYOND, rng.uniform(-0.8, 0.8)), rng.uniform(0.5, 1.1), np.array([-1.0, 0]))
        thing.chest((BEYOND, rng.choice([-1, 1]) * rng.uniform(1.0, 1.8)), rng.uniform(0.6, 1.2), np.array([-1.0, 0]))
