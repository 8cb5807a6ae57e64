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

    def to_cam(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        """World -> colour camera's frame (OpenCV's axes)."""
        return (points - self.center[:, None]) @ self.R_cam_world.transpose(1, 2)


@dataclass(frozen=True)
class Boxes:
    """Furniture, walls and the floor: boxes that stand upright, turned about z."""

    center: Float[Tensor, "b k 3"]
    half: Float[Tensor, "b k 3"]
    """half edges"""
    yaw: Float[Tensor, "b k"]

    def local(self, points: Float[Tensor, "b n 3"], vectors: bool = False) -> Float[Tensor, "b k n 3"]:
        """World points (or directions) in each box's axes."""
        p = points[:, None] if vectors else points[:, None] - self.center[:, :, None]
        c, s = self.yaw.cos()[..., None], self.yaw.sin()[..., None]
        return torch.stack([c * p[..., 0] + s * p[..., 1], c * p[..., 1] - s * p[..., 0], p[..., 2].expand_as(c * p[..., 0])], -1)

    def holds(self, points: Float[Tensor, "b n 3"], margin: float) -> Bool[Tensor, "b k"]:
        """Whether any of the points is inside the box or nearer than `margin`."""
        return (self.local(points).abs() < self.half[:, :, None] + margin).all(-1).any(-1)

    def without(self, gone: Bool[Tensor, "b k"]) -> Boxes:
        """Some boxes sunk far below the floor."""
        down = torch.tensor([0.0, 0.0, -100.0], device=self.center.device)
        return Boxes(torch.where(gone[..., None], down, self.center), self.half, self.yaw)


def place_cameras(draw: Draw, config: SceneConfig, body: Float[Tensor, "b n 3"]) -> Cameras:
    """Cameras that look roughly at the main person. body: the person's joints in the world (for the aim)."""
    b = len(body)
    low, high = config.distance_m
    distance = low + (high - low) * draw.uniform(0, 1, b) ** 1.2
    height = draw.uniform(*config.height_m, b)
    # The person stands at the origin and is turned at random, so the camera may as well always be at -y.
    center = torch.stack([torch.zeros_like(distance), -distance, height], -1)
    spread = config.aim_sigma_m * torch.where(draw.chance(0.25, b), 3.0, 1.0)
    middle = (body.amin(1) + body.amax(1)) / 2
    aside = draw.normal(b, 3) * (spread * (0.5 + distance / 4))[:, None] * torch.tensor([1.0, 0.0, 0.6], device=body.device)
    forward = torch.nn.functional.normalize(middle + aside - center, dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], device=body.device).expand(b, 3)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    roll = 0.035 * draw.normal(b)[:, None]
    down = torch.linalg.cross(forward, right)
    right, down = roll.cos() * right + roll.sin() * down, roll.cos() * down - roll.sin() * right
    return Cameras(torch.stack([right, down, forward], 1), center)


def place_boxes(
    draw: Draw, config: SceneConfig, cameras: Cameras, joints: Float[Tensor, "b 18 3"], sits: Bool[Tensor, "b"]
) -> Boxes:
    """Floor, walls, a seat under who sits, a support at a hand, occluders, and things around.

    joints: the main person's, in the world. No box comes nearer than a few centimetres to a joint.
    """
    b, device = len(joints), joints.device
    boxes: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []  # center, half, yaw, present

    def add(center: Tensor, half: Tensor, yaw: Tensor, present: Tensor) -> None:
        boxes.append((center, half, yaw, present))

    def box(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return torch.stack([x, y, z], -1)

    def some(low: float, high: float) -> Tensor:
        return draw.uniform(low, high, b)

    away = -cameras.center[:, 1]
    hips = (joints[:, 8] + joints[:, 11]) / 2
    # floor (sometimes not seen), back wall, side wall
    add(box(some(0, 0), some(0, 0), some(-0.5, -0.5)), box(some(9, 9), some(9, 9), some(0.5, 0.5)), some(0, 0), draw.chance(0.96, b))
    back = 0.35 + 3.5 * some(0, 1) ** 1.5
    add(box(some(-1, 1), back + 0.5 + 0.3, some(1.5, 1.5)), box(some(9, 9), some(0.3, 0.3), some(1.6, 1.6)), some(-0.6, 0.6), draw.chance(0.75, b))
    side = torch.where(draw.chance(0.5, b), 1.0, -1.0)
    add(box(side * some(0.8, 2.5), some(0, 2), some(1.5, 1.5)), box(some(0.1, 0.1), some(1, 4), some(1.6, 1.6)), some(-0.3, 0.3), draw.chance(0.25, b))
    # seat and its back, under who sits
    turn = torch.atan2(joints[:, 11, 1] - joints[:, 8, 1], joints[:, 11, 0] - joints[:, 8, 0])
    behind = box(-turn.sin(), turn.cos(), torch.zeros_like(turn))
    seat_top = hips[:, 2] - some(0.1, 0.14)
    thick = some(0.02, 0.08)
    solid = draw.chance(0.3, b)
    half_z = torch.where(solid, seat_top.clamp_min(0.1) / 2, thick)
    seat_z = seat_top - half_z
    flat = torch.tensor([1.0, 1.0, 0.0], device=device)
    add(hips * flat - behind * 0.1 + seat_z[:, None] * (1 - flat), box(some(0.2, 0.5), some(0.22, 0.3), half_z), turn, sits)
    rest = seat_top + some(0.15, 0.35)
    add(hips * flat + behind * some(0.2, 0.3)[:, None] + rest[:, None] * (1 - flat), box(some(0.2, 0.3), some(0.015, 0.05), some(0.1, 0.3)), turn, sits & draw.chance(0.7, b))
    # what a hand touches: a panel (door, cabinet front), just beyond the wrist on the far side from the trunk
    hand = torch.where(draw.chance(0.5, b)[:, None], joints[:, 4], joints[:, 7])
    out = torch.nn.functional.normalize((hand - hips) * flat + 1e-4, dim=-1)
    half_panel = box(some(0.2, 0.5), some(0.015, 0.3), some(0.3, 1.0))
    reach = some(0.12, 0.2) + half_panel[:, 1]
    place = hand * flat + out * reach[:, None]
    height = torch.maximum(half_panel[:, 2], hand[:, 2] + some(-0.4, 0.4))
    add(place + height[:, None] * (1 - flat), half_panel, torch.atan2(out[:, 0], -out[:, 1]) + some(-0.3, 0.3), draw.chance(0.2, b))
    # a table at the person's front or side
    angle = turn + some(-2.2, 2.2)
    ahead = box(angle.sin(), -angle.cos(), torch.zeros_like(angle))
    top = some(0.45, 1.1)
    add(hips * flat + ahead * some(0.35, 0.7)[:, None] + top[:, None] * (1 - flat), box(some(0.3, 0.8), some(0.15, 0.4), some(0.015, 0.05)), angle, draw.chance(0.25, b))
    # between camera and person: something that stands on the floor, hangs, or a post
    hidden = draw.chance(config.occluder, b)
    share = some(0.12, 0.75)
    kind = some(0, 1)
    low, post = kind < 0.6, kind > 0.85
    line = hips * flat * (1 - share[:, None]) + cameras.center * flat * share[:, None]
    # the height at which the ray from the camera to some height of the body passes here
    aim = torch.where(low, some(0.0, 1.3), some(0.5, 1.9))
    passes = aim * (1 - share) + cameras.center[:, 2] * share
    half_z = torch.where(low, (passes / 2).clamp_min(0.02), torch.where(post, torch.full_like(passes, 1.2), some(0.05, 0.35)))
    half_x = torch.where(post, some(0.03, 0.15), torch.where(low, some(0.15, 1.2), some(0.1, 0.5))) * (1.2 - share)
    sideways = torch.where(post, some(-0.25, 0.25), some(-0.6, 0.6)) * (1 - share)
    center_z = torch.where(low | post, half_z, passes)
    add(box(line[:, 0] + sideways, line[:, 1], center_z), box(half_x, some(0.02, 0.3), half_z), some(-0.5, 0.5), hidden)
    for _ in range(config.furniture):
        where = box(some(-2.2, 2.2), some(-1.2, 2.5), torch.zeros(b, device=device))
        half = box(some(0.1, 0.7), some(0.1, 0.7), some(0.1, 0.6) * draw.lognormal(0.4, b))
        add(where + half * (1 - flat), half, some(0, 3.1), draw.chance(0.6, b) & (where[:, 1] > -0.7 * away))
    center, half, yaw = (torch.stack(part, 1) for part in list(zip(*boxes, strict=True))[:3])
    present = torch.stack([x[3] for x in boxes], 1)
    made = Boxes(center, half, yaw)
    blocked = made.holds(joints, 0.06)
    blocked[:, 0] = False  # the floor may touch the feet
    camera_inside = made.holds(cameras.center[:, None], 0.3)
    return made.without(~present | blocked | camera_inside)
