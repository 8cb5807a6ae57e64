"""Exact depth recordings of a person who opens something: boxes and capsules, ray-cast, with a Kinect v2's noise.

World before the last turn about z: the furniture's front is the plane y = 0 and faces -y; z is up, the floor z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from understudy.camera import Camera, RGBDCamera
from understudy.geometry import inverse, rigid, transform_points
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation, Handle
from understudy.registration import register
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Frame, Keypoints2D, Person, RegisteredFrame

TASKS = ("room_door", "swivel_door", "drawer", "sliding_door")
COLOR = Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))
DEPTH = Camera(512, 424, np.array([[365.0, 0, 255.5], [0, 365.0, 211.5], [0, 0, 1.0]]))
KINECT = RGBDCamera(COLOR, DEPTH, rigid(np.eye(3), np.array([0.052, 0.0, 0.0])))
_FAR = 9.0


@dataclass(frozen=True, eq=False)
class Box:
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class Capsule:
    a: np.ndarray
    b: np.ndarray
    radius: float


Shape = Box | Capsule


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands there at rest, and how it moves."""

    static: list[Shape]
    part: list[Shape]
    """at rest, world"""
    articulation: Articulation
    """of the handle's frame"""
    handle: Handle
    opening: float


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated recording with its truth."""

    frames: list[RegisteredFrame]
    people: list[list[Person]]
    T_world_cam: np.ndarray
    times_s: np.ndarray
    hand: np.ndarray
    """true mid-palm, world (t, 3)"""
    hint: np.ndarray
    """what a tracker would say"""
    q: np.ndarray
    T_world_handle: np.ndarray
    scene: Scene
    task: str = ""
    joints: np.ndarray = field(default_factory=lambda: np.zeros(0))


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Box:
    return Box(np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]]))


def make_scene(task: str, rng: np.random.Generator) -> Scene:
    """One task with random sizes."""
    make = {"room_door": _room_door, "swivel_door": _swivel_door, "drawer": _drawer, "sliding_door": _sliding_door}
    return make[task](rng)


def _hollow(x: tuple[float, float], depth: float, z: tuple[float, float], t: float = 0.018) -> list[Shape]:
    """A cupboard's body behind the front plane, open to the front."""
    return [
        box((x[0], x[0] + t), (0, depth), z),
        box((x[1] - t, x[1]), (0, depth), z),
        box(x, (0, depth), (z[0], z[0] + t)),
        box(x, (0, depth), (z[1] - t, z[1])),
        box(x, (depth - t, depth), z),
    ]


def _bar(center: np.ndarray, along: np.ndarray, handle: Handle) -> list[Shape]:
    """A bar in front of the front, on two posts."""
    half, into = along * handle.length_m / 2, np.array([0, handle.standoff_m, 0])
    ends = [center - half, center + half]
    return [Capsule(ends[0], ends[1], handle.radius_m)] + [
        Capsule(e * 0.9 + center * 0.1, e * 0.9 + center * 0.1 + into, handle.radius_m * 0.8) for e in ends
    ]


def handle_frame(center: np.ndarray, level: bool) -> np.ndarray:
    """The handle's frame: x out of the front (-y), z up, or y up for a level bar."""
    x, up = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
    R = np.column_stack([x, up, np.cross(x, up)]) if level else np.column_stack([x, np.cross(up, x), up])
    return rigid(R, center)


def _hinged(T: np.ndarray, hinge: np.ndarray, right: bool, outwards: bool, opening: float) -> Articulation:
    """A leaf that turns about a vertical line. Hinge at greater x: turns with +z to come out (towards -y)."""
    sign = (1.0 if right else -1.0) * (1.0 if outwards else -1.0)
    axis = np.array([0, 0, sign])
    point = np.array([hinge[0], hinge[1], T[2, 3]])
    return Articulation(REVOLUTE, T, axis, point, (0.0, opening))


def _swivel_door(rng: np.random.Generator) -> Scene:
    w, h, t = rng.uniform(0.3, 0.6), rng.uniform(0.45, 0.8), rng.uniform(0.016, 0.025)
    z0 = rng.choice([0.1, 0.8, 1.2])
    right = bool(rng.random() < 0.5)
    gap = 0.002
    static = [*_room(), *_hollow((-w / 2, w / 2), 0.4, (z0, z0 + h))]
    other = w if rng.random() < 0.6 else 0.0  # a second door beside it that stays shut
    if other:
        x = (-w / 2 - other, -w / 2) if right else (w / 2, w / 2 + other)
        static += [*_hollow(x, 0.4, (z0, z0 + h)), box((x[0] + gap, x[1] - gap), (-t, 0), (z0, z0 + h))]
    door = box((-w / 2 + gap, w / 2 - gap), (-t, 0), (z0 + gap, z0 + h - gap))
    handle = Handle(rng.uniform(0.1, 0.22), rng.uniform(0.006, 0.01), rng.uniform(0.03, 0.045))
    side = -1 if right else 1
    center = np.array([side * (w / 2 - rng.uniform(0.03, 0.06)), -t - handle.standoff_m, 0])
    center[2] = z0 + h * rng.uniform(0.35, 0.65)
    T = handle_frame(center, level=False)
    opening = np.radians(rng.uniform(50, 100))
    hinge = np.array([(1 if right else -1) * w / 2, 0.0])
    part = [door, *_bar(center, np.array([0, 0, 1.0]), handle)]
    return Scene(static, part, _hinged(T, hinge, right, True, opening), handle, opening)


def _room_door(rng: np.random.Generator) -> Scene:
    w, h, t = rng.uniform(0.8, 0.95), 2.0, 0.04
    right, outwards = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    wall = (0.0, 0.12)
    static: list[Shape] = [
        box((-6, 6), (-8, 8), (-0.2, 0)),
        box((-4, -w / 2), wall, (0, 2.6)),
        box((w / 2, 4), wall, (0, 2.6)),
        box((-w / 2, w / 2), wall, (h, 2.6)),
        box((-5, 5), (2.5, 2.7), (0, 2.6)),
    ]
    y = (0.0, t) if outwards else (0.12 - t, 0.12)
    leaf = box((-w / 2 + 0.003, w / 2 - 0.003), y, (0.005, h - 0.003))
    handle = Handle(rng.uniform(0.11, 0.14), rng.uniform(0.009, 0.012), rng.uniform(0.05, 0.065))
    side = -1 if right else 1
    center = np.array([side * (w / 2 - 0.07 - handle.length_m / 2), y[0] - handle.standoff_m, rng.uniform(0.95, 1.1)])
    T = handle_frame(center, level=True)
    end = center + np.array([side * handle.length_m / 2, 0, 0])
    lever: list[Shape] = [
        Capsule(center - (end - center), end, handle.radius_m),
        Capsule(end, end + np.array([0, handle.standoff_m, 0]), handle.radius_m),
    ]
    opening = np.radians(rng.uniform(50, 95))
    hinge = np.array([(1 if right else -1) * w / 2, y[0] if outwards else y[1]])
    return Scene(static, [leaf, *lever], _hinged(T, hinge, right, outwards, opening), handle, opening)


def _drawer(rng: np.random.Generator) -> Scene:
    w, h, t, gap = rng.uniform(0.3, 0.8), rng.uniform(0.12, 0.3), 0.02, 0.002
    n = int(rng.integers(2, 4))
    k = int(rng.integers(0, n))
    z0 = rng.uniform(0.05, 0.4)
    static = [*_room(), *_hollow((-w / 2, w / 2), 0.5, (z0, z0 + n * h))]
    for i in range(n):
        if i != k:
            static.append(box((-w / 2, w / 2), (-t, 0), (z0 + i * h + gap, z0 + (i + 1) * h - gap)))
    z = (z0 + k * h + gap, z0 + (k + 1) * h - gap)
    inner = (-w / 2 + 0.03, w / 2 - 0.03)
    part: list[Shape] = [
        box((-w / 2, w / 2), (-t, 0), z),
        box((inner[0], inner[0] + 0.01), (0, 0.45), (z[0] + 0.02, z[1] - 0.03)),
        box((inner[1] - 0.01, inner[1]), (0, 0.45), (z[0] + 0.02, z[1] - 0.03)),
        box(inner, (0, 0.45), (z[0] + 0.02, z[0] + 0.03)),
    ]
    handle = Handle(rng.uniform(0.1, min(0.25, 0.6 * w)), rng.uniform(0.006, 0.01), rng.uniform(0.028, 0.045))
    center = np.array([rng.uniform(-0.05, 0.05), -t - handle.standoff_m, (z[0] + z[1]) / 2 + rng.uniform(-0.02, 0.02)])
    travel = rng.uniform(0.2, 0.45)
    T = handle_frame(center, level=True)
    motion = Articulation(PRISMATIC, T, np.array([0, -1.0, 0]), center, (0.0, travel))
    return Scene(static, [*part, *_bar(center, np.array([1.0, 0, 0]), handle)], motion, handle, travel)


def _sliding_door(rng: np.random.Generator) -> Scene:
    w, h, t = rng.uniform(0.6, 0.95), rng.uniform(1.2, 2.0), 0.02
    z0, side = 0.06, (1 if rng.random() < 0.5 else -1)
    left, right = (-w / 2, w / 2), (w / 2 - 0.03, w / 2 + w - 0.03)
    if side < 0:
        right = (-right[1], -right[0])
    both = (min(left[0], right[0]), max(left[1], right[1]))
    depth = rng.uniform(0.03, 0.05)
    static = [*_room(), *_hollow(both, 0.5, (z0, z0 + h)), box(right, (-t, 0), (z0, z0 + h))]
    front = -t - depth
    door = box(left, (front, front + t), (z0 + 0.01, z0 + h - 0.01))
    handle = Handle(rng.uniform(0.15, 0.3), rng.uniform(0.008, 0.012), rng.uniform(0.03, 0.045))
    center = np.array(
        [-side * (w / 2 - rng.uniform(0.05, 0.08)), front - handle.standoff_m, z0 + rng.uniform(0.8, 1.0)]
    )
    travel = rng.uniform(0.3, min(0.7, w - 0.1))
    T = handle_frame(center, level=False)
    motion = Articulation(PRISMATIC, T, np.array([side, 0.0, 0]), center, (0.0, travel))
    return Scene(static, [door, *_bar(center, np.array([0, 0, 1.0]), handle)], motion, handle, travel)


def _room() -> list[Shape]:
    return [box((-6, 6), (-8, 8), (-0.2, 0)), box((-5, 5), (0.55, 0.75), (0, 2.6))]


def view(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """T_world_cam: 2 to 3.5 m off, at the side or behind the person, towards the handle's middle way."""
    way = scene.articulation.pose(np.array([0.0, scene.opening]))[:, :3, 3].mean(0)
    way[2] = 0.5 * way[2] + 0.45
    behind = rng.random() < 0.35
    side = rng.choice([-1, 1])
    if scene.articulation.radius_m > 0.6:  # a room door is seen from the side that it opens to
        side = -np.sign(scene.articulation.point[0])
    if way[1] > scene.articulation.T_rest[1, 3]:  # and through the doorway, if it opens into the next room
        behind = True
    azimuth = side * np.radians(rng.uniform(24, 36) if behind else rng.uniform(40, 68))
    distance = rng.uniform(2.0, 3.5)
    eye = way + distance * np.array([np.sin(azimuth), -np.cos(azimuth), 0])
    eye[2] = rng.uniform(1.3, 1.9)
    z = (way - eye) / np.linalg.norm(way - eye)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), eye)


def cast(shapes: list[Shape], T_cam_shape: np.ndarray, camera: Camera, depth: np.ndarray) -> None:
    """Draws shapes into a z-buffer (metres, inf = nothing)."""
    for shape in shapes:
        window = _window(shape, T_cam_shape, camera)
        if window is None:
            continue
        v0, v1, u0, u1 = window
        u, v = np.meshgrid(np.arange(u0, u1), np.arange(v0, v1))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        T = inverse(T_cam_shape)
        directions, origin = rays @ T[:3, :3].T, T[:3, 3]
        z = _hit_box(shape, origin, directions) if isinstance(shape, Box) else _hit_capsule(shape, origin, directions)
        patch = depth[v0:v1, u0:u1]
        np.minimum(patch, z, out=patch)


def _window(shape: Shape, T: np.ndarray, camera: Camera) -> tuple[int, int, int, int] | None:
    """Rows and columns that the shape may cover."""
    if isinstance(shape, Box):
        low, high = shape.low, shape.high
    else:
        low, high = np.minimum(shape.a, shape.b) - shape.radius, np.maximum(shape.a, shape.b) + shape.radius
    corners = np.array(np.meshgrid(*np.stack([low, high], 1), indexing="ij")).reshape(3, -1).T
    p = transform_points(T, corners)
    if p[:, 2].max() < 0.2:
        return None
    if p[:, 2].min() < 0.2:
        return 0, camera.height, 0, camera.width
    uv = camera.project(p)
    (u0, v0), (u1, v1) = np.floor(uv.min(0)), np.ceil(uv.max(0)) + 1
    u0, u1 = (int(np.clip(x, 0, camera.width)) for x in (u0, u1))
    v0, v1 = (int(np.clip(x, 0, camera.height)) for x in (v0, v1))
    return (v0, v1, u0, u1) if u1 > u0 and v1 > v0 else None


def _hit_box(shape: Box, origin: np.ndarray, d: np.ndarray) -> np.ndarray:
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    a, b = (shape.low - origin) / d, (shape.high - origin) / d
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((near < far) & (near > 0), near, np.inf)


def _hit_capsule(shape: Capsule, origin: np.ndarray, d: np.ndarray) -> np.ndarray:
    """z along rays d (unit z) of the surface: cylinder between the ends, spheres at both."""
    ab = shape.b - shape.a
    out = np.full(d.shape[:-1], np.inf)
    with np.errstate(invalid="ignore", divide="ignore"):
        length = ab @ ab
        if length > 1e-12:
            oa = origin - shape.a
            d_, o_ = d - np.multiply.outer(d @ ab, ab) / length, oa - ab * (oa @ ab) / length
            z = _root((d_**2).sum(-1), d_ @ o_, o_ @ o_ - shape.radius**2)
            along = (oa + z[..., None] * d) @ ab / length
            out = np.where((along >= 0) & (along <= 1) & (z > 0), z, out)
        for end in (shape.a, shape.b):
            o = origin - end
            z = _root((d**2).sum(-1), d @ o, o @ o - shape.radius**2)
            out = np.fmin(out, np.where(z > 0, z, np.inf))
    return np.where(np.isnan(out), np.inf, out)


def _root(a: np.ndarray, b: np.ndarray, c: float) -> np.ndarray:
    """Smaller root of a z^2 + 2 b z + c; NaN where there is none."""
    return (-b - np.sqrt(b * b - a * c)) / a


def sense(z: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Exact depth -> what a Kinect v2 says (Fankhauser's axial noise, flying pixels, holes)."""
    z = np.where(np.isfinite(z) & (z < _FAR), z, 0.0)
    v, u = np.gradient(np.where(z > 0, z, _FAR))
    slope = np.arctan(np.hypot(u * camera.fx, v * camera.fy) / np.maximum(z, 0.3)).clip(0, 1.5)
    sigma = 0.0015 - 0.0005 * z + 0.0003 * z**2 + 0.0001 * z**1.5 * slope**2 / (np.pi / 2 - slope) ** 2
    near, far = minimum_filter(np.where(z > 0, z, _FAR), 3), maximum_filter(z, 3)
    edge = far - near > 0.05 + 0.25 * (slope > 1.35) * z
    dice = rng.random(z.shape)
    out = z + rng.normal(size=z.shape) * np.minimum(sigma, 0.03)
    out = np.where(edge & (dice < 0.12), near + (far - near) * rng.random(z.shape) ** 2, out)
    hole = (edge & (dice > 0.8)) | (rng.random(z.shape) < 0.005) | (z == 0) | (rng.random(z.shape) < (slope - 1.3) * 3)
    return np.where(hole | (out < 0.3), 0, out).astype(np.float32)


def minimum_jerk(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def _stance(scene: Scene, handles: np.ndarray) -> np.ndarray:
    """Where the person stands (x, y), clear of the sweep."""
    away = np.zeros(3)
    if scene.articulation.kind == REVOLUTE:
        away = handles[0] - scene.articulation.point
        away = np.array([np.sign(away[0]), 0, 0])
    back = np.array([0.15 * away[0], -0.55, 0])
    return (handles + back)[:, :2]


def person_joints(hip: np.ndarray, hand: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """18 joints of a person who stands at hip (x, y), faces a direction and has the right hand at a point."""
    right = np.array([facing[1], -facing[0], 0])
    at = np.array([hip[0], hip[1], 0])
    up = np.array([0, 0, 1.0])
    j = np.full((N_JOINTS, 3), np.nan)
    lean = 0.2 * facing * float(np.clip(1.2 - hand[2], 0, 0.6))
    for side, s in (("right", 1), ("left", -1)):
        j[JOINT[f"{side}_hip"]] = at + 0.1 * s * right + 0.95 * up
        j[JOINT[f"{side}_knee"]] = at + 0.1 * s * right + 0.5 * up
        j[JOINT[f"{side}_ankle"]] = at + 0.1 * s * right + 0.08 * up
        j[JOINT[f"{side}_shoulder"]] = at + 0.19 * s * right + (1.45 * up if hand[2] > 0.7 else 1.3 * up) + lean
    neck = (j[JOINT["right_shoulder"]] + j[JOINT["left_shoulder"]]) / 2
    j[JOINT["neck"]] = neck
    j[JOINT["nose"]] = neck + 0.2 * up + 0.1 * facing
    shoulder = j[JOINT["right_shoulder"]]
    wrist = hand + 0.09 * (shoulder - hand) / np.linalg.norm(shoulder - hand)
    j[JOINT["right_wrist"]] = wrist
    bend = np.sqrt(max(0.29**2 - np.linalg.norm(wrist - shoulder) ** 2 / 4, 0.0))
    j[JOINT["right_elbow"]] = (shoulder + wrist) / 2 - bend * up
    j[JOINT["left_elbow"]] = j[JOINT["left_shoulder"]] - 0.3 * up
    j[JOINT["left_wrist"]] = j[JOINT["left_shoulder"]] - 0.55 * up
    return j


def person_shapes(j: np.ndarray, hand: np.ndarray) -> list[Shape]:
    """Capsules around the joints."""

    def limb(a: str, b: str, r: float) -> Shape:
        return Capsule(j[JOINT[a]], j[JOINT[b]], r)

    out: list[Shape] = [Capsule(j[JOINT["right_wrist"]], hand, 0.045)]
    for s in ("right", "left"):
        out += [limb(f"{s}_shoulder", f"{s}_elbow", 0.055), limb(f"{s}_elbow", f"{s}_wrist", 0.042)]
        out += [limb(f"{s}_hip", f"{s}_knee", 0.085), limb(f"{s}_knee", f"{s}_ankle", 0.06)]
        out += [limb(f"{s}_shoulder", f"{s}_hip", 0.12)]
    out.append(Capsule(j[JOINT["nose"]], j[JOINT["nose"]] + [0, 0, 0.05], 0.11))
    return out


def record(
    task: str,
    seed: int,
    n: int = 80,
    hz: float = 10.0,
    still: bool = False,
    passer_by: bool = False,
    camera: RGBDCamera = KINECT,
) -> Recording:
    """Simulates one recording of n frames. still: the hand makes all its movements, but nothing moves."""
    rng = np.random.default_rng([TASKS.index(task), seed])
    scene = make_scene(task, rng)
    T_world_cam = view(scene, rng)
    times = np.arange(n) / hz
    begin, end = rng.uniform(0.22, 0.3), rng.uniform(0.72, 0.8)
    q = scene.opening * minimum_jerk((times / times[-1] - begin) / (end - begin))
    T_handle = scene.articulation.pose(q)
    held = (times / times[-1] > begin - 0.04) & (times / times[-1] < end + 0.02)
    hand, hips = _hand_and_hips(scene, T_handle, times / times[-1], held, np.flatnonzero(held)[[0, -1]])
    if still:
        q, T_handle = np.zeros(n), scene.articulation.pose(np.zeros(n))
        scene = Scene(
            scene.static, scene.part, Articulation(FIXED, T_handle[0], np.eye(3)[0], T_handle[0, :3, 3], (0, 0)),
            scene.handle, 0.0,
        )  # fmt: skip
    moved = scene.articulation.pose(q) @ inverse(scene.articulation.T_rest)
    background = np.full((camera.depth.height, camera.depth.width), np.inf)
    T_depth_world = inverse(camera.T_color_depth) @ inverse(T_world_cam)
    cast(scene.static, T_depth_world, camera.depth, background)
    turn = rigid(Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix(), rng.normal(size=3) * [1, 1, 0])
    frames, people, joints = [], [], []
    color = np.full((camera.color.height, camera.color.width, 3), 128, np.uint8)
    walk = np.linspace(-2.5, 2.5, n)
    for i in range(n):
        z = background.copy()
        cast(scene.part, T_depth_world @ moved[i], camera.depth, z)
        bodies = [person_joints(hips[i], hand[i], np.array([0, 1.0, 0]))]
        cast(person_shapes(bodies[0], hand[i]), T_depth_world, camera.depth, z)
        if passer_by:
            at = T_world_cam[:3, 3] + 0.55 * (hips[i, 0] * 0 + 1) * (T_world_cam[:3, 2] * 1.4)
            at = at + walk[i] * T_world_cam[:3, 0]
            other = person_joints(at[:2], np.array([at[0] + 0.2, at[1], 0.75]), T_world_cam[:3, 0] * [1, 1, 0])
            cast(person_shapes(other, np.array([at[0] + 0.2, at[1], 0.75])), T_depth_world, camera.depth, z)
            bodies.append(other)
        depth = sense(z, camera.depth, rng)
        frames.append(register(Frame(color, depth, camera, i, float(times[i]))))
        noisy = [b + rng.normal(size=3) * 0.015 + rng.normal(size=b.shape) * 0.025 for b in bodies]
        people.append([_person(transform_points(inverse(T_world_cam), b)) for b in noisy])
        joints.append(transform_points(turn, noisy[0]))
    hint = hand + _hand_noise(rng, n)
    articulation = scene.articulation.moved(turn)
    scene = Scene(scene.static, scene.part, articulation, scene.handle, scene.opening)
    return Recording(
        frames, people, turn @ T_world_cam, times, transform_points(turn, hand), transform_points(turn, hint),
        q, turn @ T_handle, scene, task, np.array(joints),
    )  # fmt: skip


def _hand_and_hips(
    scene: Scene, T_handle: np.ndarray, s: np.ndarray, held: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mid-palm (t, 3) and hips (t, 2): comes from behind, holds, follows, lets go, steps back."""
    grip = T_handle[:, :3, 3] + 0.03 * T_handle[:, :3, 0]
    stand = _stance(scene, T_handle[:, :3, 3])
    hand, hips = grip.copy(), stand.copy()
    a, b = ends
    before, after = np.arange(a), np.arange(b + 1, len(s))
    rest = np.append(stand[a] + [0.25, 0.1], 0.85)
    w = minimum_jerk(before / a * 1.6 - 0.6)[:, None]
    hand[before] = w * grip[a] + (1 - w) * rest
    hips[before] = stand[a] + (1 - minimum_jerk(before / a * 1.3))[:, None] * np.array([0.1, -0.5])
    hand[before] += np.column_stack([hips[before] - stand[a], np.zeros(a)]) * (1 - w)
    w = minimum_jerk((after - b) / max(len(after), 1) * 1.4)[:, None]
    back = np.append(stand[b] + [0.25, -0.3], 0.85)
    hand[after] = (1 - w) * grip[b] + w * back
    hips[after] = stand[b] + w * np.array([0.0, -0.4])
    return hand, hips


def _person(joints_cam: np.ndarray) -> Person:
    uv = COLOR.project(joints_cam)
    points = Keypoints2D.where(np.nan_to_num(uv), np.isfinite(uv).all(1) * 0.9)
    known = np.isfinite(joints_cam).all(1)
    return Person(
        points, joints_cam, known * 0.8, np.where(known, 0.05, np.nan),
        tuple("observed" if k else "missing" for k in known),
    )  # fmt: skip


def _hand_noise(rng: np.random.Generator, n: int) -> np.ndarray:
    """4 cm per axis... of correlated noise (about half a second), a constant part, and some gross errors."""
    noise = np.zeros((n, 3))
    state = rng.normal(size=3)
    for i in range(n):
        state = 0.82 * state + np.sqrt(1 - 0.82**2) * rng.normal(size=3)
        noise[i] = state
    noise = 0.025 * noise + 0.015 * rng.normal(size=3)
    gross = rng.random(n) < 0.06
    noise[gross] += rng.normal(size=(int(gross.sum()), 3)) * 0.1
    return noise
