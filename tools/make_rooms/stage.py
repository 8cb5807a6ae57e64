"""One frame: who stands where, with what furniture, seen by a camera at what height; and its truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import common  # noqa: F401
import furniture as fu
import numpy as np
from common import SEED, Array, Rng, turn
from furniture import Prop
from layout import FACE_JOINTS
from meshes import Piece
from numpy.typing import NDArray
from people import Dressed, make_dressed
from posing import fit
from postures import POSTURES, Posed, make_posture
from rig import skin
from scipy.spatial import cKDTree
from sensor import Scene
from sensors import Sensor
from truth import joints_world, palms_world

Rect = tuple[Array, Array, float]  # centre, half size, yaw


@dataclass
class Actor:
    """A dressed person in a posture at a place."""

    dressed: Dressed
    posed: Posed
    yaw: float
    xy: Array
    rects: list[Rect]
    skin: Array

    def props(self) -> list[Prop]:
        """The things that belong to the posture, in the world."""
        return [p.moved(self.yaw, self.xy) for p in self.posed.props]

    def to_world(self, points: Array) -> Array:
        """Person's frame to world."""
        return points @ turn(self.yaw).T + np.array([*self.xy, 0.0])


@dataclass
class Frame:
    """Everything of one frame, in the world."""

    actors: list[Actor]
    props: list[Prop]
    pose: Array  # colour camera in the world
    rng: Rng


def _rect(points: Array, yaw: float = 0.0) -> Rect:
    flat = points[:, :2] @ turn(yaw)[:2, :2]
    low, high = flat.min(0), flat.max(0)
    return turn(yaw)[:2, :2] @ (0.5 * (low + high)), 0.5 * (high - low), yaw


def _corners(r: Rect) -> Array:
    c, h, yaw = r
    return c + (np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * h) @ turn(yaw)[:2, :2].T


def overlap(a: Rect, b: Rect, gap: float) -> bool:
    """Whether two rectangles on the floor come nearer than `gap` (separating axes)."""
    ca, cb = _corners(a), _corners(b)
    for yaw in (a[2], b[2]):
        axes = turn(yaw)[:2, :2]
        pa, pb = ca @ axes, cb @ axes
        if ((pa.min(0) > pb.max(0) + gap) | (pb.min(0) > pa.max(0) + gap)).any():
            return False
    return True


def _clash(rects: list[Rect], taken: list[Rect], gap: float) -> bool:
    return any(overlap(a, b, gap) for a in rects for b in taken)


def _moved(rects: list[Rect], yaw: float, xy: Array) -> list[Rect]:
    return [(turn(yaw)[:2, :2] @ c + xy, h, y + yaw) for c, h, y in rects]


def _prop_rects(props: list[Prop]) -> list[Rect]:
    return [_rect(p.vertices, p.yaw) for p in props if p.name not in ("post", "bar")]


def _place(
    posed: Posed, rng: Rng, dist: float, fov: tuple[float, float], edge: bool, taken: list[Rect], near: list[float]
) -> tuple[float, Array, list[Rect]] | None:
    """Yaw and place for a person that does not run into what stands already."""
    local = [_rect(posed.skin), *_prop_rects(posed.props)]
    for _ in range(40):
        if edge:
            bearing = float(rng.choice([-1, 1])) * 0.5 * rng.choice(fov) * rng.uniform(0.9, 1.1)
        elif near and rng.random() < 0.45:  # behind or before someone else, as the camera sees it
            bearing = near[int(rng.integers(len(near)))] + rng.normal(0, 0.14)
        else:
            bearing = 0.5 * min(fov) * rng.uniform(-0.85, 0.85)
        d = dist * rng.uniform(0.93, 1.07)
        xy = d * np.array([np.sin(bearing), np.cos(bearing)])
        to_camera = np.arctan2(-xy[1], -xy[0])  # direction to the camera; yaw 0 faces -y, an angle of -pi / 2
        facing = to_camera + np.pi / 2
        yaw = facing + (rng.normal(0, 0.7) if rng.random() < 0.4 else rng.uniform(-np.pi, np.pi))
        if posed.facing == "away":
            yaw = facing + float(rng.choice([-1, 1])) * rng.uniform(1.2, np.pi)
        rects = _moved(local, yaw, xy)
        if min(c[1] for r in rects for c in _corners(r)) < -0.6:
            continue
        if not _clash(rects, taken, 0.04):
            return yaw, xy, rects
    return None


def camera_pose(height: float, pitch: float, roll: float) -> Array:
    """Colour camera over the origin, looking along y and down by `pitch`."""
    s, c = np.sin(pitch), np.cos(pitch)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[1, 0, 0], [0, -s, -c], [0, c, -s]], 1)
    cr, sr = np.cos(roll), np.sin(roll)
    pose[:3, :3] = pose[:3, :3] @ np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    pose[2, 3] = height
    return pose


def _hits(prop: Prop, actors: list[Actor]) -> bool:
    return prop.centre is not None and any(int((prop.inside(a.skin) > 0.02).sum()) > 12 for a in actors)


def plan(sensor: Sensor, index: int, attempt: int) -> tuple[list[str], int, Rng]:
    """Postures and number of people of a frame; every posture comes round before any repeats."""
    names = list(POSTURES)
    counts = np.random.default_rng([SEED, len(sensor.name), 5]).permutation([1, 2, 3, 2, 1, 2, 3, 1] * 25)
    deck: list[str] = []
    shuffle = np.random.default_rng([SEED, len(sensor.name), 6])
    while len(deck) < int(counts[: index + 1].sum()):
        deck += [names[k] for k in shuffle.permutation(len(names))]
    start = int(counts[:index].sum())
    return (
        deck[start : start + int(counts[index])],
        index,
        np.random.default_rng([SEED, len(sensor.name), index, attempt]),
    )


def cast_people(sensor: Sensor, index: int) -> list[Dressed]:
    """The people of a frame, the same in every attempt."""
    names = plan(sensor, index, 0)[0]
    seeds = [[SEED, len(sensor.name), index, 2000 + k] for k in range(len(names))]
    return [make_dressed(np.random.default_rng(seed), f"P{k}") for k, seed in enumerate(seeds)]


def compose(sensor: Sensor, index: int, attempt: int, people: list[Dressed]) -> Frame | None:
    """People, furniture, room and camera of a frame; None where it does not fit together."""
    names, _, rng = plan(sensor, index, attempt)
    fov = tuple(
        float(2 * np.arctan(0.5 * size[0] / k[0, 0]))
        for size, k in ((sensor.color_size, sensor.color_k), (sensor.depth_size, sensor.depth_k))
    )
    actors: list[Actor] = []
    camera: Rect = (np.zeros(2), np.array([0.28, 0.28]), 0.0)
    taken, near = [camera], []
    height = float(rng.uniform(0.8, 2.2))
    dists = 1.2 + 4.2 * rng.random(len(names)) ** 1.25
    for k, name in enumerate(names):
        dressed = people[k]
        posed = make_posture(fit(dressed.body), name, rng)
        if posed is None:
            return None
        edge = bool(rng.random() < 0.2)
        spot = None
        for step in range(4):
            dist = float(dists[k]) if step < 2 else float(rng.uniform(1.4, 5.3))
            spot = _place(posed, rng, dist, fov, edge and step < 2, taken, near)
            if spot is not None:
                break
        if spot is None:
            if actors:
                continue
            return None
        yaw, xy, rects = spot
        actor = Actor(dressed, posed, yaw, xy, rects, np.zeros((0, 3)))
        actor.skin = actor.to_world(posed.skin)
        if any(cKDTree(a.skin[::4]).query(actor.skin[::4])[0].min() < 0.05 for a in actors):
            continue
        actors.append(actor)
        taken += rects
        near.append(float(np.arctan2(xy[0], xy[1])))

    props = [p for a in actors for p in a.props()]
    if any(_hits(p, [b for b in actors if b is not a]) for a in actors for p in a.props()):
        return None
    for a in actors:  # things that hide a part of a person
        if rng.random() < 0.3:
            group = fu.occluder(rng)
            d = float(np.linalg.norm(a.xy))
            gap = rng.uniform(0.5, 1.1)
            if d - gap < 0.9:
                continue
            xy = a.xy * (1 - gap / d) + rng.normal(0, 0.15, 2)
            yaw = -np.arctan2(xy[0], xy[1]) + rng.normal(0, 0.3)
            moved = [p.moved(yaw, xy) for p in group]
            rects = _prop_rects(moved)
            if not _clash(rects, taken, 0.03) and not any(_hits(p, actors) for p in moved):
                props += moved
                taken += rects

    corners = np.concatenate([_corners(r) for r in taken])
    low, high = corners.min(0), corners.max(0)
    x0, x1 = low[0] - rng.uniform(0.08, 1.3), high[0] + rng.uniform(0.08, 1.3)
    x0, x1 = min(x0, -1.0), max(x1, 1.0)
    y0 = min(low[1], -0.3) - rng.uniform(0.1, 0.9)
    y1 = max(high[1] + rng.uniform(0.08, 1.4), 2.4)
    top = max(2.45, height + 0.25) + rng.uniform(0.0, 0.4)
    for _ in range(int(rng.integers(3, 9))):
        group = fu.against_wall(rng)
        side = rng.integers(3)
        if side == 0:
            yaw, xy = 0.0, np.array([rng.uniform(x0 + 0.4, x1 - 0.4), y1 - 0.02])
        elif side == 1:
            yaw, xy = np.pi / 2, np.array([x0 + 0.02, rng.uniform(0.6, y1 - 0.4)])
        else:
            yaw, xy = -np.pi / 2, np.array([x1 - 0.02, rng.uniform(0.6, y1 - 0.4)])
        moved = [p.moved(yaw, xy) for p in group]
        rects = _prop_rects(moved)
        c = np.concatenate([_corners(r) for r in rects])
        if (c < [x0 - 0.01, y0 - 0.01]).any() or (c > [x1 + 0.01, y1 + 0.01]).any():
            continue
        if max(p.vertices[:, 2].max() for p in moved) > 1.2 and np.linalg.norm(c, axis=1).min() < 2.0:
            continue  # it would fill the picture
        if not _clash(rects, taken, 0.03) and not any(_hits(p, actors) for p in moved):
            props += moved
            taken += rects
    props += fu.walls(rng, x0, x1, y0, y1, top)

    main = actors[0]
    d = float(np.linalg.norm(main.xy))
    aim = float(rng.uniform(0.55, 0.75)) * float(main.skin[:, 2].max())
    pitch = float(np.clip(np.arctan2(height - aim, d) * rng.uniform(0.75, 1.1) + rng.normal(0, 0.07), -0.2, 0.75))
    pose = camera_pose(height, pitch, float(rng.normal(0, 0.015)))
    return Frame(actors, props, pose, rng)


@dataclass
class Meshes:
    """All triangles of a frame, and per face: owner (-1 things), darkness, colour, mesh number."""

    vertices: Array
    faces: NDArray[np.int64]
    owner: NDArray[np.int32]
    dark: Array
    color: Array
    parts: list[tuple[str, str, Array, NDArray[np.int64], Array, Array, Array | None, bool]]


def meshes(frame: Frame) -> Meshes:
    """Skin all clothes and gather the triangles."""
    vertices, faces, owner, dark, color, parts, n = [], [], [], [], [], [], 0

    def add(
        name: str, v: Array, f: Any, who: int, shade: float, tint: Array, material: str, piece: Piece | None
    ) -> None:
        nonlocal n
        vertices.append(v)
        faces.append(f + n)
        owner.append(np.full(len(f), who, np.int32))
        dark.append(np.full(len(f), shade))
        color.append(tint[f].mean(1) if tint.ndim == 2 else np.tile(tint, (len(f), 1)))
        rest = v if piece is None else piece.vertices
        parts.append((name, material, v, f, tint, rest, None if piece is None else piece.st, piece is not None))
        n += len(v)

    for k, a in enumerate(frame.actors):
        b = a.dressed.body
        for piece, shade in zip(a.dressed.pieces, a.dressed.dark, strict=True):
            v = a.to_world(skin(piece.vertices, piece.weights, b.heads, a.posed.rot, a.posed.pos))
            if piece.name in ("skirt", "coat"):
                v[:, 2] = np.maximum(v[:, 2], 0.01)
            add(f"{k}.{piece.name}", v, piece.faces, k, shade, piece.color, piece.material, piece)
    for p in frame.props:
        add(p.name, p.vertices, p.faces, -1, p.dark, np.array(p.color), p.material, None)
    cat = np.concatenate
    return Meshes(cat(vertices), cat(faces), cat(owner), cat(dark), cat(color), parts)


def _limits(a: Actor) -> Array:
    """By how much the own surface may lie before a joint that still counts as seen (as in make_sample, by build)."""
    f = fit(a.dressed.body)
    limit = np.full(18, 0.12)
    limit[list(FACE_JOINTS)] = 0.06
    thick = 0.5 * (f.surface(f.hip, True) - f.surface(f.hip))
    limit[[8, 11]] = np.clip(thick + 0.015, 0.15, 0.22)
    return limit


def truth_of(frame: Frame, scene: Scene, mesh: Meshes, sensor: Sensor) -> list[dict[str, Any]]:
    """The people of a frame for truth.json."""
    out = []
    pose = frame.pose
    size = np.array(sensor.color_size)

    def inside(cam: Array) -> NDArray[np.bool_]:
        uvw = cam @ sensor.color_k.T
        uv = uvw[:, :2] / np.where(np.abs(uvw[:, 2:]) < 1e-6, 1e-6, uvw[:, 2:])
        return (cam[:, 2] > 0.05) & (uv >= -0.5).all(1) & (uv < size - 0.5).all(1)

    for number, a in enumerate(frame.actors):
        b = a.dressed.body
        world = a.to_world(joints_world(b, a.posed.rot, a.posed.pos))
        cam = ((world - pose[:3, 3]) @ pose[:3, :3]).round(5)
        cam[1] = (0.5 * (cam[2] + cam[5])).round(6)
        reach, face, _ = scene.cast(pose[:3, 3], world - pose[:3, 3])
        distance = np.linalg.norm(world - pose[:3, 3], axis=1)
        before = distance * (1.0 - reach)
        own = (face >= 0) & (mesh.owner[np.maximum(face, 0)] == number)
        occluded = (face >= 0) & (reach > 0) & (before > np.where(own, _limits(a), 0.0))
        hands = {}
        for name, (centre, normal) in palms_world(b, a.posed.pos).items():
            c = (a.to_world(centre[None]) - pose[:3, 3]) @ pose[:3, :3]
            n = pose[:3, :3].T @ turn(a.yaw) @ normal
            hands[name] = {"normal": [round(float(x), 5) for x in n], "in_view": bool(inside(c)[0])}
        out.append(
            {
                "id": number,
                "keypoints": [[round(float(x), 6) for x in p] for p in cam],
                "in_view": [bool(x) for x in inside(cam)],
                "occluded": [bool(x) for x in occluded],
                "hands": hands,
                "posture": a.posed.name,
            }
        )
    return out
