"""Where the camera stands: beside or behind the person, where it sees the hand, the handle and the upper body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from understudy.camera import RGBDCamera
from understudy.geometry import inverse, rigid, transform_points
from understudy.skeleton import JOINT
from understudy.stage.markers import OBJECT
from understudy.stage.scene import Scene

CANDIDATES: Final = 120
DISTANCE_M: Final = (2.0, 3.5)
"""of the camera from the closed handle"""
HEIGHT_M: Final = (1.3, 2.2)
MOST_SIDEWAYS: Final = np.radians(75)
"""of the camera's direction from the handle, against straight behind the person"""

_MOMENTS: Final = 12  # of the performance that are looked at
_THICK: Final = 0.06  # metres: a surface this much before a point does not hide it, it is the point's own
_GOOD: Final = 0.97  # of the best candidate's score: any such one may be taken
_MARGIN: Final = 12  # pixels inside the image
_NEAREST_M: Final = 1.3  # of the camera to the neck: nearer, the person fills the picture
_GRAZING: Final = 0.2  # cosine between the way to the camera and a front's normal: below it hardly anything is seen
_READABLE: Final = (0.5, 22.0)
"""Cosine between the way to the camera and a marker's normal, and pixels of its shorter side, that reading it takes."""
_HELD_M: Final = 0.2  # between hand and handle
_WEIGHTS: Final = np.array([0.25, 0.35, 0.3, 0.1])
"""Of the markers on hand, object and torso, and of the body, in a moment's score."""
_WEIGHTS_HELD: Final = np.array([0.42, 0.42, 0.1, 0.06])
"""The same while the hand is at the handle: that is what a demonstration is about."""
_PANEL: Final = np.array([[0, y, z] for y in (-0.6, 0, 0.6) for z in (-0.6, 0, 0.6)])
"""Points on a front, in halves of its sizes."""
_CORNERS: Final = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
"""of a marker, in halves of its side"""
_ALONG: Final = np.linspace(0, 1, 5)
"""Where along a limb points are taken that stand for it."""
_UPPER: Final = tuple(
    JOINT[name]
    for name in (
        "nose",
        "neck",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
        "left_wrist",
        "right_wrist",
        "left_hip",
        "right_hip",
    )
)
_LIMBS: Final = (
    ("neck", "nose", 0.10),
    ("left_shoulder", "left_elbow", 0.06),
    ("right_shoulder", "right_elbow", 0.06),
    ("left_elbow", "left_wrist", 0.05),
    ("right_elbow", "right_wrist", 0.05),
    ("left_shoulder", "left_hip", 0.10),
    ("right_shoulder", "right_hip", 0.10),
    ("neck", "left_hip", 0.12),
    ("neck", "right_hip", 0.12),
)


@runtime_checkable
class Moves(Protocol):
    """What of a performance matters here; see `demonstrator.Performance`."""

    @property
    def q(self) -> Float[np.ndarray, " t"]: ...
    @property
    def joints(self) -> Float[np.ndarray, "t 18 3"]: ...
    @property
    def acting(self) -> str: ...
    def carriers(self, i: int) -> Mapping[str, Float[np.ndarray, "4 4"]]: ...


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A place for the colour camera."""

    T_world_cam: Float[np.ndarray, "4 4"]
    score: float
    """0 .. 1: how well it sees hand, handle and upper body, over the performance"""


def choose_viewpoint(
    scene: Scene, moves: Moves, hand: Float[np.ndarray, "t 4 4"], camera: RGBDCamera, seed: int
) -> Viewpoint:
    """Draws places at random and returns one of those that see best. hand: T_world_hand of the acting hand."""
    rng = np.random.default_rng([seed, 72])
    moments = np.unique(np.linspace(0, len(moves.q) - 1, _MOMENTS).round().astype(int))
    furniture = scene.furniture
    T_object = furniture.articulation.pose(moves.q[moments])
    middle = (moves.joints[moments][:, list(_UPPER)].mean((0, 1)) + T_object[:, :3, 3].mean(0)) / 2
    places = [_candidate(rng, furniture.articulation.T_rest[:3, 3], middle) for _ in range(CANDIDATES)]
    panel = scene.furniture.panel
    front = transform_points(panel.T_frame_box, _PANEL * panel.half_m)
    score = np.zeros(len(places))
    for moment, T in zip(moments, T_object, strict=True):
        carried = moves.carriers(int(moment)) if scene.markers else {}
        scene.pose(float(moves.q[moment]), carried=carried)
        sight = _Sight(
            hand[moment, :3, 3],
            T[:3, 3],
            transform_points(T, front),
            T[:3, 0],
            moves.joints[moment],
            moves.acting,
            {OBJECT: T, **carried},
        )
        score += [_sees(scene, place, camera, sight) for place in places]
    score /= len(moments)
    good = np.flatnonzero(score >= _GOOD * score.max())
    best = int(good[0])  # the places are in random order
    return Viewpoint(places[best], float(score[best]))


def look_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """T_world_cam of a camera at `eye` whose optical axis meets `target`; roll (radians) about that axis."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, (0, 0, 1.0))
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return rigid(np.stack([c * x + s * y, c * y - s * x, z], axis=1), eye)


def _candidate(
    rng: np.random.Generator, handle: Float[np.ndarray, "3"], middle: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    angle, distance = rng.uniform(-MOST_SIDEWAYS, MOST_SIDEWAYS), rng.uniform(*DISTANCE_M)
    height = rng.uniform(*HEIGHT_M)
    level = np.sqrt(max(distance**2 - (height - handle[2]) ** 2, 1.0))
    eye = np.array([handle[0] - level * np.cos(angle), handle[1] + level * np.sin(angle), height])
    target = middle + rng.normal(0, 0.08, 3)
    target[2] = min(target[2], height - 0.05 * level)  # slightly down
    return look_at(eye, target, float(rng.normal(0, np.radians(1.5))))


@dataclass(frozen=True, eq=False)
class _Sight:
    """What is to be seen at one moment. World."""

    hand: Float[np.ndarray, "3"]
    handle: Float[np.ndarray, "3"]
    panel: Float[np.ndarray, "n 3"]
    """points of the moving front"""
    front: Float[np.ndarray, "3"]
    """the way that it faces"""
    joints: Float[np.ndarray, "18 3"]
    acting: str
    carriers: Mapping[str, Float[np.ndarray, "4 4"]]
    """poses of what carries markers, if there are any"""


def _sees(scene: Scene, T_world_cam: Float[np.ndarray, "4 4"], camera: RGBDCamera, sight: _Sight) -> float:
    """Score of one moment, at most 1."""
    eye = T_world_cam[:3, 3]
    upper = sight.joints[list(_UPPER)]
    targets = np.concatenate([[sight.hand, sight.handle], upper, sight.panel])
    shown = _in_images(camera, transform_points(inverse(T_world_cam), targets))
    free = _unblocked(scene, eye, targets) & shown
    clear = free[:2] & ~_behind_body(eye, targets[:2], sight.joints, sight.acting)
    body = slice(2, 2 + len(upper))
    way = eye - sight.handle
    flat = abs(way @ sight.front) / np.linalg.norm(way)
    if scene.markers:
        read = _readable(scene, T_world_cam, camera, sight)
        held = np.linalg.norm(sight.hand - sight.handle) < _HELD_M
        score = (_WEIGHTS_HELD if held else _WEIGHTS) @ (read["hand"], read[OBJECT], read["torso"], free[body].mean())
    else:
        panel = free[body.stop :].mean() * (flat > _GRAZING)
        score = 0.25 * clear[0] + 0.1 * clear[1] + 0.25 * panel + 0.25 * free[body].mean() + 0.15 * shown[body].all()
    too_near = np.linalg.norm(sight.joints[JOINT["neck"]] - eye) < _NEAREST_M or shown[body].mean() < 0.8
    return float(score) - 0.5 * too_near


def _readable(
    scene: Scene, T_world_cam: Float[np.ndarray, "4 4"], camera: RGBDCamera, sight: _Sight
) -> dict[str, bool]:
    """Of each thing that carries markers, whether all of one of them is seen well enough to be read."""
    eye = T_world_cam[:3, 3]
    T = np.array([sight.carriers[m.on] @ inverse(m.T_marker_frame) for m in scene.markers])
    sizes = np.array([m.size_m for m in scene.markers])
    way = eye - T[:, :3, 3]
    far = np.linalg.norm(way, axis=1)
    facing = np.sum(way * T[:, :3, 2], axis=1) / far
    least_cosine, least_px = _READABLE
    clear = (facing > least_cosine) & (facing * sizes * camera.color.fx / far > least_px)
    corners = np.einsum("nij,nkj->nki", T[:, :3, :3], sizes[:, None, None] / 2 * _CORNERS) + T[:, None, :3, 3]
    points = corners[clear].reshape(-1, 3)
    if len(points):
        free = _in_images(camera, transform_points(inverse(T_world_cam), points)) & _unblocked(scene, eye, points)
        free &= ~_behind_body(eye, points, sight.joints, "")
        clear[clear] = free.reshape(-1, len(_CORNERS)).all(axis=1)
    return {on: bool(clear[[m.on == on for m in scene.markers]].any()) for on in sight.carriers}


def _in_images(camera: RGBDCamera, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Inside both images, with a margin."""
    seen = np.ones(len(points), bool)
    in_depth = transform_points(inverse(camera.T_color_depth), points)
    for one, p in ((camera.color, points), (camera.depth, in_depth)):
        uv = one.project(p)
        with np.errstate(invalid="ignore"):
            inside = (uv > _MARGIN).all(-1) & (uv < (one.width - 1 - _MARGIN, one.height - 1 - _MARGIN)).all(-1)
        seen &= inside
    return seen


def _unblocked(scene: Scene, eye: Float[np.ndarray, "3"], targets: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points no furniture or wall hides."""
    way = targets - eye
    far = np.linalg.norm(way, axis=1)
    n = len(targets)
    hit, which = np.empty(n), np.empty(n, np.int32)
    rays = np.ascontiguousarray(way / far[:, None]).ravel()
    mujoco.mj_multiRay(scene.model, scene.data, eye, rays, None, 1, -1, which, hit, None, n, 20.0)
    return (hit < 0) | (hit > far - _THICK)


def _behind_body(
    eye: Float[np.ndarray, "3"], targets: Float[np.ndarray, "n 3"], joints: Float[np.ndarray, "18 3"], acting: str
) -> Bool[np.ndarray, " n"]:
    """Which points the person's own body hides; the acting forearm, which leads to the hand, does not count."""
    limbs = [limb for limb in _LIMBS if limb[0] != f"{acting}_elbow"]
    start = joints[[JOINT[limb[0]] for limb in limbs]]
    end = joints[[JOINT[limb[1]] for limb in limbs]]
    radius = np.repeat([limb[2] for limb in limbs], len(_ALONG))
    body = (start[:, None] + _ALONG[:, None] * (end - start)[:, None]).reshape(-1, 3) - eye
    way = targets - eye
    along = ((way @ body.T) / np.sum(way**2, axis=1)[:, None]).clip(0, 1)
    apart = np.linalg.norm(body - along[..., None] * way[:, None], axis=2)
    return np.asarray((apart < radius).any(axis=1))
