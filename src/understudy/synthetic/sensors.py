"""What depth cameras do to exact depth: noise, flying pixels, holes, limits of the image.

Sources: Nguyen 2012 for Kinect v1, Fankhauser 2015 for v2, Tölgyessy 2021 for Azure Kinect, Intel's tuning guide for
the D400.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.synthetic.draw import Draw


@dataclass(frozen=True)
class Sensor:
    """One depth camera beside its colour camera."""

    color_tan: tuple[float, float]
    """tangent of half the colour image's angle, across and down"""
    depth_tan: tuple[float, float]
    """the same of the depth image"""
    depth_pitch: float
    """radians by which the depth camera looks down against the colour camera"""
    baseline: tuple[float, float]
    """metres from the colour to the depth camera: between these, to either side"""
    sigma: tuple[float, float, float]
    """axial noise: c0 + c1 z + c2 z^2 metres"""
    smooth: float
    """correlation length of the noise in pixels of the simulation; 0 = white"""
    flying: float
    """share of edge pixels that float between front and back"""
    edge_hole: float
    """share of edge pixels without depth"""
    dark_hole: float
    """share of dark surfaces without depth"""
    max_z: float
    """metres: nothing farther is measured"""


SENSORS: Final = MappingProxyType(
    {
        "kinect2": Sensor(
            color_tan=(0.89, 0.50),
            depth_tan=(0.70, 0.58),
            depth_pitch=0.0,
            baseline=(0.045, 0.06),
            sigma=(0.0015, -0.0005, 0.0003),
            smooth=0,
            flying=0.35,
            edge_hole=0.35,
            dark_hole=0.6,
            max_z=8.0,
        ),
        "azure": Sensor(
            color_tan=(1.02, 0.58),
            depth_tan=(0.63, 0.57),
            depth_pitch=0.105,
            baseline=(0.025, 0.04),
            sigma=(0.0005, 0.0010, 0.0),
            smooth=0,
            flying=0.15,
            edge_hole=0.7,
            dark_hole=0.6,
            max_z=5.5,
        ),
        "realsense": Sensor(
            color_tan=(0.69, 0.39),
            depth_tan=(1.0, 0.60),
            depth_pitch=0.0,
            baseline=(0.01, 0.055),
            sigma=(0.001, 0.0, 0.0038),
            smooth=3.0,
            flying=0.3,
            edge_hole=0.5,
            dark_hole=0.1,
            max_z=8.0,
        ),
        "other": Sensor(
            color_tan=(0.62, 0.48),
            depth_tan=(0.66, 0.5),
            depth_pitch=0.0,
            baseline=(0.0, 0.08),
            sigma=(0.002, 0.0, 0.002),
            smooth=1.5,
            flying=0.3,
            edge_hole=0.3,
            dark_hole=0.3,
            max_z=6.0,
        ),
    }
)
"""Name -> sensor. `other` stands for depth cameras that are not among the first three."""

_EDGE = 0.08  # metres: a step between neighbouring pixels that counts as an edge
_FARTHEST = 9.0  # metres: flying pixels are not drawn farther back than this
_NEAREST = 0.25  # metres: nothing nearer is measured
_NEAREST_COLOR = 0.15  # metres, the same for the colour camera
_LEAST_SIGMA = 0.0005  # metres


class Rig:
    """The sensors of a batch, one per scene, with what varies from unit to unit. Every attribute: (B, ...).

    Attributes are those of `Sensor`, besides `kind` (number in `names`), `baseline` (B, 3: the depth camera's place in
    the colour camera's frame) and `keep` (share of pixels that are measured at all).
    """

    def __init__(self, draw: Draw, names: tuple[str, ...], b: int):
        table = [SENSORS[n] for n in names]
        pick = draw.integers(len(table), b)
        self.kind = pick

        def column(values: list[float]) -> Tensor:
            return torch.tensor(values, device=draw.device)[pick]

        vary = draw.lognormal(0.06, b)
        self.color_tan = torch.stack([column([s.color_tan[i] for s in table]) * vary for i in (0, 1)], -1)
        self.depth_tan = torch.stack([column([s.depth_tan[i] for s in table]) * vary for i in (0, 1)], -1)
        self.pitch = column([s.depth_pitch for s in table])
        low, high = column([s.baseline[0] for s in table]), column([s.baseline[1] for s in table])
        side = torch.where(draw.chance(0.5, b), 1.0, -1.0)
        across = side * draw.uniform(low, high, b)
        self.baseline = torch.stack([across, 0.006 * draw.normal(b), 0.004 * draw.normal(b)], -1)
        sigma = torch.stack([column([s.sigma[i] for s in table]) for i in range(3)], -1)
        self.sigma = sigma * draw.lognormal(0.4, b)[:, None]
        self.smooth = column([s.smooth for s in table])
        self.flying = column([s.flying for s in table]) * draw.lognormal(0.4, b)
        self.edge_hole = column([s.edge_hole for s in table])
        self.dark_hole = column([s.dark_hole for s in table])
        self.max_z = column([s.max_z for s in table]) * draw.uniform(0.8, 1.1, b)
        self.keep = 1 - draw.uniform(0, 0.6, b) * draw.chance(0.3, b)

    def degrade(
        self, draw: Draw, z: Float[Tensor, "b h w"], dark: Bool[Tensor, "b h w"], finer: int = 1
    ) -> Float[Tensor, "b h w"]:
        """Exact depth -> what the sensor says, metres; 0 = no measurement.

        dark: surfaces that return little light. finer: how many times smaller the pixels are than those of the
        simulated network input (2 cm at the person); holes come in patches of about 4 of those.
        """
        b, h, w = z.shape
        shape = (b, h, w)

        def field(pixels: int) -> Tensor:
            """Smooth and random, about standard normal."""
            cells = draw.normal(b, 1, max(h // pixels, 1), max(w // pixels, 1))
            return F.interpolate(cells, size=(h, w), mode="bilinear")[:, 0]

        far = F.max_pool2d(z, 3, 1, 1)
        near = -F.max_pool2d(-z, 3, 1, 1)
        edge = (far - near) > _EDGE
        dice = draw.uniform(0, 1, *shape)
        mixed = near + (far.clamp_max(_FARTHEST) - near).clamp_min(0) * draw.uniform(0, 1, *shape) ** 2
        share = _per_scene(self.flying) * 0.3
        out = torch.where(edge & (dice < share), mixed, z)
        hole = edge & (dice > 1 - _per_scene(self.edge_hole) * 0.5)
        patch = field(4 * finer)
        hole |= dark & (patch > 2.0 * (0.5 - _per_scene(self.dark_hole)))
        spots = draw.uniform(0, 1, b) ** 4
        hole |= patch > 3.2 - 2.0 * _per_scene(spots)
        hole |= draw.uniform(0, 1, *shape) > _per_scene(self.keep)
        white = draw.normal(*shape)
        soft = field(3) * 1.3
        noise = torch.where(_per_scene(self.smooth) > 0, soft, white)
        slope = 1 + ((far - near) / (0.04 * z)).clamp(0, 1.5)
        out = out + noise * self.sigma_at(z) * slope
        hole |= (out > _per_scene(self.max_z)) | (out < _NEAREST)
        return torch.where(hole, 0.0, out)

    def sigma_at(self, z: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
        """Axial noise (one sigma, metres) of a surface that faces the camera at these depths."""
        c0, c1, c2 = (_per_scene(self.sigma[:, i]) for i in range(3))
        return (c0 + c1 * z + c2 * z * z).clamp_min(_LEAST_SIGMA)

    def in_color(self, points: Float[Tensor, "b n 3"]) -> Bool[Tensor, "b n"]:
        """Which points (colour camera's frame, metres) lie in the colour image and not right before the camera."""
        return self.seen_by(self.color_tan, points) & (points[..., 2] > _NEAREST_COLOR)

    def seen_by(
        self, tangent: Float[Tensor, "b 2"], direction: Float[Tensor, "b n 3"], pitch: Tensor | None = None
    ) -> Bool[Tensor, "b n"]:
        """Which directions (colour camera's frame) lie inside an image of that half angle.

        pitch: (B,) radians by which that camera looks down.
        """
        x, y, z = direction.unbind(-1)
        if pitch is not None:
            c, s = pitch.cos()[:, None], pitch.sin()[:, None]
            y, z = c * y - s * z, s * y + c * z
        ok = z > 0.05
        return ok & (x.abs() < tangent[:, :1] * z) & (y.abs() < tangent[:, 1:] * z)


def _per_scene(x: Tensor) -> Tensor:
    return x[:, None, None]
