"""Network input with exact truth, as many as one wants: a batch is a function of the seed and the batch's number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.skeleton import JOINTS
from understudy.synthetic import render
from understudy.synthetic.bodies import BodyBank, pose, pose_extra
from understudy.synthetic.clothing import dress
from understudy.synthetic.detections import DetectorConfig, detect
from understudy.synthetic.draw import Draw
from understudy.synthetic.poses import NAMES, sample_poses
from understudy.synthetic.scene import Boxes, Cameras, SceneConfig, place_boxes, place_cameras
from understudy.synthetic.sensors import Rig
from understudy.voxels import CELL, CELLS, EMPTY, HALF, LIMIT

_SIZE = 144  # pixels of the simulated depth image: 2.06 cm at the root, with a rim for the baseline
_PITCH = CELL / 2  # metres of a pixel at the root
# By how much the first surface may be nearer than a joint that counts as seen, metres.
_LEAST_SEEN = 4  # joints that the camera must see of a person
_DEEP = {"nose": 0.06, "eye": 0.06, "ear": 0.06, "neck": 0.17, "hip": 0.2}
_INSIDE = torch.tensor([_DEEP.get(n.split("_")[-1], 0.12) for n in JOINTS])


class Batch(NamedTuple):
    """Input of the network, and truth; in view coordinates (understudy.voxels)."""

    depth: Float[Tensor, "b 2 64 64"]
    keypoints: Float[Tensor, "b 18 3"]
    """x, y (metres), score"""
    root_z: Float[Tensor, "b 1"]
    joints: Float[Tensor, "b 18 3"]
    """truth"""
    in_view: Bool[Tensor, "b 18"]
    """inside the colour image"""
    occluded: Bool[Tensor, "b 18"]
    hard: Bool[Tensor, "b"]
    """not frontal, or something before the person"""
    tag: Tensor
    """(b, 2) int: sensor, activity"""


@dataclass(frozen=True)
class SampleConfig:
    """What decides the samples, besides the bodies."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensors: tuple[str, ...] = ("kinect2", "azure", "realsense", "other")
    activities: dict[str, float] | None = None
    """shares; None: the defaults of understudy.synthetic.poses"""


class Samples:
    """Batches of simulated people, the same ones for the same seed."""

    def __init__(self, bank: BodyBank, config: SampleConfig | None = None, seed: int = 0, poses: Tensor | None = None):
        """poses: (m, 21, 3, 3) to draw from (motion capture) in place of sampled ones."""
        self.bank, self.config, self.seed, self.poses = bank, config or SampleConfig(), seed, poses
        self.device = bank.points.device

    def stream(self, size: int, start: int = 0) -> Iterator[Batch]:
        """Batches without end, from number `start`."""
        while True:
            yield self.batch(start, size)
            start += 1

    @torch.no_grad()
    def batch(self, number: int, size: int) -> Batch:
        """Batch `number`."""
        draw = Draw((self.seed * 1_000_003 + number) % 2**63, self.device)
        people = self._people(draw, size)
        cameras = place_cameras(draw, self.config.scene, people["joints"])
        boxes = place_boxes(draw, self.config.scene, cameras, people["joints"], people["sits"])
        others = self._others(draw, people, cameras)
        rig = Rig(draw, self.config.sensors, size)
        return self._observe(draw, people, others, cameras, boxes, rig)

    def _people(self, draw: Draw, b: int) -> dict[str, Any]:
        """Posed bodies on the floor at the world's origin, turned at random."""
        ids = draw.integers(len(self.bank.points), b)
        if self.poses is None:
            drawn = sample_poses(b, draw.generator, device=str(self.device), mix=self.config.activities)
            rotations, activity = drawn.rotations, drawn.activity
            sits = activity == NAMES.index("sitting")
        else:
            rotations = self.poses[draw.integers(len(self.poses), b)]
            activity = torch.zeros(b, dtype=torch.long, device=self.device)
            sits = activity > 0
        worn = dress(self.bank, ids, draw.generator)
        posed = pose(self.bank, ids, rotations, worn.points, worn.normals, worn.bridge)
        extra = pose_extra(self.bank, ids, posed, worn.extra, worn.extra_segment)
        # the camera stands at -y, where a person who is not turned looks; half of the people work roughly towards it
        yaw = torch.where(draw.chance(0.5, b), 0.9 * draw.normal(b), draw.uniform(-torch.pi, torch.pi, b))
        turn = _about_z(yaw)
        floor = torch.zeros(b, 1, 3, device=self.device)
        floor[:, 0, 2] = posed.points[..., 2].amin(1)
        middle = posed.joints.mean(1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0], device=self.device)

        def put(p: Tensor) -> Tensor:
            return (p - floor - middle) @ turn.transpose(1, 2)

        facing = (turn @ rotations[:, 2] @ torch.tensor([0.0, -1.0, 0.0], device=self.device))
        return {
            "points": torch.cat([put(posed.points), put(extra)], 1),
            "normals": posed.normals @ turn.transpose(1, 2),
            "dark": torch.cat([worn.dark, torch.zeros_like(extra[..., 0], dtype=torch.bool)], 1),
            "joints": put(posed.joints),
            "sits": sits,
            "activity": activity,
            "facing": facing,
        }

    def _others(self, draw: Draw, people: dict[str, Any], cameras: Cameras) -> list[dict[str, Tensor]]:
        """Other people of the batch, put beside each main person: up to two, as points and joints in the world."""
        b = len(people["joints"])
        out = []
        for k in (1, 2):
            roll = (torch.arange(b, device=self.device) + k) % b
            angle = draw.uniform(-torch.pi, torch.pi, b)
            away = draw.uniform(0.45, 1.6, b)
            place = torch.stack([away * angle.sin() * 1.2, away * angle.cos(), torch.zeros_like(away)], -1)
            turn = _about_z(draw.uniform(-torch.pi, torch.pi, b))
            share = self.config.scene.neighbours * (1.0 if k == 1 else 0.3)
            here = draw.chance(share, b) & (place[:, 1] > 0.7 - cameras.center[:, 1].abs())
            joints = people["joints"][roll] @ turn.transpose(1, 2) + place[:, None]
            # not inside the main person: trunks are kept apart
            here &= (joints[:, 1] - people["joints"][:, 1])[:, :2].norm(dim=-1) > 0.35
            gone = torch.where(here, 0.0, torch.nan)[:, None, None]
            points = people["points"][roll, ::2] @ turn.transpose(1, 2) + place[:, None] + gone
            out.append({"points": points, "joints": joints + gone, "dark": people["dark"][roll, ::2]})
        return out

    def _observe(
        self, draw: Draw, people: dict[str, Any], others: list[dict[str, Tensor]], cameras: Cameras, boxes: Boxes, rig: Rig
    ) -> Batch:
        b = len(people["joints"])
        joints_cam = cameras.to_cam(people["joints"])
        in_view = rig.seen_by(rig.color_tan, joints_cam) & (joints_cam[..., 2] > 0.15)
        center, root_z = _root(draw, joints_cam, in_view)
        R = _rotation_to(center)  # R_view_cam

        joints = joints_cam @ R.transpose(1, 2)
        view = _columns(joints, root_z)

        # depth, from the depth camera's place, in a raster a little larger than the grid
        scale = root_z / _PITCH
        towards = (people["normals"] * (people["points"][:, : people["normals"].shape[1]] - cameras.center[:, None])).sum(-1)
        away = torch.zeros_like(people["dark"])
        away[:, : towards.shape[1]] = towards > 0
        hidden_side = torch.where(away, torch.nan, 0.0)[..., None]  # a body's far side cannot show through its near one
        points = torch.cat([people["points"] + hidden_side, *(o["points"] for o in others)], 1)
        dark = torch.cat([people["dark"], *(o["dark"] for o in others)], 1)
        offset = (R @ rig.baseline[..., None])[..., 0]  # the depth camera's place in the view's frame
        points_view = cameras.to_cam(points) @ R.transpose(1, 2) - offset[:, None]
        z, dark_seen = render.splat(points_view, dark, scale, _SIZE)
        rays = render.pixel_rays(scale, _SIZE)
        z_boxes = self._boxes(cameras, boxes, R, offset, scale)
        exact = torch.minimum(z, z_boxes)
        dark_seen &= z <= z_boxes
        occluded, before = _occluded(joints - offset[:, None], exact, z, scale)

        measured = rig.degrade(draw, exact, dark_seen)
        directions = rays.reshape(b, -1, 3)
        in_cam = directions @ R
        seen = rig.seen_by(rig.depth_tan, in_cam, rig.pitch)
        cloud = directions * measured.reshape(b, -1, 1) + offset[:, None]
        ok = seen & (measured.reshape(b, -1) > 0) & rig.seen_by(rig.color_tan, cloud @ R)
        depth = _depth_grid(cloud, ok, root_z)

        other = others[0]["joints"]
        other_xy = _columns(cameras.to_cam(other) @ R.transpose(1, 2), root_z)[..., :2]
        to_camera = torch.nn.functional.normalize(cameras.center, dim=-1)
        front = (people["facing"] * to_camera).sum(-1)
        keypoints = detect(
            draw, self.config.detector, view[..., :2], root_z, occluded, in_view, front < -0.3, other_xy
        )
        hard = (front < 0.7) | before
        tag = torch.stack([rig.kind, people["activity"].to(rig.kind.dtype)], -1)
        batch = Batch(depth, keypoints, root_z[:, None], view, in_view, occluded, hard, tag)
        return _detectable(batch)

    def _boxes(self, cameras: Cameras, boxes: Boxes, R: Tensor, offset: Tensor, scale: Tensor) -> Tensor:
        """Depth of the furniture at half the resolution, doubled."""
        rays = render.pixel_rays(scale / 2, _SIZE // 2)
        b = len(R)
        flat = rays.reshape(b, -1, 3)
        origin = cameras.center + ((offset[:, None] @ R) @ cameras.R_cam_world)[:, 0]
        z = render.cast(boxes, origin, render.to_world(cameras, R, flat))
        z = z.reshape(b, 1, _SIZE // 2, _SIZE // 2)
        return torch.nn.functional.interpolate(z, scale_factor=2, mode="nearest")[:, 0]


def _detectable(batch: Batch) -> Batch:
    """People of whom a detector sees nearly nothing give their place to the next one who is seen."""
    seen = (batch.in_view & ~batch.occluded).sum(1) >= _LEAST_SEEN
    number = torch.arange(len(seen), device=seen.device)
    after = (number[None] - number[:, None]) % len(seen) + torch.where(seen, 0, 2 * len(seen))[None]
    chosen = after.argmin(1)
    return Batch(*(t[chosen] for t in batch))


def _about_z(angle: Tensor) -> Tensor:
    c, s, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 3, 3)


def _rotation_to(direction: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """As understudy.voxels.rotation_to, for a batch."""
    x, y, z = torch.nn.functional.normalize(direction, dim=-1).unbind(-1)
    k = 1 / (1 + z)
    rows = [1 - k * x * x, -k * x * y, -x, -k * x * y, 1 - k * y * y, -y, x, y, z]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def _columns(p: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b"]) -> Float[Tensor, "b n 3"]:
    """View's frame -> view coordinates."""
    z = p[..., 2:].clamp_min(0.1)
    return torch.cat([p[..., :2] / z * root_z[:, None, None], z - root_z[:, None, None]], -1)


def _root(draw: Draw, joints: Float[Tensor, "b 18 3"], in_view: Bool[Tensor, "b 18"]) -> tuple[Tensor, Tensor]:
    """Direction of the view's axis and the root's depth, with the errors that they have in practice."""
    b = len(joints)
    neck, hips = joints[:, 1], (joints[:, 8] + joints[:, 11]) / 2
    no_hips = ~(in_view[:, 8] | in_view[:, 11]) | draw.chance(0.08, b)
    no_neck = ~in_view[:, 1] | draw.chance(0.03, b)
    down = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 0.0], device=joints.device), dim=0)
    low = torch.where(no_hips[:, None], neck + 0.5 * down, hips)
    high = torch.where((no_neck & ~no_hips)[:, None], hips - 0.5 * down, neck)
    center = (low + high) / 2
    sigma = torch.where(draw.chance(0.15, b), 0.15, 0.03)[:, None]
    center = center + sigma * draw.normal(b, 3)
    z_sigma = torch.where(draw.chance(0.12, b), 0.2, 0.05)
    root_z = center.norm(dim=-1) - 0.08 + z_sigma * draw.normal(b)
    return center, root_z.clamp_min(0.4)


def _occluded(
    joints: Float[Tensor, "b 18 3"], exact: Float[Tensor, "b s s"], people: Float[Tensor, "b s s"], scale: Float[Tensor, "b"]
) -> tuple[Bool[Tensor, "b 18"], Bool[Tensor, "b"]]:
    """Which joints have a surface clearly before them, and whether furniture is before several of a person's joints."""
    b, s = len(joints), exact.shape[-1]
    z = joints[..., 2].clamp_min(0.1)
    uv = (joints[..., :2] / z[..., None] * scale[:, None, None] + s / 2).floor().long()
    inside = ((uv >= 0) & (uv < s)).all(-1)
    index = torch.where(inside, uv[..., 1] * s + uv[..., 0], 0)
    surface = exact.reshape(b, -1).gather(1, index)
    person = people.reshape(b, -1).gather(1, index)
    limit = _INSIDE.to(z.device)
    thing = inside & (surface < person - 0.01) & (surface < z - 0.03)
    occluded = thing | (inside & (surface < z - limit))
    return occluded, thing.sum(-1) >= 3


def _depth_grid(cloud: Float[Tensor, "b n 3"], ok: Bool[Tensor, "b n"], root_z: Float[Tensor, "b"]) -> Float[Tensor, "b 2 64 64"]:
    """As `PersonView.depth_grid`, for a batch of clouds in the view's frame."""
    b = len(cloud)
    z = cloud[..., 2]
    cell = cloud[..., :2] * (root_z[:, None] / CELL / z.clamp_min(0.1))[..., None] + CELLS // 2
    ok = ok & (z > 0.1) & (cell >= 0).all(-1) & (cell < CELLS).all(-1)
    index = torch.where(ok, cell[..., 1].int() * CELLS + cell[..., 0].int(), 0).long()
    depth = z - root_z[:, None]
    near = torch.full((b, CELLS * CELLS), EMPTY, device=cloud.device)
    near.scatter_reduce_(1, index, torch.where(ok, depth.clamp(-LIMIT, LIMIT), EMPTY), "amin")
    within = ok & (depth.abs() < HALF)
    far = torch.full_like(near, -EMPTY)
    far.scatter_reduce_(1, index, torch.where(within, depth, -EMPTY), "amax")
    far = torch.where(far > -EMPTY, far, EMPTY)
    return torch.stack([near, far], 1).reshape(b, 2, CELLS, CELLS)
