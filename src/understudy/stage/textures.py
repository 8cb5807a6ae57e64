"""Pictures of surfaces, made by numbers: wood, paint, fabric, floors, pictures on a wall. (h, w, 3), 8-bit RGB."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Image = UInt8[np.ndarray, "h w 3"]
Color = Float[np.ndarray, "3"]

_SIDE: Final = 256


def noise(rng: np.random.Generator, width: int, height: int, cells: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Smooth, about standard normal; cells: how many bumps across and down."""
    coarse = rng.standard_normal((max(cells[1], 2), max(cells[0], 2)))
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


def paint(rng: np.random.Generator, color: Color) -> Image:
    """An even coat with faint stains."""
    stains = 0.012 * noise(rng, _SIDE, _SIDE, (6, 6)) + 0.008 * rng.standard_normal((_SIDE, _SIDE))
    return _bytes(color * (1 + stains[..., None]))


def wood(rng: np.random.Generator, color: Color) -> Image:
    """Grain that runs upwards."""
    across = noise(rng, _SIDE, _SIDE, (40, 3)) + 0.6 * noise(rng, _SIDE, _SIDE, (110, 4))
    bands = np.sin(9 * noise(rng, _SIDE, _SIDE, (5, 2)) + 2 * across)
    return _bytes(color * (1 + (0.05 * across + 0.06 * bands)[..., None] * (0.8, 1.0, 1.25)))


def fabric(rng: np.random.Generator, color: Color) -> Image:
    """A weave."""
    u = np.arange(_SIDE)
    weave = 0.06 * np.sin(u * 1.6)[:, None] * np.sin(u * 1.6)[None]
    return _bytes(color * (1 + (weave + 0.06 * rng.standard_normal((_SIDE, _SIDE)))[..., None]))


def planks(rng: np.random.Generator, color: Color) -> Image:
    """A floor of wooden boards; one picture covers about two metres."""
    side, rows = 512, 12
    image = np.empty((side, side, 3))
    edges = np.linspace(0, side, rows + 1).astype(int)
    for low, high in pairwise(edges):
        tone = color * (1 + 0.09 * rng.standard_normal())
        grain = 0.05 * noise(rng, side, int(high - low), (8, 6)) + 0.03 * noise(rng, side, int(high - low), (20, 16))
        image[low:high] = tone * (1 + grain[..., None])
        image[low] *= 0.75
        joint = rng.integers(side)
        image[low:high, joint : joint + 1] *= 0.75
    return _bytes(image)


def tiles(rng: np.random.Generator, color: Color) -> Image:
    """A tiled floor."""
    side, n = 512, 4
    tone = 1 + 0.04 * np.kron(rng.standard_normal((n, n)), np.ones((side // n, side // n)))
    image = color * (tone + 0.02 * noise(rng, side, side, (30, 30)))[..., None]
    for i in range(n):
        line = slice(i * side // n, i * side // n + 3)
        image[line] = image[:, line] = color.mean() * 0.75
    return _bytes(image)


def picture(rng: np.random.Generator, color: Color) -> Image:
    """Something abstract in a frame."""
    other = rng.uniform(0.15, 0.9, 3)
    bumps = int(rng.integers(2, 7)), int(rng.integers(2, 7))
    mix = np.clip(0.5 + 0.6 * noise(rng, _SIDE, _SIDE, bumps), 0, 1)[..., None]
    image = color * mix + other * (1 - mix)
    border = np.ones((_SIDE, _SIDE), bool)
    border[16:-16, 16:-16] = False
    image[border] = rng.choice([0.15, 0.9])
    return _bytes(image)


def _bytes(image: Float[np.ndarray, "h w 3"]) -> Image:
    return np.asarray((255 * image.clip(0, 1)).round().astype(np.uint8))
