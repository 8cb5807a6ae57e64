"""Depth crops of simulated hands with exact palms: batch `i` is a function of the seed and of `i`.

Everything is a right hand: left hands are seen in the mirror. Coordinates are those of the hand's *crop view*: origin
in the colour camera, z through the place where the hand is believed to be, y as near as possible along the believed
forearm towards the elbow (so fingers that go on from the forearm point to -y), x = y x z. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from understudy.hands.crop import BEYOND, CONTEXT, PIXEL, PIXELS, UNSURE, context_rows
from understudy.skeleton import JOINT
from understudy.synthetic import render
from understudy.synthetic.bodies import BodyBank, pose
from understudy.synthetic.clothing import dress
from understudy.synthetic.draw import Draw
from understudy.synthetic.furniture import place_boxes
from understudy.synthetic.hand_bank import HandBank, articulate, palm_normals
from understudy.synthetic.hand_boxes import Carried, carried_between
from understudy.synthetic.hand_clothes import LOWER, SKIN, UPPER, ClothesConfig, HandClothes, dress_hands
from understudy.synthetic.hand_crops import crop_rotation, depth_crop, sampled, visible_share
from understudy.synthetic.hand_grips import (
    FLAT,
    FREE,
    Board,
    GripConfig,
    draw_board,
    draw_grips,
    finger_bend,
    held_points,
    turned,
)
from understudy.synthetic.hand_images import HandScene, hand_image
from understudy.synthetic.poses import ACTIVITIES, NAMES, sample_poses
from understudy.synthetic.scene import Boxes, Cameras, SceneConfig, about_z, place_cameras
from understudy.synthetic.segments import SEGMENT, SEGMENTS
from understudy.synthetic.sensors import SENSORS, Rig

_RASTER = 80
_FINE = 0.005  # metres of a raster's pixel at the hand
_COARSE = 4  # the body's raster is so many times coarser
_THINNED = 2  # of the body's points, every second
_HAND_LENGTH = 0.19  # metres, for sizes in pixels
_SIDES = ("right", "left")
_PIXEL = {"kinect2": 1 / 365, "azure": 1 / 504, "realsense": 1 / 425, "other": 1 / 320}
"""tangent of one depth pixel's angle"""
_COLOR_PIXEL = {"kinect2": 1 / 1060, "azure": 1 / 610, "realsense": 1 / 900, "other": 1 / 600}
"""the same of the colour image"""
_PER_SIGMA = 0.56  # scale of the errors' directions, so that a ball of one sigma holds 68 % of them
_SHARED = 0.4  # correlation of the wrist's errors with the elbow's
_BARE = ("head", "neck", "hand", "fingers")
_LEGS = ("thigh", "shin", "foot", "pelvis")


class HandBatch(NamedTuple):
    """Input of the hand network, and truth."""

    depth: Float[Tensor, "b 2 48 48"]
    """nearest depth of each cell relative to the crop's distance (metres; EMPTY where none), and 1 where measured"""
    context: Float[Tensor, "b 11 3"]
    """CONTEXT, relative to the crop's centre, with the errors that estimates have"""
    distance: Float[Tensor, "b 1"]
    sigma: Float[Tensor, "b 2"]
    """metres, what the estimate says of the errors of UNSURE: radius of the ball that holds 68 % of them"""
    image: UInt8[Tensor, "b 3 72 72"]
    """RGB, as `HandView.color_crop`"""
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
    """0 free, 1 grips a bar, 2 holds a flat thing, or carries something with the other hand"""


@dataclass(frozen=True)
class HandConfig:
    """What decides the samples, besides bodies and hands."""

    scene: SceneConfig = field(
        default_factory=lambda: SceneConfig((0.55, 6.0), furniture=2, occluder=0.15, neighbours=0.0)
    )
    sensors: tuple[str, ...] = tuple(SENSORS)
    grips: GripConfig = field(default_factory=GripConfig)
    turned: float = 0.45
    """share of hands that are bent and twisted at the wrist by more than the posture says"""
    clothes: ClothesConfig = field(default_factory=ClothesConfig)
    carrying: float = 0.1
    """share of people who carry, in the posture at least"""
    boxes: float = 0.45
    """of those whose hands are held that way, share with a thing between or on both"""
    wrist_m: tuple[float, float] = (0.07, 0.6)
    """errors of the estimated wrist: median of the radius that holds 68 % of them, and the spread of its logarithm"""
    elbow_m: tuple[float, float] = (0.055, 0.45)
    """the same of the elbow; both also of the other arm"""
    joint_m: tuple[float, float] = (0.04, 0.35)
    """the same of the other joints"""


@dataclass(frozen=True)
class _People:
    """The scenes of a batch, one person in each."""

    cameras: Cameras
    rig: Rig
    boxes: Boxes
    carried: Carried
    joints: Float[Tensor, "b 18 3"]
    points: Float[Tensor, "b p 3"]
    """of the body's surface, world"""
    rotations: Float[Tensor, "b s 3 3"]
    """of the body's segments in the body's frame"""
    R_world_segment: Float[Tensor, "b s 3 3"]


@dataclass(frozen=True)
class _Hands:
    """One hand of everybody; colour camera's frame, left hands mirrored (x -> -x)."""

    skin: Float[Tensor, "b p 3"]
    normals: Float[Tensor, "b p 3"]
    counts: Bool[Tensor, " p"]
    """which points are the hand's own, not the forearm's"""
    clothes: HandClothes
    held: Float[Tensor, "b q 3"]
    marks: Float[Tensor, "b 21 3"]
    normal: Float[Tensor, "b 3"]
    """out of the palm"""
    direction: Float[Tensor, "b 3"]
    board: Board
    grip: Int[Tensor, " b"]


@dataclass(frozen=True)
class _Views:
    """Where the crops look; the same frame."""

    context: Float[Tensor, "b 11 3"]
    sigma: Float[Tensor, "b 11"]
    """metres: what is known of the errors"""
    R: Float[Tensor, "b 3 3"]
    """R_view_cam"""
    distance: Float[Tensor, " b"]
    eye: Float[Tensor, "b 3"]
    """the depth camera"""

    @property
    def scale(self) -> Float[Tensor, " b"]:
        """Focal length of the raster, pixels."""
        return self.distance / _FINE

    @property
    def offset(self) -> Float[Tensor, "b 1 3"]:
        """The depth camera in the view's frame."""
        return (self.R @ self.eye[..., None]).mT

    def seen(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n 3"]:
        """Points or directions in the view's frame."""
        return points @ self.R.mT


class HandSamples:
    """Batches of simulated hands, the same ones for the same seed."""

    def __init__(self, bodies: BodyBank, hands: HandBank, config: HandConfig | None = None, seed: int = 0):
        self.bodies, self.hands, self.config, self.seed = bodies, hands, config or HandConfig(), seed
        self._keep = torch.arange(0, bodies.points.shape[1], _THINNED)
        wear = [SKIN if n.endswith(_BARE) else LOWER if n.endswith(_LEGS) else UPPER for n in SEGMENTS]
        self._wear = torch.tensor(wear)[bodies.segment[self._keep]]
        self._limb = {
            side: (bodies.weights[:, [SEGMENT[f"{side}_hand"], SEGMENT[f"{side}_fingers"]]].sum(1) > 0.2)
            | ((bodies.segment == SEGMENT[f"{side}_forearm"]) & (bodies.along > 0.45))
            for side in _SIDES
        }

    @torch.no_grad()
    def batch(self, number: int, size: int) -> HandBatch:
        """Batch `number`: size hands, the right and the left ones of size / 2 people."""
        draw = Draw((self.seed * 1_000_003 + number) % 2**63)
        people = self._people(draw, (size + 1) // 2)
        sides = [self._side(draw, people, side) for side in _SIDES]
        return HandBatch(*(torch.cat(pair)[:size] for pair in zip(*sides, strict=True)))

    def _people(self, draw: Draw, b: int) -> _People:
        ids = draw.integers(len(self.bodies), b)
        drawn = sample_poses(b, draw.generator, mix=ACTIVITIES | {"carrying": self.config.carrying})
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
        R_world_segment = turn[:, None] @ drawn.rotations
        carried = carried_between(draw, self.config.boxes, joints, R_world_segment)
        return _People(cameras, rig, boxes, carried, joints, points, drawn.rotations, R_world_segment)

    def _side(self, draw: Draw, people: _People, side: str) -> HandBatch:
        """One hand of everybody."""
        mirror = torch.tensor([1.0 if side == "right" else -1.0, 1.0, 1.0])  # a left hand is looked at in a mirror
        known = torch.stack([people.joints[:, rows].mean(1) for rows in context_rows(side)], 1)
        known = people.cameras.to_cam(known) * mirror
        hands = self._hands(draw, people, side, mirror, known)
        views = self._views(draw, people, mirror, known)
        exact, visible = self._exact(people, side, mirror, hands, views)
        pitch = torch.tensor([_PIXEL[n] for n in self.config.sensors])[people.rig.kind]
        pitch = pitch * draw.lognormal(0.15, len(known))
        depth = self._measured(draw, people.rig, mirror, exact, views, pitch)
        image = self._image(draw, people, side, mirror, hands, views)
        inside = people.rig.seen_by(people.rig.color_tan, hands.marks * mirror)
        middle = torch.zeros(len(known), 1, 3)
        middle[:, 0, 2] = views.distance
        return HandBatch(
            depth=depth,
            context=views.seen(views.context) - middle,
            distance=views.distance[:, None],
            sigma=views.sigma[:, : len(UNSURE)],
            image=image,
            normal=views.seen(hands.normal[:, None])[:, 0],
            direction=views.seen(hands.direction[:, None])[:, 0],
            landmarks=views.seen(hands.marks) - middle,
            in_view=inside[:, 0] & (inside.float().mean(1) > 0.8),
            visible=visible,
            pixels=_HAND_LENGTH / (pitch * views.distance),
            grip=hands.grip,
        )

    def _hands(self, draw: Draw, people: _People, side: str, mirror: Tensor, known: Float[Tensor, "b 11 3"]) -> _Hands:
        """Hands in detail, with what they hold, at the wrists."""
        R = people.cameras.R_cam_world @ people.R_world_segment[:, SEGMENT[f"{side}_hand"]]
        # the bodies' hands point along -x (right) or x (left), palms down
        x, z = R[..., 0] * (-mirror[0] * mirror), -R[..., 2] * mirror
        wrist, elbow = known[:, 0], torch.nn.functional.normalize(known[:, 1] - known[:, 0], dim=1)
        axes = torch.stack([x, torch.linalg.cross(z, x), z], 1)  # hand frame -> camera, rows
        busy = people.carried.there
        axes = torch.where(busy[:, None, None], axes, turned(draw, self.config.turned, axes, elbow))
        x, _, z = axes.unbind(1)
        grips = draw_grips(draw, self.config.grips, finger_bend(people.rotations, side), busy)
        ids = draw.integers(len(self.hands), len(wrist))
        hand = articulate(self.hands, ids, grips.flex, grips.spread, (axes @ elbow[..., None])[..., 0])
        to_hip = (people.joints[:, JOINT[f"{side}_wrist"]] - people.joints[:, JOINT[f"{side}_hip"]]).norm(dim=1)
        along, empty = self.hands.points[ids, :, 0], (grips.kind == FREE) & ~busy
        sight = (axes @ torch.nn.functional.normalize(-wrist, dim=1)[..., None])[..., 0]
        clothes = dress_hands(draw, self.config.clothes, along, self.hands.of_hand, empty, to_hip, sight)
        skin = hand.points + hand.normals * clothes.thick[..., None]
        held = held_points(draw, grips, hand.landmarks)
        board = draw_board(draw, self.config.grips, grips)
        behind = (z * torch.nn.functional.normalize(wrist, dim=1)).sum(1) > -0.2  # of the hand, as the camera sees it
        return _Hands(
            skin=skin @ axes + wrist[:, None],
            counts=self.hands.of_hand,
            clothes=clothes,
            normals=hand.normals @ axes,
            held=held @ axes + wrist[:, None],
            marks=hand.landmarks @ axes + wrist[:, None],
            normal=(palm_normals(hand.landmarks)[:, None] @ axes)[:, 0],
            direction=x,
            board=replace(board, there=board.there & behind & ~busy).replaced_by(clothes.patch).moved(axes, wrist),
            grip=torch.where(busy, FLAT, grips.kind),
        )

    def _views(self, draw: Draw, people: _People, mirror: Tensor, known: Float[Tensor, "b 11 3"]) -> _Views:
        """What is believed of the body, and where it makes one look."""
        context, sigma = self._believed(draw, known)
        forearm = torch.nn.functional.normalize(context[:, 0] - context[:, 1], dim=1)
        center = context[:, 0] + BEYOND * forearm
        return _Views(context, sigma, crop_rotation(center, -forearm), center.norm(dim=1), people.rig.baseline * mirror)

    def _exact(
        self, people: _People, side: str, mirror: Tensor, hands: _Hands, views: _Views
    ) -> tuple[Float[Tensor, "b s s"], Float[Tensor, " b"]]:
        """Exact depth from the depth camera, in its raster around the hand; and what share of the hand it sees."""
        away = ((hands.normals * (hands.skin - views.eye[:, None])).sum(-1) > 0)[..., None]
        points = torch.cat([hands.skin + torch.where(away, torch.nan, 0.0), hands.held], 1)
        detail = views.seen(points) - views.offset
        unlabelled = torch.zeros(detail.shape[:2], dtype=torch.bool)
        z_fine, _ = render.splat(detail, unlabelled, views.scale, _RASTER)
        back = torch.minimum(z_fine, self._background(people, side, mirror, views))
        rays = render.pixel_rays(views.scale, _RASTER)
        exact = torch.minimum(back, hands.board.moved(views.R.mT, -views.offset[:, 0]).cast(rays))
        exact = torch.minimum(exact, _cast(people.carried.boxes, people.cameras, views.eye, mirror, views.R, rays))
        n = hands.skin.shape[1]
        towards = ~away[..., 0] & hands.counts
        bare = towards & ~hands.clothes.pocketed
        share = visible_share(detail[:, :n], bare, exact, views.scale)
        return exact, share * bare.sum(1) / towards.sum(1).clamp_min(1)

    def _image(
        self, draw: Draw, people: _People, side: str, mirror: Tensor, hands: _Hands, views: _Views
    ) -> UInt8[Tensor, "b 3 72 72"]:
        """What the colour camera sees around the hand."""
        away = ((hands.normals * hands.skin).sum(-1) > 0)[..., None]
        rays = render.pixel_rays(views.distance / PIXEL, PIXELS)
        nowhere = torch.zeros_like(views.eye)
        z_boxes, z_carried = (
            _cast(boxes, people.cameras, nowhere, mirror, views.R, rays)
            for boxes in (people.boxes, people.carried.boxes)
        )
        board = hands.board.moved(views.R.mT, torch.zeros_like(hands.normal))
        tangent = torch.tensor([_COLOR_PIXEL[n] for n in self.config.sensors])[people.rig.kind]
        scene = HandScene(
            skin=views.seen(hands.skin + torch.where(away, torch.nan, 0.0)),
            normals=views.seen(hands.normals),
            hand_wear=hands.clothes.wear,
            palm=views.seen(hands.normal[:, None])[:, 0],
            held=views.seen(hands.held),
            body=views.seen(self._rest(people, side, mirror)),
            body_wear=self._wear,
            z_boxes=z_boxes,
            z_board=torch.minimum(board.cast(rays), z_carried),
            board_wear=torch.where(hands.clothes.patch.there, hands.clothes.patch_wear, -1),
            distance=views.distance,
            pixel=tangent * draw.lognormal(0.15, len(tangent)) * views.distance,
        )
        return hand_image(draw, scene)

    def _rest(self, people: _People, side: str, mirror: Tensor) -> Float[Tensor, "b n 3"]:
        """Points of the body; NaN where they are the arm's end. Colour camera's frame, mirrored."""
        gone = torch.where(self._limb[side][self._keep], torch.nan, 0.0)[:, None]
        return people.cameras.to_cam(people.points[:, self._keep]) * mirror + gone

    def _background(self, people: _People, side: str, mirror: Tensor, views: _Views) -> Float[Tensor, "b s s"]:
        """Depth of the rest of the body and of the furniture, coarsely."""
        scale, size = views.scale / _COARSE, _RASTER // _COARSE
        rest = views.seen(self._rest(people, side, mirror)) - views.offset
        z_body, _ = render.splat(rest, torch.zeros(rest.shape[:2], dtype=torch.bool), scale, size)
        rays = render.pixel_rays(scale, size)
        back = torch.minimum(z_body, _cast(people.boxes, people.cameras, views.eye, mirror, views.R, rays))
        return torch.nn.functional.interpolate(back[:, None], scale_factor=_COARSE, mode="nearest")[:, 0]

    def _measured(
        self, draw: Draw, rig: Rig, mirror: Tensor, exact: Tensor, views: _Views, pitch: Float[Tensor, " b"]
    ) -> Float[Tensor, "b 2 48 48"]:
        """The network's depth crop: what the sensor says, as far as both cameras see it."""
        measured = rig.degrade(draw, exact, torch.zeros_like(exact, dtype=torch.bool), finer=3)
        cloud, ok = sampled(draw, measured, pitch * views.scale, views.scale)
        ok &= rig.seen_by(rig.depth_tan, (cloud @ views.R) * mirror, rig.pitch)
        cloud = cloud + views.offset
        ok &= rig.seen_by(rig.color_tan, (cloud @ views.R) * mirror)
        return depth_crop(cloud, ok, views.distance)

    def _believed(
        self, draw: Draw, joints: Float[Tensor, "b 11 3"]
    ) -> tuple[Float[Tensor, "b 11 3"], Float[Tensor, "b 11"]]:
        """Joints with the errors of estimates, and what is known of the errors (metres).

        The errors are larger along the view; the wrist's are partly the elbow's; all joints share one of depth.
        """
        b, n = joints.shape[:2]
        of = {"wrist": self.config.wrist_m, "elbow": self.config.elbow_m}
        kinds = torch.tensor([of.get(name.removeprefix("other_"), self.config.joint_m) for name in CONTEXT])
        sigma = kinds[:, 0] * torch.exp(kinds[:, 1] * draw.normal(b, n).clamp(-2.5, 2.5))
        ray = torch.nn.functional.normalize(joints, dim=2)
        noise = (draw.normal(b, n, 3) * 0.8 + ray * draw.normal(b, n, 1) * 0.9) * _PER_SIGMA
        noise[:, 0] = _SHARED * noise[:, 1] + (1 - _SHARED**2) ** 0.5 * noise[:, 0]
        noise = noise * draw.lognormal(0.25, b, n, 1) * sigma[..., None]
        return joints + noise + ray * 0.02 * draw.normal(b, 1, 1), sigma


def _cast(
    boxes: Boxes, cameras: Cameras, eye: Tensor, mirror: Tensor, R_view_cam: Tensor, rays: Float[Tensor, "b s s 3"]
) -> Float[Tensor, "b s s"]:
    """Distances along rays of the view from `eye` (camera's frame, mirrored as the view is) to the nearest box."""
    to_world = cameras.R_cam_world
    origin = cameras.center + ((eye * mirror)[:, None] @ to_world)[:, 0]
    z = render.cast(boxes, origin, ((rays.flatten(1, 2) @ R_view_cam) * mirror) @ to_world)
    return z.reshape(rays.shape[:3])
