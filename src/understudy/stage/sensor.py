"""The RGB-D sensor on the stage: its two cameras, and what they make of ideal pictures."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from understudy.camera import Camera, RGBDCamera
from understudy.cli.common import needs_extra
from understudy.errors import UnderstudyError, one_of
from understudy.geometry import rigid
from understudy.stage.render import Surfaces

with needs_extra("the stage's depth cameras", "train"):
    import torch

    from understudy.synthetic.draw import Draw
    from understudy.synthetic.recording import IMAGES
    from understudy.synthetic.sensors import Rig

_PIXEL_M: Final = 0.0206
"""Pixel at the person for which `Rig.degrade` is meant, metres; as in `synthetic.recording`."""
_PERSON_M: Final = 2.7  # usual distance of the person
_BLUR: Final = 0.6  # pixels
_NOISE: Final = 0.008  # of full scale


class Sensor:
    """One unit of a kind of sensor, with the small differences that units have."""

    def __init__(self, name: str, seed: int, fine_color: bool = False):
        """fine_color: twice the usual number of pixels each way, for markers. Raises UnderstudyError for a kind of
        sensor that there is not.
        """
        if name not in IMAGES:
            raise UnderstudyError(f"sensor {name!r}: must be {one_of(IMAGES)}")
        self._seed = seed
        draw = self._draw(0)
        self._rig = Rig(draw, (name,), 1)
        self._rig.keep = torch.ones(1)  # losing half of all pixels hardens training, but these sensors do not do it
        made = []
        for width, height, f in IMAGES[name]:
            f = f * float(draw.uniform(0.985, 1.015, 1))
            cx, cy = (draw.normal(2) * 3.0 + torch.tensor([width - 1, height - 1]) / 2).tolist()
            made.append(Camera(width, height, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])))
        c, s = np.cos(float(self._rig.pitch)), np.sin(float(self._rig.pitch))
        R = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])
        color = made[0].scale(2.0) if fine_color else made[0]
        self.camera = RGBDCamera(color, made[1], rigid(R, self._rig.baseline[0].double().numpy()))

    def _draw(self, number: int) -> Draw:
        return Draw((self._seed * 1_000_003 + 700_000 + number) % 2**63)

    def photo(self, image: UInt8[np.ndarray, "h w 3"], index: int) -> UInt8[np.ndarray, "h w 3"]:
        """Slightly soft, and noisy."""
        rng = np.random.default_rng([self._seed, 73, index])
        soft = cv2.GaussianBlur(image, (3, 3), _BLUR).astype(np.float32)
        soft += 255 * _NOISE * rng.standard_normal(image.shape, dtype=np.float32)
        return np.asarray(soft.clip(0, 255).round().astype(np.uint8))

    @torch.no_grad()
    def measure(self, seen: Surfaces, index: int) -> Float32[np.ndarray, "h w"]:
        """Depth with the sensor's noise, flying pixels and holes; metres, 0 = no measurement."""
        finer = max(1, round(_PIXEL_M * self.camera.depth.fx / _PERSON_M))
        z, dark = torch.from_numpy(seen.depth)[None], torch.from_numpy(seen.dark)[None]
        return np.asarray(self._rig.degrade(self._draw(1 + index), z, dark, finer)[0].numpy().astype(np.float32))

    def depth_pose(self, T_world_color: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """T_world_depth."""
        return np.asarray(T_world_color @ self.camera.T_color_depth)
