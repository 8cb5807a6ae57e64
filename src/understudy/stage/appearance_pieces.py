"""What a dressed person is made of: meshes of one material each, and what poses them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32, UInt8
from scipy import sparse

Color = tuple[float, float, float]
"""sRGB, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A mesh part with one material."""

    name: str
    faces: Int32[np.ndarray, "f 3"]
    """counter-clockwise seen from outside"""
    color: Color
    """sRGB, 0 to 1; of the whole piece where there is no texture"""
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    """sRGB"""
    uv: Float[np.ndarray, "v 2"] | None = None
    """per vertex: column / width from the left, row / height from the top, 0 to 1"""


@dataclass(frozen=True, eq=False)
class Garment:
    """A piece with what poses it."""

    piece: Piece
    vertices: Float[np.ndarray, "v 3"]
    """at rest, body frame"""
    weights: sparse.csr_matrix
    """(v, b) skinning weights"""


@dataclass(frozen=True)
class Looks:
    """Colours (sRGB, 0 to 1) and cuts of a person's clothes."""

    skin: Color
    hair: Color
    eyes: Color
    shirt: Color
    trousers: Color
    shoes: Color
    sleeve: float
    """0 to 1 down the upper arm, 1 to 2 down the forearm"""
    long_hair: bool
