"""The room around the furniture: floor, walls, lights and things that stand about. Different for every seed.

Things stand along the walls only; the middle of the room, where the person acts and the camera looks, stays free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float

from understudy.stage import textures
from understudy.stage.furniture import Furniture
from understudy.stage.textures import Color, Image

HEIGHT: Final = 2.6
"""of the walls, metres"""
BEYOND: Final = 4.5
"""How far behind a room door the next room reaches, metres."""

_WOODS = ((0.72, 0.53, 0.35), (0.55, 0.38, 0.24), (0.83, 0.70, 0.53), (0.42, 0.28, 0.19))
_PAINTS = ((0.90, 0.89, 0.86), (0.80, 0.80, 0.78), (0.62, 0.66, 0.66), (0.55, 0.60, 0.52), (0.86, 0.80, 0.68))
_WALLS = ((0.88, 0.86, 0.82), (0.82, 0.84, 0.84), (0.85, 0.80, 0.70), (0.76, 0.80, 0.76), (0.80, 0.74, 0.70))
_THINGS = ((0.65, 0.20, 0.18), (0.20, 0.35, 0.55), (0.25, 0.42, 0.28), (0.75, 0.55, 0.20), (0.3, 0.3, 0.33))
_GREEN = np.array([0.20, 0.38, 0.16])


@dataclass
class Palette:
    """Materials of a scene. Their pictures are written into the compiled model's memory, not into files."""

    spec: mujoco.MjSpec
    rng: np.random.Generator
    images: dict[str, Image] = field(default_factory=dict)
    """texture -> picture"""

    def add(self, name: str, image: Image, *, cube: bool = True, repeat: float = 1.0, shine: float = 0.1) -> str:
        """A material from a picture. cube: on all sides of a box; otherwise on its +z side. Returns its name."""
        height, width = image.shape[:2]
        self.spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_CUBE if cube else mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            width=width,
            height=height,
            nchannel=3,
        )
        self.images[name] = np.concatenate([image] * 6) if cube else image
        material = self.spec.add_material(name=name, texrepeat=[repeat, repeat], specular=shine, shininess=0.3)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        return name

    def plain(self, name: str, color: Color, shine: float = 0.1) -> str:
        """A material of one colour."""
        self.spec.add_material(name=name, rgba=[*color, 1], specular=shine, shininess=0.4)
        return name

    def tone(self, colors: tuple[tuple[float, float, float], ...]) -> Color:
        """One of these colours, a little off."""
        chosen = np.array(colors[self.rng.integers(len(colors))])
        return np.asarray((chosen * self.rng.normal(1, 0.05) + self.rng.normal(0, 0.015, 3)).clip(0.02, 0.95))

    def surface(self, name: str) -> str:
        """Wood or paint, for furniture."""
        if self.rng.random() < 0.55:
            return self.add(name, textures.wood(self.rng, self.tone(_WOODS)))
        return self.add(name, textures.paint(self.rng, self.tone(_PAINTS)))

    def write(self, model: mujoco.MjModel) -> None:
        """Writes the pictures into the compiled model; before a renderer is made of it."""
        for name, image in self.images.items():
            texture = model.texture(name)
            start = int(texture.adr[0])
            model.tex_data[start : start + image.size] = image.ravel()


def furniture_materials(palette: Palette) -> dict[str, str]:
    """`Box.material` -> material. The front differs from the carcass in one of two rooms."""
    rng = palette.rng
    front = palette.surface("front")
    return {
        "front": front,
        "body": palette.surface("body") if rng.random() < 0.5 else front,
        "inside": palette.add("inside", textures.paint(rng, palette.tone(((0.75, 0.68, 0.58), (0.8, 0.8, 0.78))))),
        "wall": palette.add("wall", textures.paint(rng, palette.tone(_WALLS))),
        "frame": palette.add("frame", textures.paint(rng, palette.tone(_PAINTS[:2]))),
        "metal": palette.plain("metal", rng.uniform(0.12, 0.72) * np.ones(3), shine=0.8),
    }


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
        _box(world, f"room_wall{i}", materials["wall"], (*a, 0), (*b, HEIGHT))
    if furniture.pushed:  # the door's wall ends before the room does
        for i, sign in enumerate((-1, 1)):
            reach = max(abs(b.T_frame_box[1, 3]) + b.half_m[1] for b in furniture.blocks)
            y = sorted((sign * reach, sign * side))
            _box(world, f"door_wall{i}", materials["wall"], (-0.05, y[0], 0), (0.04, y[1], HEIGHT))
    palette.spec.add_texture(
        name="ceiling",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=palette.tone(_WALLS[:1]),
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
        image, repeat = textures.planks(rng, palette.tone(_WOODS)), 0.5
    elif rng.random() < 0.5:
        image, repeat = textures.tiles(rng, palette.tone(_PAINTS[1:])), 0.6
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
    thing = _Thing(palette)
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


class _Thing:
    """Makes things that stand at a wall. Each takes its place at the wall, its width, and the way out of the wall."""

    def __init__(self, palette: Palette):
        self._palette, self._count = palette, 0

    def _part(
        self, place: tuple[float, float], out: np.ndarray, material: str, low: tuple, high: tuple, name: str
    ) -> None:
        """A box; low and high: (out of the wall, along it, up)."""
        along = np.array([-out[1], out[0]])
        corners = np.array([np.array(place) + x * out + y * along for x, y in (low[:2], high[:2])])
        a, b = corners.min(0), corners.max(0)
        _box(self._palette.spec.worldbody, name, material, (a[0], a[1], low[2]), (b[0], b[1], high[2]))

    def _name(self, kind: str) -> str:
        self._count += 1
        return f"{kind}{self._count}"

    def chest(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A chest or low cupboard with something on it."""
        palette, rng, name = self._palette, self._palette.rng, self._name("chest")
        height, deep = rng.uniform(0.45, 1.0), rng.uniform(0.3, 0.45)
        self._part(place, out, palette.surface(name), (0, -wide / 2, 0), (deep, wide / 2, height), name)
        for i in range(rng.integers(0, 3)):
            y, s = rng.uniform(-0.4, 0.4) * wide, rng.uniform(0.08, 0.2)
            color = palette.plain(f"{name}_on{i}", palette.tone(_THINGS))
            tall = height + rng.uniform(0.08, 0.35)
            self._part(place, out, color, (0.08, y - s / 2, height), (0.08 + s, y + s / 2, tall), f"{name}_on{i}")

    def shelf(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A shelf with books."""
        palette, rng, name = self._palette, self._palette.rng, self._name("shelf")
        material, deep, height = palette.surface(name), 0.28, rng.uniform(1.2, 2.0)
        books = [palette.plain(f"{name}_book{i}", palette.tone(_THINGS)) for i in range(3)]
        for i, y in enumerate((-wide / 2, wide / 2 - 0.02)):
            self._part(place, out, material, (0, y, 0), (deep, y + 0.02, height), f"{name}_side{i}")
        for i, z in enumerate(np.linspace(0.05, height - 0.02, rng.integers(3, 6))):
            self._part(place, out, material, (0, -wide / 2, z), (deep, wide / 2, z + 0.02), f"{name}_board{i}")
            start, many = rng.uniform(-0.45, 0), rng.uniform(0.1, 0.45)
            if z < height - 0.1:
                low, high = (0.02, start * wide, z + 0.02), (0.22, (start + many) * wide, z + rng.uniform(0.16, 0.25))
                self._part(place, out, books[i % 3], low, high, f"{name}_books{i}")

    def sofa(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A sofa or armchair."""
        palette, rng, name = self._palette, self._palette.rng, self._name("sofa")
        tone = palette.tone(((0.45, 0.43, 0.42), (0.25, 0.32, 0.42), (0.55, 0.45, 0.35), (0.35, 0.4, 0.33)))
        material = palette.add(name, textures.fabric(rng, tone))
        self._part(place, out, material, (0.05, -wide / 2, 0.08), (0.85, wide / 2, 0.42), name)
        self._part(place, out, material, (0.02, -wide / 2, 0.08), (0.25, wide / 2, 0.85), f"{name}_back")

    def poster(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A picture on the wall."""
        palette, rng, name = self._palette, self._palette.rng, self._name("picture")
        material = palette.add(name, textures.picture(rng, rng.uniform(0.1, 0.9, 3)))
        half, z = 0.35 * wide, rng.uniform(1.1, 1.4)
        high = min(z + rng.uniform(0.4, 0.8), HEIGHT - 0.1)
        self._part(place, out, material, (0, -half, z), (0.02, half, high), name)

    def plant(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A plant in a pot."""
        palette, rng, name = self._palette, self._palette.rng, self._name("plant")
        world, middle = palette.spec.worldbody, np.array(place) + 0.3 * out
        pot, green = palette.plain(f"{name}_pot", palette.tone(_THINGS)), palette.plain(name, _GREEN)
        world.add_geom(
            name=f"{name}_pot",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            material=pot,
            size=[0.14, 0.15, 0],
            pos=[*middle, 0.15],
        )
        world.add_geom(
            name=f"{name}_stem",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            material=green,
            size=[0.015, 0.25, 0],
            pos=[*middle, 0.45],
        )
        for i in range(9):
            offset = rng.normal(0, 0.08, 2)
            world.add_geom(
                name=f"{name}_leaves{i}",
                type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                material=green,
                size=rng.uniform(0.05, 0.14, 3),
                pos=[*(middle + offset), rng.uniform(0.45, 1.0)],
            )


def _box(body: mujoco.MjsBody, name: str, material: str, low: tuple, high: tuple) -> None:
    a, b = np.array(low, np.float64), np.array(high, np.float64)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, material=material, pos=(a + b) / 2, size=np.abs(b - a) / 2)


def add_plate(
    palette: Palette, body: mujoco.MjsBody, name: str, image: Image, side: float, T: Float[np.ndarray, "4 4"]
) -> None:
    """A thin square plate with a picture on its +z side; T: its pose on the body."""
    from scipy.spatial.transform import Rotation

    material = palette.add(name, image, cube=False, shine=0.0)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        material=material,
        pos=T[:3, 3],
        quat=Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True),
        size=[side / 2, side / 2, 0.001],
        contype=0,
        conaffinity=0,
        mass=0.01,
    )
