"""Where people, camera and furniture are. World: z up, floor at z = 0, the main person at the origin; metres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.synthetic.draw import Draw


@dataclass(frozen=True)
class SceneConfig:
    """Ranges of the simulated rooms."""

    distance_m: tuple[float, float] = (1.0, 6.0)
    """horizontal distance from the camera to the main person"""
    height_m: tuple[float, float] = (0.4, 2.4)
    """of the camera above the floor"""
    aim_sigma_m: float = 0.35
    """how far beside the person the camera looks; a quarter of the time three times as far (truncated people)"""
    occluder: float = 0.3
    """share of scenes with something between camera and person"""
    furniture: int = 3
    """boxes that stand around"""
    neighbours: float = 0.35
    """share of scenes with a second person; a third as many have a third one"""


@dataclass(frozen=True)
class Cameras:
    """The colour camera in the world."""

    R_cam_world: Float[Tensor, "b 3 3"]
    center: Float[Tensor, "b 3"]
    """in the world"""

    def where(self, chosen: Bool[Tensor, " b"], other: Cameras) -> Cameras:
        """These cameras in the chosen scenes, the others in the rest."""
        R = torch.where(chosen[:, None, None], self.R_cam_world, other.R_cam_world)
        return Cameras(R, torch.where(chosen[:, None], self.center, other.center))

    def to_cam(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        """World -> colour camera's frame (OpenCV's axes)."""
        return (points - self.center[:, None]) @ self.R_cam_world.transpose(1, 2)


@dataclass(frozen=True)
class Boxes:
    """Furniture, walls and the floor: boxes that stand upright, turned about z. World frame, metres."""

    center: Float[Tensor, "b k 3"]
    half: Float[Tensor, "b k 3"]
    """half edges"""
    yaw: Float[Tensor, "b k"]

    def local(self, points: Float[Tensor, "b n 3"], vectors: bool = False) -> Float[Tensor, "b k n 3"]:
        """World points (or directions) in each box's axes."""
        p = points[:, None] if vectors else points[:, None] - self.center[:, :, None]
        c, s = self.yaw.cos()[..., None], self.yaw.sin()[..., None]
        x = c * p[..., 0] + s * p[..., 1]
        return torch.stack([x, c * p[..., 1] - s * p[..., 0], p[..., 2].expand_as(x)], -1)

    def holds(self, points: Float[Tensor, "b n 3"], margin: float) -> Bool[Tensor, "b k"]:
        """Whether any of the points is inside the box or nearer than `margin` (metres)."""
        return (self.local(points).abs() < self.half[:, :, None] + margin).all(-1).any(-1)

    def without(self, gone: Bool[Tensor, "b k"]) -> Boxes:
        """Some boxes sunk far below the floor."""
        down = torch.tensor([0.0, 0.0, -100.0], device=self.center.device)
        return Boxes(torch.where(gone[..., None], down, self.center), self.half, self.yaw)

    def joined(self, other: Boxes) -> Boxes:
        """These boxes, then the others."""
        pairs = ((self.center, other.center), (self.half, other.half), (self.yaw, other.yaw))
        return Boxes(*(torch.cat(pair, 1) for pair in pairs))


def about_z(angle: Float[Tensor, " b"]) -> Float[Tensor, "b 3 3"]:
    """Rotations about the upward axis (radians, counter-clockwise seen from above)."""
    c, s, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 3, 3)


def place_cameras(
    draw: Draw, config: SceneConfig, body: Float[Tensor, "b n 3"], farthest: Float[Tensor, " b"] | None = None
) -> Cameras:
    """Cameras that look roughly at the main person.

    body: the person's joints in the world (for the aim). farthest: horizontal distance (metres) that is not exceeded,
    per scene.
    """
    b = len(body)
    low = config.distance_m[0]
    high = torch.full((b,), config.distance_m[1], device=body.device)
    if farthest is not None:
        high = high.minimum(farthest).clamp_min(low)
    distance = low + (high - low) * draw.uniform(0, 1, b) ** 1.2
    height = draw.uniform(*config.height_m, b)
    # The person stands at the origin and is turned at random, so the camera may as well always be at -y.
    center = torch.stack([torch.zeros_like(distance), -distance, height], -1)
    spread = config.aim_sigma_m * torch.where(draw.chance(0.25, b), 3.0, 1.0)
    middle = (body.amin(1) + body.amax(1)) / 2
    sideways = torch.tensor([1.0, 0.0, 0.6], device=body.device)
    aside = draw.normal(b, 3) * (spread * (0.5 + distance / 4))[:, None] * sideways
    forward = torch.nn.functional.normalize(middle + aside - center, dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], device=body.device).expand(b, 3)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    roll = 0.035 * draw.normal(b)[:, None]
    down = torch.linalg.cross(forward, right)
    right, down = roll.cos() * right + roll.sin() * down, roll.cos() * down - roll.sin() * right
    return Cameras(torch.stack([right, down, forward], 1), center)
