"""What stands around the simulated people: floor, walls, seats, panels, tables, occluders, boxes. World frame, metres.

Numbers are drawn in a fixed order, so that a scene is a function of its seed.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.synthetic.draw import Draw
from understudy.synthetic.scene import Boxes, Cameras, SceneConfig

FLOOR = 0
"""Number of the box that is the floor."""


def place_boxes(
    draw: Draw, config: SceneConfig, cameras: Cameras, joints: Float[Tensor, "b 18 3"], sits: Bool[Tensor, " b"]
) -> Boxes:
    """Floor, walls, a seat under who sits, a support at a hand, occluders, and things around.

    joints: the main person's, in the world. No box comes nearer than a few centimetres to a joint.
    """
    room = _Room(draw, joints)
    room.add_walls()
    room.add_seat(sits)
    room.add_panel()
    room.add_table()
    room.add_occluder(config.occluder, cameras.center)
    for _ in range(config.furniture):
        room.add_thing(cameras.center)
    made, present = room.boxes()
    blocked = made.holds(joints, 0.06)
    blocked[:, FLOOR] = False  # it may touch the feet
    camera_inside = made.holds(cameras.center[:, None], 0.3)
    return made.without(~present | blocked | camera_inside)


def place_seats(draw: Draw, joints: Float[Tensor, "b 18 3"], sits: Bool[Tensor, " b"]) -> Boxes:
    """Only the seats of those who sit: two boxes each."""
    room = _Room(draw, joints)
    room.add_seat(sits)
    made, present = room.boxes()
    return made.without(~present | made.holds(joints, 0.06))


class _Room:
    """Boxes that are added one after the other; all tensors (B, ...)."""

    def __init__(self, draw: Draw, joints: Float[Tensor, "b 18 3"]):
        self.draw, self.joints, self.b = draw, joints, len(joints)
        self.flat = torch.tensor([1.0, 1.0, 0.0], device=joints.device)
        self.hips = (joints[:, 8] + joints[:, 11]) / 2
        self.turn = torch.atan2(joints[:, 11, 1] - joints[:, 8, 1], joints[:, 11, 0] - joints[:, 8, 0])
        """of the hips about z"""
        self._made: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []

    def boxes(self) -> tuple[Boxes, Bool[Tensor, "b k"]]:
        """All of them, and which are there."""
        center, half, yaw, present = (torch.stack(part, 1) for part in zip(*self._made, strict=True))
        return Boxes(center, half, yaw), present

    def add(self, center: Tensor, half: Tensor, yaw: Tensor, present: Tensor) -> None:
        self._made.append((center, half, yaw, present))

    def some(self, low: float, high: float) -> Tensor:
        return self.draw.uniform(low, high, self.b)

    def add_walls(self) -> None:
        """The floor (sometimes not seen), a back wall, a side wall."""
        some, chance, b = self.some, self.draw.chance, self.b
        center = _xyz(some(0, 0), some(0, 0), some(-0.5, -0.5))
        self.add(center, _xyz(some(9, 9), some(9, 9), some(0.5, 0.5)), some(0, 0), chance(0.96, b))
        back = 0.35 + 3.5 * some(0, 1) ** 1.5
        center = _xyz(some(-1, 1), back + 0.5 + 0.3, some(1.5, 1.5))
        half = _xyz(some(9, 9), some(0.3, 0.3), some(1.6, 1.6))
        self.add(center, half, some(-0.6, 0.6), chance(0.75, b))
        side = torch.where(chance(0.5, b), 1.0, -1.0)
        center = _xyz(side * some(0.8, 2.5), some(0, 2), some(1.5, 1.5))
        half = _xyz(some(0.1, 0.1), some(1, 4), some(1.6, 1.6))
        self.add(center, half, some(-0.3, 0.3), chance(0.25, b))

    def add_seat(self, sits: Tensor) -> None:
        """A seat and its back, under who sits."""
        some, hips, flat, turn = self.some, self.hips, self.flat, self.turn
        behind = _xyz(-turn.sin(), turn.cos(), torch.zeros_like(turn))
        seat_top = hips[:, 2] - some(0.1, 0.14)
        thick = some(0.02, 0.08)
        solid = self.draw.chance(0.3, self.b)
        half_z = torch.where(solid, seat_top.clamp_min(0.1) / 2, thick)
        seat_z = seat_top - half_z
        center = hips * flat - behind * 0.1 + seat_z[:, None] * (1 - flat)
        self.add(center, _xyz(some(0.2, 0.5), some(0.22, 0.3), half_z), turn, sits)
        rest = seat_top + some(0.15, 0.35)
        center = hips * flat + behind * some(0.2, 0.3)[:, None] + rest[:, None] * (1 - flat)
        half = _xyz(some(0.2, 0.3), some(0.015, 0.05), some(0.1, 0.3))
        self.add(center, half, turn, sits & self.draw.chance(0.7, self.b))

    def add_panel(self) -> None:
        """What a hand touches (door, cabinet front): just beyond the wrist on the far side from the trunk."""
        some, joints, hips, flat = self.some, self.joints, self.hips, self.flat
        hand = torch.where(self.draw.chance(0.5, self.b)[:, None], joints[:, 4], joints[:, 7])
        out = torch.nn.functional.normalize((hand - hips) * flat + 1e-4, dim=-1)
        half = _xyz(some(0.2, 0.5), some(0.015, 0.3), some(0.3, 1.0))
        reach = some(0.12, 0.2) + half[:, 1]
        place = hand * flat + out * reach[:, None]
        height = torch.maximum(half[:, 2], hand[:, 2] + some(-0.4, 0.4))
        yaw = torch.atan2(out[:, 0], -out[:, 1]) + some(-0.3, 0.3)
        self.add(place + height[:, None] * (1 - flat), half, yaw, self.draw.chance(0.2, self.b))

    def add_table(self) -> None:
        """A table top at the person's front or side."""
        some, hips, flat = self.some, self.hips, self.flat
        angle = self.turn + some(-2.2, 2.2)
        ahead = _xyz(angle.sin(), -angle.cos(), torch.zeros_like(angle))
        top = some(0.45, 1.1)
        center = hips * flat + ahead * some(0.35, 0.7)[:, None] + top[:, None] * (1 - flat)
        half = _xyz(some(0.3, 0.8), some(0.15, 0.4), some(0.015, 0.05))
        self.add(center, half, angle, self.draw.chance(0.25, self.b))

    def add_occluder(self, probability: float, camera: Float[Tensor, "b 3"]) -> None:
        """Between camera and person: something that stands on the floor, hangs, or a post."""
        some, hips, flat = self.some, self.hips, self.flat
        hidden = self.draw.chance(probability, self.b)
        share = some(0.12, 0.75)
        kind = some(0, 1)
        low, post = kind < 0.6, kind > 0.85
        line = hips * flat * (1 - share[:, None]) + camera * flat * share[:, None]
        # the height at which the ray from the camera to some height of the body passes here
        aim = torch.where(low, some(0.0, 1.3), some(0.5, 1.9))
        passes = aim * (1 - share) + camera[:, 2] * share
        hangs = torch.where(post, torch.full_like(passes, 1.2), some(0.05, 0.35))
        half_z = torch.where(low, (passes / 2).clamp_min(0.02), hangs)
        half_x = torch.where(post, some(0.03, 0.15), torch.where(low, some(0.15, 1.2), some(0.1, 0.5))) * (1.2 - share)
        sideways = torch.where(post, some(-0.25, 0.25), some(-0.6, 0.6)) * (1 - share)
        center = _xyz(line[:, 0] + sideways, line[:, 1], torch.where(low | post, half_z, passes))
        self.add(center, _xyz(half_x, some(0.02, 0.3), half_z), some(-0.5, 0.5), hidden)

    def add_thing(self, camera: Float[Tensor, "b 3"]) -> None:
        """A box on the floor, anywhere but right before the camera."""
        some = self.some
        where = _xyz(some(-2.2, 2.2), some(-1.2, 2.5), torch.zeros(self.b, device=camera.device))
        half = _xyz(some(0.1, 0.7), some(0.1, 0.7), some(0.1, 0.6) * self.draw.lognormal(0.4, self.b))
        yaw = some(0, 3.1)
        present = self.draw.chance(0.6, self.b) & (where[:, 1] > 0.7 * camera[:, 1])
        self.add(where + half * (1 - self.flat), half, yaw, present)


def _xyz(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    return torch.stack([x, y, z], -1)
