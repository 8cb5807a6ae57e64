"""Dressed people who hold a pose or move through a room: where each surface point and joint is in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from understudy.errors import UnderstudyError, one_of
from understudy.synthetic.appearance import person_colors
from understudy.synthetic.bodies import REGION, BodyBank, pose, pose_extra
from understudy.synthetic.bvh import read_bvh, retarget
from understudy.synthetic.carried import N_BRIM, N_THING, SPACING
from understudy.synthetic.clothing import Dressed, draw_style, dress
from understudy.synthetic.draw import Draw
from understudy.synthetic.poses import ACTIVITIES, sample_poses, sequence
from understudy.synthetic.scene import about_z
from understudy.synthetic.segments import SEGMENT
from understudy.synthetic.surfels import Surfels, radii

_ANKLES = [10, 13]
_HANDS = [SEGMENT["left_hand"], SEGMENT["right_hand"]]
_SMALL: Final = {"hand": 0.011, "foot": 0.02, "head_skin": 0.014}
"""Region -> largest radius of its surface discs, metres; larger ones would stand over fingers, toes and ears."""
_FASTEST: Final = 3.0
"""m/s: no stance foot slides faster (it would be an error of the motion)"""


@dataclass(frozen=True)
class Moment:
    """One person in one frame; world, metres."""

    surfels: Surfels
    """values: colour (3), dark"""
    joints: Float[Tensor, "18 3"]
    facing: Float[Tensor, " 3"]
    """unit vector: where the chest looks"""
    palms: Float[Tensor, "2 3"]
    """unit normals out of the left and the right palm"""
    hands: Float[Tensor, "2 3"]
    """the middles of the left and the right hand"""


@dataclass(frozen=True)
class Actor:
    """One dressed person, and what they do in F frames."""

    body: BodyBank
    """of one body"""
    near: Int[Tensor, "p k"]
    """of `surfels.neighbours`"""
    worn: Dressed
    colors: Float[Tensor, "p 3"]
    thing_color: Float[Tensor, " 3"]
    rotations: Float[Tensor, "f 21 3 3"]
    joints: Float[Tensor, "f 18 3"]
    """world, metres"""
    floor: Float[Tensor, " f"]
    """height of the lowest point in the body frame"""
    turn: Float[Tensor, "f 3 3"]
    """R_world_body"""
    place: Float[Tensor, "f 3"]
    """of the body frame's origin on the floor, world"""
    activity: str

    @property
    def sits(self) -> bool:
        """Whether they need a seat."""
        return self.activity == "sitting"

    @cached_property
    def _most(self) -> Float[Tensor, " p"]:
        most = torch.full((len(self.body.region),), torch.inf)
        for name, radius in _SMALL.items():
            most[self.body.region == REGION[name]] = radius
        return most

    def shifted(self, by: Float[Tensor, " 3"]) -> Actor:
        """Somewhere else on the floor."""
        return replace(self, joints=self.joints + by, place=self.place + by)

    def at(self, frame: int) -> Moment:
        """The person in a frame."""
        none = torch.zeros(1, dtype=torch.long)
        worn = self.worn
        posed = pose(self.body, none, self.rotations[frame, None], worn.points, worn.normals, worn.bridge)
        extra = pose_extra(self.body, none, posed, worn.extra, worn.extra_segment)[0]
        extra_normals = pose_extra(self.body, none, posed, worn.extra_normals, worn.extra_segment, directions=True)[0]
        turn = self.turn[frame]
        lift = self.place[frame] - torch.tensor([0.0, 0.0, 1.0]) * self.floor[frame]
        hands = posed.origins[0, [SEGMENT["left_fingers"], SEGMENT["right_fingers"]]]
        values = torch.cat([self.colors, worn.dark[0, :, None].float()], 1)
        thing = torch.cat([self.thing_color, torch.zeros(1)]).expand(len(extra), -1)
        size = worn.carried_size[0]
        spacing = (2 * (size * size.roll(1)).sum() / N_THING).sqrt().clamp_min(SPACING)
        surfels = Surfels(
            torch.cat([posed.points[0], extra]),
            torch.cat([posed.normals[0], extra_normals]),
            torch.cat(
                [radii(posed.points[0], self.near, self._most), spacing.expand(N_THING), torch.full((N_BRIM,), 0.015)]
            ),
            torch.cat([values, thing]),
        )
        rotations = self.rotations[frame]
        return Moment(
            surfels.moved(turn, lift),
            self.joints[frame],
            turn @ rotations[SEGMENT["chest"]] @ torch.tensor([0.0, -1.0, 0.0]),
            (turn @ rotations[_HANDS] @ torch.tensor([0.0, 0.0, -1.0])),
            hands @ turn.T + lift,
        )


def make_actor(
    draw: Draw,
    bank: BodyBank,
    near: Int[Tensor, "p k"],
    rotations: Float[Tensor, "f 21 3 3"],
    activity: str,
    fps: float,
) -> Actor:
    """A random person of the bank in random clothes, who does what is given; the middle of the way is the origin."""
    body = bank.select(draw.integers(len(bank), 1))
    none = torch.zeros(1, dtype=torch.long)
    style = draw_style(body, none, draw.generator)
    worn = dress(body, none, draw.generator, style)
    colors, thing = person_colors(draw, body, style, worn)
    parts = [_skeleton(body, worn, part) for part in rotations.split(16)]
    joints, floor = (torch.cat(p) for p in zip(*parts, strict=True))
    # half of the people work roughly towards the camera, which stands at -y, where the body frame's person looks
    towards = bool(draw.chance(0.5, 1))
    yaw = 0.9 * draw.normal(1) if towards else draw.uniform(-torch.pi, torch.pi, 1)
    curve = draw.uniform(0.6, 1.2, 1) * (1.0 if bool(draw.chance(0.5, 1)) else -1.0)
    turn, place = walk(joints, yaw, curve, fps)
    world = (joints - floor[:, None, None] * torch.tensor([0.0, 0.0, 1.0])) @ turn.mT + place[:, None]
    middle = world.mean((0, 1)) * torch.tensor([1.0, 1.0, 0.0])
    return Actor(body, near, worn, colors, thing, rotations, world - middle, floor, turn, place - middle, activity)


def walk(
    joints: Float[Tensor, "f 18 3"], yaw: Float[Tensor, " 1"], curve: Float[Tensor, " 1"], fps: float
) -> tuple[Float[Tensor, "f 3 3"], Float[Tensor, "f 3"]]:
    """Turns and places of a body in the world, so that the foot that stands does not slide.

    joints: body frame. yaw: heading at the start. curve: radians turned per metre (nobody leaves the room).
    """
    ankles = joints[:, _ANKLES]
    lower = (ankles[:-1, :, 2] + ankles[1:, :, 2]).argmin(1)
    rows = torch.arange(len(lower))
    step = (ankles[:-1] - ankles[1:])[rows, lower, :2]
    length = step.norm(dim=1, keepdim=True)
    step = step * (_FASTEST / fps / length.clamp_min(1e-9)).clamp(max=1.0)
    heading = torch.cat([yaw, yaw + (curve * step.norm(dim=1)).cumsum(0)])
    turn = about_z(heading)
    world = (turn[1:, :2, :2] @ step[..., None])[..., 0]
    place = torch.zeros(len(joints), 3)
    place[1:, :2] = world.cumsum(0)
    return turn, place


def _skeleton(body: BodyBank, worn: Dressed, rotations: Float[Tensor, "b 21 3 3"]) -> tuple[Tensor, Tensor]:
    """(B, 18, 3) joints and (B,) height of the lowest point, body frame."""
    b = len(rotations)
    ids = torch.zeros(b, dtype=torch.long)
    full = (worn.points.expand(b, -1, -1), worn.normals.expand(b, -1, -1), worn.bridge.expand(b, -1))
    posed = pose(body, ids, rotations, *full)
    return posed.joints, posed.points[..., 2].amin(1)


class Motions:
    """Where postures and movements come from: our own sampler, or a folder of motion capture."""

    def __init__(self, activity: str | None = None, bvh: str | Path | None = None):
        if activity is not None and activity not in ACTIVITIES:
            raise UnderstudyError(f"activity {activity!r}: must be {one_of(ACTIVITIES)}")
        if activity is not None and bvh is not None:
            raise UnderstudyError("give either an activity or a folder of motion capture (bvh), not both")
        self.activity = activity
        self.files: Sequence[Path] = ()
        if bvh is not None:
            if not Path(bvh).is_dir():
                raise UnderstudyError(f"{bvh}: is not a folder")
            self.files = sorted(p for p in Path(bvh).rglob("*") if p.suffix.lower() == ".bvh" and p.is_file())
            if not self.files:
                raise UnderstudyError(f"{bvh}: holds no .bvh files")

    def draw(self, draw: Draw, frames: int, fps: float) -> tuple[Float[Tensor, "f 21 3 3"], str]:
        """A movement of `frames` frames and the name of what it is."""
        if self.files:
            path = self.files[int(draw.integers(len(self.files), 1))]
            return _clip(draw, path, frames, fps), "motion capture"
        if frames == 1:
            mix = None if self.activity is None else {self.activity: 1.0}
            drawn = sample_poses(1, draw.generator, mix=mix)
            return drawn.rotations, drawn.names[0]
        name = self.activity
        if name is None:
            shares = torch.tensor(list(ACTIVITIES.values())).cumsum(0)
            name = list(ACTIVITIES)[int(torch.bucketize(draw.uniform(0, float(shares[-1]), 1), shares))]
        return sequence(frames, draw.generator, name, fps), name


def _clip(draw: Draw, path: Path, frames: int, fps: float) -> Float[Tensor, "f 21 3 3"]:
    """A random part of a file; too short ones go to and fro."""
    bvh = read_bvh(path)
    step = max(1, round(1 / fps / bvh.frame_time_s))
    length = len(bvh.frames)
    first = int(draw.integers(max(1, length - frames * step + 1), 1))
    at = first + step * np.arange(frames)
    at = np.abs((at + length - 1) % max(1, 2 * (length - 1)) - (length - 1)) if length > 1 else 0 * at
    return torch.from_numpy(retarget(bvh, at))
