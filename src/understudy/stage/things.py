"""Things that stand along the walls of a room: shelves, chests, sofas, plants, pictures."""

from __future__ import annotations

import mujoco
import numpy as np

from understudy.stage import textures
from understudy.stage.palette import THINGS, Palette

_GREEN = np.array([0.20, 0.38, 0.16])

_HIGHEST = 2.5  # metres: nothing on a wall reaches higher


class Thing:
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
        add_box(self._palette.spec.worldbody, name, material, (a[0], a[1], low[2]), (b[0], b[1], high[2]))

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
            color = palette.plain(f"{name}_on{i}", palette.tone(THINGS))
            tall = height + rng.uniform(0.08, 0.35)
            self._part(place, out, color, (0.08, y - s / 2, height), (0.08 + s, y + s / 2, tall), f"{name}_on{i}")

    def shelf(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A shelf with books."""
        palette, rng, name = self._palette, self._palette.rng, self._name("shelf")
        material, deep, height = palette.surface(name), 0.28, rng.uniform(1.2, 2.0)
        books = [palette.plain(f"{name}_book{i}", palette.tone(THINGS)) for i in range(3)]
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
        high = min(z + rng.uniform(0.4, 0.8), _HIGHEST)
        self._part(place, out, material, (0, -half, z), (0.02, half, high), name)

    def plant(self, place: tuple[float, float], wide: float, out: np.ndarray) -> None:
        """A plant in a pot."""
        palette, rng, name = self._palette, self._palette.rng, self._name("plant")
        world, middle = palette.spec.worldbody, np.array(place) + 0.3 * out
        pot, green = palette.plain(f"{name}_pot", palette.tone(THINGS)), palette.plain(name, _GREEN)
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


def add_box(body: mujoco.MjsBody, name: str, material: str, low: tuple, high: tuple) -> None:
    a, b = np.array(low, np.float64), np.array(high, np.float64)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, material=material, pos=(a + b) / 2, size=np.abs(b - a) / 2)
