"""Depth crops of simulated hands with exact palms: batch `i` is a function of the seed and of `i`.

Everything is a right hand: left hands are seen in the mirror. Coordinates are those of the hand's *crop view*: origin in
the colour camera, z through the place where the hand is believed to be, y as near as possible along the believed
forearm towards the elbow (so fingers that go on from the forearm point to -y), x = y x z. Metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic import render, view
from understudy.synthetic.bodies import BodyBank, pose
from understudy.synthetic.clothing import dress
from understudy.synthetic.draw import Draw
from understudy.synthetic.furniture import place_boxes
from understudy.synthetic.hand_bank import HandBank, articulate, palm_normals
from understudy.synthetic.poses import NAMES, sample_poses
from understudy.synthetic.scene import Cameras, SceneConfig, about_z, place_cameras
from understudy.synthetic.segments import SEGMENT
from understudy.synthetic.sensors import SENSORS, Rig

CELLS: Final = 48
HALF: Final = 0.18
"""metres at the crop's distance: half the edge of the depth crop"""
CELL: Final = 2 * HALF / CELLS
EMPTY: Final = 1.0
"""depth of cells without a measurement"""
LIMIT: Final = 0.2
"""metres: depths are cut off so far from the crop's distance"""
CONTEXT: Final = ("wrist", "elbow", "shoulder", "other_shoulder", "neck", "hips", "nose")
"""Joints whose places the network is given, relative to the crop's centre; the hand's own side first"""

_RASTER = 80
_FINE = 0.005  # metres of a raster's pixel at the hand
_COARSE = 4  # the body's raster is so many times coarser
_BEYOND = 0.07  # metres from the wrist along the forearm to the crop's centre
_CUT = 0.06  # metres: points of the coarse body nearer to the detailed hand than this are left out
_SIDES = ("right", "left")
_ROWS = {
    "right": [JOINT[n] for n in ("right_wrist", "right_elbow", "right_shoulder", "left_shoulder", "neck", "nose")],
    "left": [JOINT[n] for n in ("left_wrist", "left_elbow", "left_shoulder", "right_shoulder", "neck", "nose")],
}
_HIPS = [JOINT["right_hip"], JOINT["left_hip"]]


class HandBatch(NamedTuple):
    """Input of the hand network, and truth."""

    depth: Float[Tensor, "b 2 48 48"]
    """nearest depth of each cell relative to the crop's distance (metres; EMPTY where none), and 1 where measured"""
    context: Float[Tensor, "b 7 3"]
    """CONTEXT, relative to the crop's centre, with the errors that estimates have"""
    distance: Float[Tensor, "b 1"]
    normal: Float[Tensor, "b 3"]
    """truth: unit, out of the palm"""
    direction: Float[Tensor, "b 3"]
    """truth: unit, from the wrist to the middle knuckle"""
    landmarks: Float[Tensor, "b 21 3"]
    """truth, relative to the crop's centre"""
    in_view: Bool[Tensor, " b"]
    """the wrist and most of the hand are in the colour image"""
    visible: Float[Tensor, " b"]
    """share of the hand's near surface that the camera sees"""
    pixels: Float[Tensor, " b"]
    """size of the hand (0.19 m) in pixels of the depth camera"""
    grip: Int[Tensor, " b"]
    """0 free, 1 grips a bar, 2 holds a flat thing"""


@dataclass(frozen=True)
class HandConfig:
    """What decides the samples, besides bodies and hands."""

    scene: SceneConfig = field(default_factory=lambda: SceneConfig(furniture=2, occluder=0.15, neighbours=0.0))
    sensors: tuple[str, ...] = tuple(SENSORS)
    grip: float = 0.3
    """share of hands that hold something"""
    wrist_m: float = 0.025
    """one sigma of the estimated wrist along each axis; a fifth of them three times as much"""
    joint_m: float = 0.04
    """the same of the other joints"""


class HandSamples:
    """Batches of simulated hands, the same ones for the same seed."""

    def __init__(self, bodies: BodyBank, hands: HandBank, config: HandConfig | None = None, seed: int = 0):
        self.bodies, self.hands, self.config, self.seed = bodies, hands, config or HandConfig(), seed
        self._keep = torch.arange(0, bodies.points.shape[1], 2)
        self._limb = {
            side: (bodies.weights[:, [SEGMENT[f"{side}_hand"], SEGMENT[f"{side}_fingers"]]].sum(1) > 0.2)
            | ((bodies.segment == SEGMENT[f"{side}_forearm"]) & (bodies.along > 0.45))
            for side in _SIDES
        }

    @torch.no_grad()
    def batch(self, number: int, size: int) -> HandBatch:
        """Batch `number`: size hands, the right and the left ones of size / 2 people."""
        draw = Draw((self.seed * 1_000_003 + number) % 2**63)
        b = (size + 1) // 2
        ids = draw.integers(len(self.bodies), b)
        drawn = sample_poses(b, draw.generator)
        worn = dress(self.bodies, ids, draw.generator)
        posed = pose(self.bodies, ids, drawn.rotations, worn.points, worn.normals, worn.bridge)
        yaw = torch.where(draw.chance(0.5, b), 0.9 * draw.normal(b), draw.uniform(-torch.pi, torch.pi, b))
        turn = about_z(yaw)
        floor = torch.zeros(b, 1, 3)
        floor[:, 0, 2] = posed.points[..., 2].amin(1)
        middle = posed.joints.mean(1, keepdim=True) * torch.tensor([1.0, 1.0, 0.0])
        joints = (posed.joints - floor - middle) @ turn.mT
        points = (posed.points - floor - middle) @ turn.mT
        rig = Rig(draw, self.config.sensors, b)
        cameras = place_cameras(draw, self.config.scene, joints, rig.max_z - 0.6)
        boxes = place_boxes(draw, self.config.scene, cameras, joints, drawn.activity == NAMES.index("sitting"))
        sides = [
            self._hands(draw, side, cameras, rig, boxes, turn[:, None] @ drawn.rotations, joints, points, drawn.rotations)
            for side in _SIDES
        ]
        return HandBatch(*(torch.cat(pair)[:size] for pair in zip(*sides, strict=True)))

    def _hands(self, draw, side, cameras, rig, boxes, world, joints, points, rotations) -> HandBatch:  # type: ignore[no-untyped-def]
        """One hand of everybody."""
        b = len(joints)
        sign = 1.0 if side == "right" else -1.0
        mirror = torch.tensor([sign, 1.0, 1.0])  # the left hand is looked at in a mirror
        rows = _ROWS[side]
        known = torch.cat([joints[:, rows[:5]], joints[:, _HIPS].mean(1, keepdim=True), joints[:, rows[5:]]], 1)
        known_cam = cameras.to_cam(known) * mirror
        wrist = known_cam[:, 0]

        # the hand, posed: canonical hands point along -x (right) or x (left), palms down
        R_hand = world[:, SEGMENT[f"{side}_hand"]]
        x = (cameras.R_cam_world @ R_hand)[..., 0] * -sign * mirror
        z = -(cameras.R_cam_world @ R_hand)[..., 2] * mirror
        frame = torch.stack([x, torch.linalg.cross(z, x), z], -1)
        curl = _curl(rotations, side)
        flex, spread, grip, radius = self._grips(draw, curl, b)
        hand_ids = draw.integers(len(self.hands), b)
        hand = articulate(self.hands, hand_ids, flex, spread)
        things = _things(draw, grip, radius, hand.landmarks)
        place = frame.mT
        skin = hand.points @ place + wrist[:, None]
        normals = hand.normals @ place
        held = things @ place + wrist[:, None]
        marks = hand.landmarks @ place + wrist[:, None]

        # what is believed of the body
        noisy = self._believed(draw, known_cam)
        forearm = torch.nn.functional.normalize(noisy[:, 0] - noisy[:, 1], dim=1)
        center = noisy[:, 0] + _BEYOND * forearm
        R = crop_rotation(center, -forearm)
        distance = center.norm(dim=1)

        # what the depth camera sees
        scale = distance / _FINE
        eye = rig.baseline * mirror  # the depth camera's place
        offset = (R @ eye[..., None])[..., 0]
        to_view = R.mT
        away = ((normals * (skin - eye[:, None])).sum(-1) > 0)[..., None]
        detail = torch.cat([skin + torch.where(away, torch.nan, 0.0), held], 1) @ to_view - offset[:, None]
        z_fine, label = render.splat(detail, _labels(skin, held), scale, _RASTER)
        gone = torch.where(self._limb[side][self._keep], torch.nan, 0.0)[:, None]
        rest = cameras.to_cam(points[:, self._keep]) * mirror + gone
        z_body, _ = render.splat(
            rest @ to_view - offset[:, None],
            torch.zeros(rest.shape[:2], dtype=torch.bool), scale / _COARSE, _RASTER // _COARSE,
        )  # fmt: skip
        rays = render.pixel_rays(scale / _COARSE, _RASTER // _COARSE).reshape(b, -1, 3)
        unmirrored = (rays @ R) * mirror
        origin = cameras.center + ((eye * mirror)[:, None] @ cameras.R_cam_world)[:, 0]
        z_boxes = render.cast(boxes, origin, unmirrored @ cameras.R_cam_world)
        back = torch.minimum(z_body, z_boxes.reshape(z_body.shape))
        back = torch.nn.functional.interpolate(back[:, None], scale_factor=_COARSE, mode="nearest")[:, 0]
        exact = torch.minimum(z_fine, back)
        visible = _visible(skin, normals, eye, detail, exact, scale, away[..., 0])

        measured = rig.degrade(draw, exact, torch.zeros_like(exact, dtype=torch.bool), finer=3)
        pitch = torch.tensor([_PIXEL[n] for n in self.config.sensors])[rig.kind] * draw.lognormal(0.15, b)
        cloud, ok = _sampled(draw, measured, pitch * distance / _FINE, scale, offset)
        color_tan = rig.color_tan
        ok &= rig.seen_by(rig.depth_tan, (cloud - offset[:, None]) @ R * mirror, rig.pitch)
        ok &= rig.seen_by(color_tan, (cloud @ R) * mirror)
        depth = depth_crop(cloud, ok, distance)
        whole = rig.seen_by(color_tan, marks * mirror)
        in_view = whole[:, 0] & (whole.float().mean(1) > 0.8)

        def seen(p: Tensor) -> Tensor:
            return p @ to_view

        middle = torch.stack([torch.zeros(b), torch.zeros(b), distance], -1)[:, None]
        return HandBatch(
            depth, seen(noisy) - middle, distance[:, None],
            seen(palm_normals(hand.landmarks)[:, None] @ place)[:, 0],
            seen(x[:, None])[:, 0], seen(marks) - middle, in_view, visible,
            0.19 / (pitch * distance), grip,
        )  # fmt: skip

    def _believed(self, draw: Draw, joints: Float[Tensor, "b 7 3"]) -> Float[Tensor, "b 7 3"]:
        """Joints with the errors of estimates: each its own, more along the view, and a depth that all share."""
        b, n = joints.shape[:2]
        sigma = torch.full((n,), self.config.joint_m)
        sigma[0] = self.config.wrist_m
        gross = torch.where(draw.chance(0.2, b, n), 3.0, 1.0)
        ray = torch.nn.functional.normalize(joints, dim=2)
        noise = draw.normal(b, n, 3) * 0.8 + ray * draw.normal(b, n, 1) * 0.9
        return joints + noise * (sigma * gross)[..., None] + ray * 0.02 * draw.normal(b, 1, 1)

    def _grips(
        self, draw: Draw, curl: Float[Tensor, " b"], b: int
    ) -> tuple[Float[Tensor, "b 5 3"], Float[Tensor, "b 5"], Int[Tensor, " b"], Float[Tensor, " b"]]:
        """Fingers: as much bent as the posture says, around a bar, or against something flat."""
        grip = torch.where(draw.chance(self.config.grip, b), torch.where(draw.chance(0.65, b), 1, 2), 0)
        radius = draw.uniform(0.006, 0.03, b)
        around = 1.15 - 12.0 * radius  # how far the knuckles bend, mean of the joints
        level = torch.where(grip == 1, around, torch.where(grip == 2, draw.uniform(0.05, 0.6, b), curl))
        joint = torch.tensor([0.75, 1.15, 0.6])
        flex = level[:, None, None] * joint * (1 + 0.25 * draw.normal(b, 5, 1)) + 0.12 * draw.normal(b, 5, 3) - 0.1
        alone = draw.chance(0.12, b) & (grip == 0)  # one or two fingers stretched out
        which = draw.chance(0.45, b, 5) & alone[:, None]
        flex = torch.where(which[..., None], -0.1 + 0.1 * draw.normal(b, 5, 3), flex)
        flex = flex.clamp(torch.tensor([-0.4, -0.2, -0.3]), torch.tensor([1.5, 1.75, 1.2]))
        thumb = torch.tensor([0.5, 0.45, 0.5]) * (0.3 + level)[:, None] + 0.2 * draw.normal(b, 3)
        flex[:, 0] = torch.where(grip[:, None] == 2, draw.uniform(0.2, 0.8, b, 3), thumb).clamp(-0.4, 1.0)
        spread = draw.normal(b, 5) * 0.08 + draw.normal(b, 1) * torch.tensor([0.2, 0.12, 0.0, -0.1, -0.18]) * 0.7
        return flex, spread, grip, radius


_PIXEL = {"kinect2": 1 / 365, "azure": 1 / 504, "realsense": 1 / 425, "other": 1 / 320}
"""tangent of one depth pixel's angle"""


def crop_rotation(center: Float[Tensor, "b 3"], up: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """R_view_cam: z through the centre, y as near as possible along `up` (from the hand to the elbow)."""
    z = torch.nn.functional.normalize(center, dim=1)
    y = up - z * (up * z).sum(1, keepdim=True)
    upright = torch.tensor([0.0, 1.0, 0.0]) - z * z[:, 1:2]
    short = y.norm(dim=1, keepdim=True) < 0.15  # the forearm points at the camera: the image's own upright
    y = torch.nn.functional.normalize(torch.where(short, upright, y), dim=1)
    return torch.stack([torch.linalg.cross(y, z), y, z], 1)


def depth_crop(
    cloud: Float[Tensor, "b n 3"], ok: Bool[Tensor, "b n"], distance: Float[Tensor, " b"]
) -> Float[Tensor, "b 2 48 48"]:
    """Nearest depth of each cell of perspective columns around the view's axis, and the mask."""
    b = len(cloud)
    z = cloud[..., 2]
    cell = cloud[..., :2] * (distance[:, None] / CELL / z.clamp_min(0.1))[..., None] + CELLS / 2
    depth = z - distance[:, None]
    ok = ok & (z > 0.1) & (cell >= 0).all(-1) & (cell < CELLS).all(-1) & (depth > -LIMIT)
    index = torch.where(ok, cell[..., 1].int() * CELLS + cell[..., 0].int(), 0).long()
    near = torch.full((b, CELLS * CELLS), EMPTY)
    near.scatter_reduce_(1, index, torch.where(ok, depth.clamp_max(LIMIT), EMPTY), "amin")
    return torch.stack([near, (near < EMPTY).float()], 1).reshape(b, 2, CELLS, CELLS)


def _curl(rotations: Float[Tensor, "b s 3 3"], side: str) -> Float[Tensor, " b"]:
    """Mean bend of the fingers' joints (radians) in a posture of the body."""
    hand, fingers = rotations[:, SEGMENT[f"{side}_hand"]], rotations[:, SEGMENT[f"{side}_fingers"]]
    relative = hand.mT @ fingers
    return torch.acos(((relative.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)) / 1.9


def _labels(skin: Tensor, held: Tensor) -> Bool[Tensor, "b n"]:
    label = torch.zeros(skin.shape[0], skin.shape[1] + held.shape[1], dtype=torch.bool)
    label[:, skin.shape[1] :] = True
    return label


def _things(
    draw: Draw, grip: Int[Tensor, " b"], radius: Float[Tensor, " b"], landmarks: Float[Tensor, "b 21 3"], n: int = 1200
) -> Float[Tensor, "b n 3"]:
    """Surface points of what is held, in the hand frame; NaN where nothing is."""
    b = len(grip)
    along, angle = draw.uniform(-1, 1, b, n), draw.uniform(0, 2 * math.pi, b, n)
    knuckles = landmarks[:, [5, 9, 13]].mean(1)
    # a bar lies across the palm below the knuckles, more or less askew
    half = draw.uniform(0.06, 0.25, b)[:, None]
    shift = draw.uniform(-0.5, 0.5, b)[:, None] * (half - 0.05)
    lean = 0.25 * draw.normal(b)[:, None] + 0.15
    bar_y = along * half + shift
    bar_x = knuckles[:, :1] - 0.005 + radius[:, None] * angle.cos() + lean * bar_y
    bar_z = 0.022 + radius[:, None] * (1 + angle.sin())
    bar = torch.stack([bar_x, bar_y, bar_z], -1)
    # a flat thing lies against the fingers, between them and the thumb
    wide, long = draw.uniform(0.05, 0.16, b)[:, None], draw.uniform(0.05, 0.2, b)[:, None]
    thick = draw.uniform(0.001, 0.04, b)[:, None]
    face = draw.chance(0.5, b, n)
    flat_x = knuckles[:, :1] + 0.02 + 0.6 * long + long * along
    across = draw.uniform(-1, 1, b, n)
    flat = torch.stack([flat_x, wide * across, 0.03 + torch.where(face, 0.0, thick)], -1)
    chosen = torch.where((grip == 1)[:, None, None], bar, flat)
    return chosen + torch.where(grip > 0, 0.0, torch.nan)[:, None, None]


def _visible(
    skin: Tensor, normals: Tensor, eye: Tensor, detail: Tensor, exact: Tensor, scale: Tensor, away: Tensor
) -> Float[Tensor, " b"]:
    """Share of the skin that faces the camera which nothing hides."""
    b, s = len(skin), exact.shape[-1]
    p = detail[:, : skin.shape[1]]
    facing = ~away
    uv = (p[..., :2] / p[..., 2:].clamp_min(0.1) * scale[:, None, None] + s / 2).nan_to_num(-1).floor().long()
    inside = ((uv >= 0) & (uv < s)).all(-1) & facing
    index = torch.where(inside, uv[..., 1] * s + uv[..., 0], 0)
    surface = exact.reshape(b, -1).gather(1, index)
    free = inside & (p[..., 2].nan_to_num(99.0) < surface + 0.012)
    return free.float().sum(1) / facing.float().sum(1).clamp_min(1)


def _sampled(
    draw: Draw, z: Float[Tensor, "b s s"], pitch: Float[Tensor, " b"], scale: Tensor, offset: Tensor
) -> tuple[Float[Tensor, "b m 3"], Bool[Tensor, "b m"]]:
    """The points that a sensor measures whose pixels are `pitch` pixels of the raster apart; view's frame."""
    b, s = len(z), z.shape[-1]
    grid = torch.arange(s, dtype=torch.float32)
    start = draw.uniform(0, 1, b, 2)
    at = (grid[None, None] + start[..., None]) * pitch.clamp_min(1.0)[:, None, None]  # (b, 2, s)
    inside = at < s
    index = at.long().clamp_max(s - 1)
    flat = (index[:, 1, :, None] * s + index[:, 0, None, :]).reshape(b, -1)
    measured = z.reshape(b, -1).gather(1, flat)
    ok = (inside[:, 1, :, None] & inside[:, 0, None, :]).reshape(b, -1) & (measured > 0)
    u = (index[:, 0].float() + 0.5 - s / 2) / scale[:, None]
    v = (index[:, 1].float() + 0.5 - s / 2) / scale[:, None]
    ray = torch.stack([u[:, None, :].expand(b, s, s), v[:, :, None].expand(b, s, s), torch.ones(b, s, s)], -1)
    return ray.reshape(b, -1, 3) * measured[..., None] + offset[:, None], ok
