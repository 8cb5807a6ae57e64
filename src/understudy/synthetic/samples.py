"""Network input with exact truth, as many as one wants: a batch is a function of the seed and the batch's number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.skeleton import JOINTS
from understudy.synthetic import render, view
from understudy.synthetic.bodies import BodyBank, pose, pose_extra
from understudy.synthetic.clothing import dress
from understudy.synthetic.detections import DetectorConfig, detect
from understudy.synthetic.draw import Draw
from understudy.synthetic.furniture import FLOOR, place_boxes
from understudy.synthetic.poses import NAMES, sample_poses
from understudy.synthetic.scene import Boxes, Cameras, SceneConfig, about_z, place_cameras
from understudy.synthetic.sensors import Rig
from understudy.voxels import CELL

_SIZE: Final = 144
"""Pixels of the simulated depth image: 2.06 cm at the root, with a rim for the baseline."""
_PITCH: Final = CELL / 2
"""Metres of a pixel at the root."""
LEAST_SEEN: Final = 4
"""Joints that the camera must see of a person."""
_REACH: Final = 0.6
"""Metres by which a person's middle must be nearer than the farthest depth of the sensor."""
_CAMERAS: Final = 3
"""How often a camera is drawn, at most, until it sees the person."""
FROM_BEHIND: Final = -0.3
"""Cosine between where somebody faces and the camera, below which they turn their back."""
_FRONTAL = 0.7  # the same: above, a person is frontal
_DEEP = {"nose": 0.06, "eye": 0.06, "ear": 0.06, "neck": 0.17, "hip": 0.2}
_INSIDE = torch.tensor([_DEEP.get(n.split("_")[-1], 0.12) for n in JOINTS])
"""By how much the first surface may be nearer than a joint that counts as seen, metres."""


class Batch(NamedTuple):
    """Input of the network, and truth; in view coordinates (understudy.voxels), metres."""

    depth: Float[Tensor, "b 2 64 64"]
    """nearest and farthest depth of each column; see `PersonView.depth_grid`"""
    keypoints: Float[Tensor, "b 18 3"]
    """x, y (metres), score; (0, 0, 0) where not found"""
    root_z: Float[Tensor, "b 1"]
    """distance of the grid's centre from the camera"""
    floor: Float[Tensor, "b 4"]
    """as measured; zeros where it is not known; see `PersonView.floor_plane`"""
    joints: Float[Tensor, "b 18 3"]
    """truth"""
    in_view: Bool[Tensor, "b 18"]
    """inside the colour image"""
    occluded: Bool[Tensor, "b 18"]
    """hidden from the camera by a thing, another person or the body itself"""
    hard: Bool[Tensor, " b"]
    """not frontal, or something before the person"""
    tag: Int[Tensor, "b 2"]
    """sensor (number in `SampleConfig.sensors`), activity (number in `poses.NAMES`)"""


@dataclass(frozen=True)
class SampleConfig:
    """What decides the samples, besides the bodies."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensors: tuple[str, ...] = ("kinect2", "azure", "realsense", "other")
    activities: dict[str, float] | None = None
    """shares; None: the defaults of understudy.synthetic.poses"""


@dataclass(frozen=True)
class People:
    """B people who stand on the floor at the world's origin; metres."""

    points: Float[Tensor, "b n 3"]
    """of the body, then of what is carried (NaN where absent)"""
    normals: Float[Tensor, "b p 3"]
    """of the body's points; p < n"""
    dark: Bool[Tensor, "b n"]
    """returns little light to a depth camera"""
    joints: Float[Tensor, "b 18 3"]
    sits: Bool[Tensor, " b"]
    activity: Int[Tensor, " b"]
    facing: Float[Tensor, "b 3"]
    """unit vector: where the chest looks"""


@dataclass(frozen=True)
class Neighbours:
    """Other people beside each person; in the world. NaN where there is nobody."""

    points: Float[Tensor, "b n 3"]
    joints: Float[Tensor, "b 18 3"]
    dark: Bool[Tensor, "b n"]


class Samples:
    """Batches of simulated people, the same ones for the same seed."""

    def __init__(self, bank: BodyBank, config: SampleConfig | None = None, seed: int = 0, poses: Tensor | None = None):
        """poses: (m, 21, 3, 3) to draw from (motion capture) in place of sampled ones."""
        self.bank, self.config, self.seed, self.poses = bank, config or SampleConfig(), seed, poses
        self.device = bank.device

    def stream(self, size: int, start: int = 0) -> Iterator[Batch]:
        """Batches without end, from number `start`."""
        while True:
            yield self.batch(start, size)
            start += 1

    @torch.no_grad()
    def batch(self, number: int, size: int) -> Batch:
        """Batch `number`: of somewhat more people, the first `size` that a detector would find."""
        b = size + 1 + size // 32
        draw = Draw((self.seed * 1_000_003 + number) % 2**63, self.device)
        people = self.people(draw, b)
        rig = Rig(draw, self.config.sensors, b)
        cameras = self._cameras(draw, people, rig)
        boxes = place_boxes(draw, self.config.scene, cameras, people.joints, people.sits)
        boxes = unhiding(boxes, cameras, rig, people.joints)
        others = self._others(draw, people, cameras)
        return _detectable(self._observe(draw, people, others, cameras, boxes, rig), size)

    def _cameras(self, draw: Draw, people: People, rig: Rig) -> Cameras:
        """Cameras that see enough of the main person, no farther than the depth camera measures."""

        def drawn() -> Cameras:
            return place_cameras(draw, self.config.scene, people.joints, rig.max_z - _REACH)

        cameras = drawn()
        for _ in range(_CAMERAS - 1):
            enough = rig.in_color(cameras.to_cam(people.joints)).sum(1) > LEAST_SEEN
            cameras = cameras.where(enough, drawn())
        return cameras

    def people(self, draw: Draw, b: int) -> People:
        """Posed bodies on the floor at the world's origin, turned at random."""
        ids = draw.integers(len(self.bank), b)
        if self.poses is None:
            drawn = sample_poses(b, draw.generator, device=str(self.device), mix=self.config.activities)
            rotations, activity = drawn.rotations, drawn.activity
            sits = activity == NAMES.index("sitting")
        else:
            rotations = self.poses.to(self.device)[draw.integers(len(self.poses), b)]
            activity = torch.zeros(b, dtype=torch.long, device=self.device)
            sits = activity > 0
        worn = dress(self.bank, ids, draw.generator)
        posed = pose(self.bank, ids, rotations, worn.points, worn.normals, worn.bridge)
        extra = pose_extra(self.bank, ids, posed, worn.extra, worn.extra_segment)
        # the camera stands at -y, where a person who is not turned looks; half of the people work roughly towards it
        yaw = torch.where(draw.chance(0.5, b), 0.9 * draw.normal(b), draw.uniform(-torch.pi, torch.pi, b))
        turn = about_z(yaw)
        floor = torch.zeros(b, 1, 3, device=self.device)
        floor[:, 0, 2] = posed.points[..., 2].amin(1)
        middle = posed.joints.mean(1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0], device=self.device)

        def put(p: Tensor) -> Tensor:
            return (p - floor - middle) @ turn.transpose(1, 2)

        return People(
            points=torch.cat([put(posed.points), put(extra)], 1),
            normals=posed.normals @ turn.transpose(1, 2),
            dark=torch.cat([worn.dark, torch.zeros_like(extra[..., 0], dtype=torch.bool)], 1),
            joints=put(posed.joints),
            sits=sits,
            activity=activity,
            facing=turn @ rotations[:, 2] @ torch.tensor([0.0, -1.0, 0.0], device=self.device),
        )

    def _others(self, draw: Draw, people: People, cameras: Cameras) -> list[Neighbours]:
        """Other people of the batch, put beside each main person: up to two."""
        b = len(people.joints)
        out = []
        for k in (1, 2):
            roll = (torch.arange(b, device=self.device) + k) % b
            angle = draw.uniform(-torch.pi, torch.pi, b)
            away = draw.uniform(0.45, 1.6, b)
            place = torch.stack([away * angle.sin() * 1.2, away * angle.cos(), torch.zeros_like(away)], -1)
            turn = about_z(draw.uniform(-torch.pi, torch.pi, b))
            share = self.config.scene.neighbours * (1.0 if k == 1 else 0.3)
            here = draw.chance(share, b) & (place[:, 1] > 0.7 - cameras.center[:, 1].abs())
            joints = people.joints[roll] @ turn.transpose(1, 2) + place[:, None]
            # not inside the main person: trunks are kept apart
            here &= (joints[:, 1] - people.joints[:, 1])[:, :2].norm(dim=-1) > 0.35
            gone = torch.where(here, 0.0, torch.nan)[:, None, None]
            points = people.points[roll, ::2] @ turn.transpose(1, 2) + place[:, None] + gone
            out.append(Neighbours(points, joints + gone, people.dark[roll, ::2]))
        return out

    def _observe(
        self, draw: Draw, people: People, others: list[Neighbours], cameras: Cameras, boxes: Boxes, rig: Rig
    ) -> Batch:
        """What depth camera and detector say of the main people."""
        joints_cam = cameras.to_cam(people.joints)
        in_view = rig.in_color(joints_cam)
        center, root_z = view.draw_root(draw, joints_cam, in_view, rig.seen_by(rig.depth_tan, joints_cam, rig.pitch))
        R = view.rotation_to(center)  # R_view_cam
        joints = joints_cam @ R.transpose(1, 2)
        columns = view.columns(joints, root_z)

        # depth, from the depth camera's place, in a raster a little larger than the grid
        scale = root_z / _PITCH
        offset = (R @ rig.baseline[..., None])[..., 0]  # the depth camera's place in the view's frame
        z, dark = _splatted(people, others, cameras, R, offset, scale)
        z_boxes = _boxes_depth(cameras, boxes, R, offset, scale)
        exact = torch.minimum(z, z_boxes)
        dark &= z <= z_boxes
        occluded, before = _occluded(joints - offset[:, None], exact, z, scale)
        depth = _measured(draw, rig, exact, dark, R, offset, root_z, scale)

        other = cameras.to_cam(others[0].joints) @ R.transpose(1, 2)
        front = (people.facing * torch.nn.functional.normalize(cameras.center, dim=-1)).sum(-1)
        keypoints = detect(
            draw,
            self.config.detector,
            columns[..., :2],
            root_z,
            occluded,
            in_view,
            front < FROM_BEHIND,
            view.columns(other, root_z)[..., :2],
        )
        hard = (front < _FRONTAL) | before
        tag = torch.stack([rig.kind, people.activity.to(rig.kind.dtype)], -1)
        floor = view.draw_floor(draw, R @ cameras.R_cam_world, cameras.center)
        return Batch(depth, keypoints, root_z[:, None], floor, columns, in_view, occluded, hard, tag)


def hidden_joints(
    surface: Float[Tensor, "b 18"], person: Float[Tensor, "b 18"], z: Float[Tensor, "b 18"]
) -> tuple[Bool[Tensor, "b 18"], Bool[Tensor, "b 18"]]:
    """Which joints do not count as seen, and before which of them a thing stands.

    surface: depth of the first surface in the direction of each joint; person: of the first person's surface; z: of the
    joint; metres, from one camera.
    """
    thing = (surface < person - 0.01) & (surface < z - 0.03)
    return thing | (surface < z - _INSIDE.to(z.device)), thing


def _splatted(
    people: People, others: list[Neighbours], cameras: Cameras, R: Tensor, offset: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """(B, s, s) depth of all people (metres) and whether it is dark there."""
    body = people.normals.shape[1]
    towards = (people.normals * (people.points[:, :body] - cameras.center[:, None])).sum(-1)
    away = torch.zeros_like(people.dark)
    away[:, :body] = towards > 0
    hidden_side = torch.where(away, torch.nan, 0.0)[..., None]  # a body's far side cannot show through its near one
    points = torch.cat([people.points + hidden_side, *(o.points for o in others)], 1)
    dark = torch.cat([people.dark, *(o.dark for o in others)], 1)
    points_view = cameras.to_cam(points) @ R.transpose(1, 2) - offset[:, None]
    return render.splat(points_view, dark, scale, _SIZE)


def _boxes_depth(cameras: Cameras, boxes: Boxes, R: Tensor, offset: Tensor, scale: Tensor) -> Tensor:
    """(B, s, s) depth of the furniture at half the resolution, doubled; metres."""
    rays = render.pixel_rays(scale / 2, _SIZE // 2)
    b = len(R)
    flat = rays.reshape(b, -1, 3)
    origin = cameras.center + ((offset[:, None] @ R) @ cameras.R_cam_world)[:, 0]
    z = render.cast(boxes, origin, render.to_world(cameras, R, flat))
    z = z.reshape(b, 1, _SIZE // 2, _SIZE // 2)
    return torch.nn.functional.interpolate(z, scale_factor=2, mode="nearest")[:, 0]


def _measured(
    draw: Draw, rig: Rig, exact: Tensor, dark: Tensor, R: Tensor, offset: Tensor, root_z: Tensor, scale: Tensor
) -> Tensor:
    """(B, 2, 64, 64) depth grid of what the sensors make of exact depth, inside of both cameras' images."""
    b = len(exact)
    measured = rig.degrade(draw, exact, dark).reshape(b, -1)
    directions = render.pixel_rays(scale, _SIZE).reshape(b, -1, 3)
    seen = rig.seen_by(rig.depth_tan, directions @ R, rig.pitch)
    cloud = directions * measured[..., None] + offset[:, None]
    ok = seen & (measured > 0) & rig.seen_by(rig.color_tan, cloud @ R)
    return view.depth_grid(cloud, ok, root_z)


def unhiding(boxes: Boxes, cameras: Cameras, rig: Rig, joints: Float[Tensor, "b 18 3"]) -> Boxes:
    """Without the furniture that stands before people of whom hardly anything would be seen."""
    distance, which = render.cast_which(boxes, cameras.center, joints - cameras.center[:, None])
    hit = distance < 0.97
    lost = (rig.in_color(cameras.to_cam(joints)) & ~hit).sum(1, keepdim=True) <= LEAST_SEEN
    number = torch.arange(boxes.yaw.shape[1], device=joints.device)
    gone = ((which[..., None] == number) & (hit & lost)[..., None]).any(1)
    gone[:, FLOOR] = False
    return boxes.without(gone)


def _detectable(batch: Batch, size: int) -> Batch:
    """The first `size` people of whom a detector sees enough; others only when there are not as many."""
    unseen = (batch.in_view & ~batch.occluded).sum(1) < LEAST_SEEN
    chosen = torch.argsort(unseen.int(), stable=True)[:size]
    return Batch(*(t[chosen] for t in batch))


def _occluded(
    joints: Float[Tensor, "b 18 3"],
    exact: Float[Tensor, "b s s"],
    people: Float[Tensor, "b s s"],
    scale: Float[Tensor, " b"],
) -> tuple[Bool[Tensor, "b 18"], Bool[Tensor, " b"]]:
    """Which joints have a surface clearly before them, and whether furniture is before several of a person's joints.

    Judged from the depth camera, whose exact image there is; the colour camera is at most 8 cm beside it.

    joints: depth camera's place, view's axes. exact, people: depth of everything, and of people only. Metres.
    """
    b, s = len(joints), exact.shape[-1]
    z = joints[..., 2].clamp_min(0.1)
    uv = (joints[..., :2] / z[..., None] * scale[:, None, None] + s / 2).floor().long()
    inside = ((uv >= 0) & (uv < s)).all(-1)
    index = torch.where(inside, uv[..., 1] * s + uv[..., 0], 0)
    surface = exact.reshape(b, -1).gather(1, index)
    person = people.reshape(b, -1).gather(1, index)
    hidden, thing = hidden_joints(surface, person, z)
    return inside & hidden, (inside & thing).sum(-1) >= 3
