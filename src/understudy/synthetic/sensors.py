"""What depth cameras do to exact depth: noise, flying pixels, holes, limits of the image (`../shared` of the field:
Nguyen 2012 for Kinect v1, Fankhauser 2015 for v2, Tölgyessy 2021 for Azure Kinect, Intel's tuning guide for the D400).
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
    depth_pitch: float
    """radians by which the depth camera looks down against the colour camera"""
    pixel: float
    """tangent of one depth pixel's angle"""
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


SENSORS: Final = MappingProxyType(
    {
        "kinect2": Sensor((0.89, 0.50), (0.70, 0.58), 0.0, 1 / 365, (0.045, 0.06), (0.0015, -0.0005, 0.0003), 0, 0.35, 0.35, 0.6, 8.0),
        "azure": Sensor((1.02, 0.58), (0.63, 0.57), 0.105, 1 / 504, (0.025, 0.04), (0.0005, 0.0010, 0.0), 0, 0.15, 0.7, 0.6, 5.5),
        "realsense": Sensor((0.69, 0.39), (1.0, 0.60), 0.0, 1 / 425, (0.01, 0.055), (0.001, 0.0, 0.0038), 3.0, 0.3, 0.5, 0.1, 8.0),
        "other": Sensor((0.62, 0.48), (0.66, 0.5), 0.0, 1 / 300, (0.0, 0.08), (0.002, 0.0, 0.002), 1.5, 0.3, 0.3, 0.3, 6.0),
    }
)
"""Name -> sensor. `other` stands for depth cameras that are not among the first three."""


class Rig:
    """The sensors of a batch, one per scene, with what varies from unit to unit."""

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
        self.pixel = column([s.pixel for s in table]) * draw.lognormal(0.2, b)
        low, high = column([s.baseline[0] for s in table]), column([s.baseline[1] for s in table])
        side = torch.where(draw.chance(0.5, b), 1.0, -1.0)
        self.baseline = torch.stack([side * draw.uniform(low, high, b), 0.006 * draw.normal(b), 0.004 * draw.normal(b)], -1)
        self.sigma = torch.stack([column([s.sigma[i] for s in table]) for i in range(3)], -1) * draw.lognormal(0.4, b)[:, None]
        self.smooth = column([s.smooth for s in table])
        self.flying = column([s.flying for s in table]) * draw.lognormal(0.4, b)
        self.edge_hole = column([s.edge_hole for s in table])
        self.dark_hole = column([s.dark_hole for s in table])
        self.max_z = column([s.max_z for s in table]) * draw.uniform(0.8, 1.1, b)
        self.keep = 1 - draw.uniform(0, 0.6, b) * draw.chance(0.3, b)

    def degrade(self, draw: Draw, z: Float[Tensor, "b s s"], dark: Bool[Tensor, "b s s"]) -> Float[Tensor, "b s s"]:
        """Exact depth -> what the sensor says; 0 = no measurement. dark: surfaces that return little light."""
        b, s, _ = z.shape
        shape = (b, s, s)

        def per(x: Tensor) -> Tensor:
            return x[:, None, None]

        far = F.max_pool2d(z, 3, 1, 1)
        near = -F.max_pool2d(-z, 3, 1, 1)
        edge = (far - near) > 0.08
        dice = draw.uniform(0, 1, *shape)
        mixed = near + (far.clamp_max(9.0) - near).clamp_min(0) * draw.uniform(0, 1, *shape) ** 2
        share = per(self.flying) * 0.3
        out = torch.where(edge & (dice < share), mixed, z)
        hole = edge & (dice > 1 - per(self.edge_hole) * 0.5)
        # patches: smooth random fields, cut at a level
        patch = F.interpolate(draw.normal(b, 1, s // 4, s // 4), size=(s, s), mode="bilinear")[:, 0]
        hole |= dark & (patch > 2.0 * (0.5 - per(self.dark_hole)))
        spots = draw.uniform(0, 1, b) ** 4
        hole |= patch > 3.2 - 2.0 * per(spots)
        hole |= draw.uniform(0, 1, *shape) > per(self.keep)
        white = draw.normal(*shape)
        soft = F.interpolate(draw.normal(b, 1, s // 3, s // 3), size=(s, s), mode="bilinear")[:, 0] * 1.3
        noise = torch.where(per(self.smooth) > 0, soft, white)
        c0, c1, c2 = (per(self.sigma[:, i]) for i in range(3))
        slope = (1 + ((far - near) / (0.04 * z)).clamp(0, 1.5))
        out = out + noise * (c0 + c1 * z + c2 * z * z).clamp_min(0.0005) * slope
        hole |= (out > per(self.max_z)) | (out < 0.25)
        return torch.where(hole, 0.0, out)

    def seen_by(self, tangent: Tensor, direction: Float[Tensor, "b n 3"], pitch: Tensor | None = None) -> Bool[Tensor, "b n"]:
        """Which directions (colour camera's frame) lie inside an image of that half angle."""
        x, y, z = direction.unbind(-1)
        if pitch is not None:
            c, s = pitch.cos()[:, None], pitch.sin()[:, None]
            y, z = c * y - s * z, s * y + c * z
        ok = z > 0.05
        return ok & (x.abs() < tangent[:, :1] * z) & (y.abs() < tangent[:, 1:] * z)
