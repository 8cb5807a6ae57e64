"""A furnished room with people and a camera: what is where in each frame of a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.camera import Camera
from understudy.synthetic import render, surfels
from understudy.synthetic.actors import Actor, Moment
from understudy.synthetic.appearance import room_colors
from understudy.synthetic.draw import Draw
from understudy.synthetic.furniture import FLOOR, place_boxes, place_seats
from understudy.synthetic.samples import LEAST_SEEN
from understudy.synthetic.scene import Boxes, Cameras, SceneConfig, place_cameras
from understudy.synthetic.surfels import Surfels

_TRIES: Final = 40
_APART: Final = 0.25
"""metres between any two joints of two people"""
_NEAREST: Final = 0.6
"""metres: no joint comes nearer to the camera"""
_MARGIN: Final = 0.06
"""metres between furniture and joints"""


@dataclass(frozen=True)
class Room:
    """World frame, metres; batches of one."""

    actors: tuple[Actor, ...]
    cameras: Cameras
    boxes: Boxes
    box_colors: Float[Tensor, "k 3"]
    light: Float[Tensor, " 3"]
    """unit vector towards the light, world"""

    def moments(self, frame: int) -> list[Moment]:
        """The people in a frame."""
        return [a.at(frame) for a in self.actors]


def make_room(draw: Draw, config: SceneConfig, camera: Camera, actors: list[Actor]) -> Room:
    """Puts people side by side, a camera before them and furniture around them."""
    placed = _arranged(draw, actors)
    joints = torch.stack([a.joints for a in placed])  # (m, f, 18, 3)
    cameras = _camera(draw, config, camera, joints)
    first = joints[:1, 0]
    boxes = place_boxes(draw, config, cameras, first, torch.tensor([placed[0].sits]))
    for a in placed[1:]:
        boxes = boxes.joined(place_seats(draw, a.joints[:1], torch.tensor([a.sits])))
    gone = boxes.holds(joints.reshape(1, -1, 3), _MARGIN) | boxes.holds(cameras.center[:, None], 0.3)
    gone |= _hiding(cameras, camera, boxes.without(gone), joints)
    gone[:, FLOOR] = False
    boxes = _kept(boxes.without(gone))
    light = torch.nn.functional.normalize(
        torch.cat([draw.uniform(-0.8, 0.8, 1), draw.uniform(-1.0, -0.3, 1), draw.uniform(0.5, 1.2, 1)]), dim=0
    )
    return Room(tuple(placed), cameras, boxes, room_colors(draw, boxes.yaw.shape[1]), light)


def _arranged(draw: Draw, actors: list[Actor]) -> list[Actor]:
    """The first one at the origin, the others beside, so that nobody is inside another in any frame."""
    placed = actors[:1]
    for actor in actors[1:]:
        for k in range(_TRIES):
            angle = draw.uniform(-torch.pi, torch.pi, 1)
            away = draw.uniform(0.5, 1.6, 1) * (1 + 0.08 * k)
            here = actor.shifted(torch.cat([1.2 * away * angle.sin(), away * angle.cos(), torch.zeros(1)]))
            if all(float(torch.cdist(here.joints, a.joints).amin()) > _APART for a in placed):
                break
        placed = [*placed, here]
    return placed


def _camera(draw: Draw, config: SceneConfig, camera: Camera, joints: Float[Tensor, "m f 18 3"]) -> Cameras:
    """A camera that sees at least some of everybody most of the time."""
    best, best_share = None, -1.0
    for _ in range(_TRIES):
        cameras = place_cameras(draw, config, joints.reshape(1, -1, 3))
        seen = _in_view(cameras, camera, joints).sum(-1)
        near = float(cameras.to_cam(joints.reshape(1, -1, 3))[..., 2].amin()) < _NEAREST
        share = float((seen >= 2 * LEAST_SEEN).float().mean()) - 2.0 * near
        if share > best_share or best is None:
            best, best_share = cameras, share
        if share >= 0.9:
            break
    assert best is not None
    return best


def _in_view(cameras: Cameras, camera: Camera, joints: Float[Tensor, "m f 18 3"]) -> Bool[Tensor, "m f 18"]:
    p = cameras.to_cam(joints.reshape(1, -1, 3))[0].double().numpy()
    return torch.from_numpy(camera.contains(camera.project(p))).reshape(joints.shape[:3])


def _hiding(cameras: Cameras, camera: Camera, boxes: Boxes, joints: Float[Tensor, "m f 18 3"]) -> Bool[Tensor, "1 k"]:
    """Boxes before people of whom otherwise hardly anything would be seen most of the time."""
    rays = joints.reshape(1, -1, 3) - cameras.center[:, None]
    distance, which = render.cast_which(boxes, cameras.center, rays)
    hit = (distance < 0.98).reshape(joints.shape[:3])
    in_view = _in_view(cameras, camera, joints)
    unseen = ((in_view & ~hit).sum(-1) < LEAST_SEEN) & (in_view.sum(-1) >= LEAST_SEEN)
    lost = unseen.float().mean(1) > 0.3
    gone = torch.zeros_like(boxes.yaw, dtype=torch.bool)
    gone[0, which.reshape(joints.shape[:3])[hit & lost[:, None, None]].unique()] = True
    return gone


def _kept(boxes: Boxes) -> Boxes:
    """Without those that were sunk below the floor (but never without any)."""
    rows = (boxes.center[0, :, 2] > -50).nonzero()[:, 0]
    rows = rows if len(rows) else torch.tensor([FLOOR])
    return Boxes(boxes.center[:, rows], boxes.half[:, rows], boxes.yaw[:, rows])


@dataclass(frozen=True)
class View:
    """What a camera at some place in the world sees. Metres along its z; `render.FAR` where there is nothing."""

    people: Float[Tensor, "h w"]
    boxes: Float[Tensor, "h w"]
    values: Float[Tensor, "h w 4"]
    """of the people's surface: colour, dark"""
    normals: Float[Tensor, "h w 3"]
    """of people, camera's frame (not of unit length)"""
    which: Tensor
    """(h, w) number of the box; -1 for none"""
    rays: Float[Tensor, "h w 3"]
    """of the pixels, world, z = 1 in the camera's frame"""

    @property
    def depth(self) -> Float[Tensor, "h w"]:
        """Of whatever is first."""
        return torch.minimum(self.people, self.boxes)


def look(
    room: Room, moments: list[Moment], camera: Camera, R_cam_world: Float[Tensor, "3 3"], center: Float[Tensor, " 3"]
) -> View:
    """The room through a camera without distortion. center: of the camera, world."""
    parts = [m.surfels for m in moments]
    everybody = Surfels(
        *(torch.cat([getattr(s, name) for s in parts]) for name in ("points", "normals", "radius", "values"))
    )
    people, mean = surfels.draw(everybody.moved(R_cam_world, -R_cam_world @ center), camera)
    u = (torch.arange(camera.width) - camera.cx) / camera.fx
    v = (torch.arange(camera.height) - camera.cy) / camera.fy
    v, u = torch.meshgrid(v.float(), u.float(), indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ R_cam_world
    distance, which = render.cast_which(room.boxes, center[None], rays.reshape(1, -1, 3))
    size = people.shape
    return View(people, distance.reshape(size), mean[..., :4], mean[..., 4:], which.reshape(size), rays)


def shade(room: Room, view: View, R_cam_world: Float[Tensor, "3 3"], center: Float[Tensor, " 3"]) -> Tensor:
    """(h, w, 3) colours 0..1: matt surfaces in plain colours under one light."""
    normal = torch.nn.functional.normalize(view.normals, dim=-1) @ R_cam_world
    color = view.values[..., :3]
    box = view.boxes < view.people
    k = view.which[box]
    boxes = room.boxes
    offset = center + view.rays[box] * view.boxes[box, None] - boxes.center[0, k]
    c, s = boxes.yaw[0, k].cos(), boxes.yaw[0, k].sin()
    local = torch.stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]], 1)
    face = (local.abs() / boxes.half[0, k]).argmax(1, keepdim=True)
    flat = torch.zeros_like(local).scatter_(1, face, local.gather(1, face).sign())
    n_box = torch.stack([c * flat[:, 0] - s * flat[:, 1], s * flat[:, 0] + c * flat[:, 1], flat[:, 2]], 1)
    normal[box], color = n_box, color.clone()
    color[box] = room.box_colors[k]
    bright = 0.5 + 0.5 * (normal @ room.light).clamp_min(0)
    nothing = view.depth >= render.FAR
    return torch.where(nothing[..., None], 0.6, color * bright[..., None])
