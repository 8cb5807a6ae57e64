"""Materials of a scene: colours and pictures of surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.stage import textures
from understudy.stage.textures import Color, Image

WOODS = ((0.72, 0.53, 0.35), (0.55, 0.38, 0.24), (0.83, 0.70, 0.53), (0.42, 0.28, 0.19))
PAINTS = ((0.90, 0.89, 0.86), (0.80, 0.80, 0.78), (0.62, 0.66, 0.66), (0.55, 0.60, 0.52), (0.86, 0.80, 0.68))
WALLS = ((0.88, 0.86, 0.82), (0.82, 0.84, 0.84), (0.85, 0.80, 0.70), (0.76, 0.80, 0.76), (0.80, 0.74, 0.70))
THINGS = ((0.65, 0.20, 0.18), (0.20, 0.35, 0.55), (0.25, 0.42, 0.28), (0.75, 0.55, 0.20), (0.3, 0.3, 0.33))
_PLATE_M = 0.002  # thickness


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
            return self.add(name, textures.wood(self.rng, self.tone(WOODS)))
        return self.add(name, textures.paint(self.rng, self.tone(PAINTS)))

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
        "wall": palette.add("wall", textures.paint(rng, palette.tone(WALLS))),
        "frame": palette.add("frame", textures.paint(rng, palette.tone(PAINTS[:2]))),
        "metal": palette.plain("metal", rng.uniform(0.12, 0.72) * np.ones(3), shine=0.8),
    }


def add_plate(
    palette: Palette, body: mujoco.MjsBody, name: str, image: Image, side: float, T: Float[np.ndarray, "4 4"]
) -> None:
    """A thin square plate with a picture on its +z side; T: the picture's pose on the body."""
    material = palette.add(name, image, cube=False, shine=0.0)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        material=material,
        pos=T[:3, 3] - _PLATE_M / 2 * T[:3, 2],
        quat=Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True),
        size=[side / 2, side / 2, _PLATE_M / 2],
        contype=0,
        conaffinity=0,
        mass=0.01,
    )
