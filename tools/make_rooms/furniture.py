"""Furniture and the room, from turned boxes and cylinders, each built in a frame of its own and then placed."""

from __future__ import annotations

from dataclasses import dataclass

import common  # noqa: F401
import numpy as np
from common import Array, Rng, turn
from meshes import Faces, box, grid_faces

WOODS = ((0.40, 0.23, 0.11), (0.30, 0.17, 0.085), (0.55, 0.42, 0.28), (0.12, 0.07, 0.04), (0.62, 0.60, 0.56))
Color = tuple[float, float, float]


@dataclass
class Prop:
    """A mesh; a box also keeps its centre, half size and yaw, for the collision checks."""

    name: str
    vertices: Array
    faces: Faces
    material: str
    color: Color
    centre: Array | None = None
    half: Array | None = None
    yaw: float = 0.0
    dark: float = 0.0
    held: bool = False  # touched on purpose: left out of the collision checks

    def moved(self, yaw: float, xy: Array) -> Prop:
        """Turned about the origin, then shifted on the floor."""
        shift = np.array([xy[0], xy[1], 0.0])
        rot = turn(yaw)
        centre = None if self.centre is None else rot @ self.centre + shift
        v = self.vertices @ rot.T + shift
        return Prop(
            self.name, v, self.faces, self.material, self.color, centre, self.half, self.yaw + yaw, self.dark, self.held
        )

    def inside(self, points: Array) -> Array:
        """How deep points lie inside the box (negative outside)."""
        assert self.centre is not None and self.half is not None
        local = (points - self.centre) @ turn(self.yaw)
        return (self.half - np.abs(local)).min(1)


def make(
    name: str, centre: tuple, size: tuple, material: str, color: Color, yaw: float = 0.0, held: bool = False
) -> Prop:
    """A box by centre and full size, turned about its own vertical axis."""
    h = 0.5 * np.array(size, float)
    v, f = box(tuple(-h), tuple(h))
    c = np.array(centre, float)
    dark = 0.1 if sum(color) < 0.12 else 0.0
    return Prop(name, v @ turn(yaw).T + c, f, material, color, c, h, yaw, dark, held)


def span(name: str, low: tuple, high: tuple, material: str, color: Color, held: bool = False) -> Prop:
    """An upright box by two corners."""
    a, b = np.array(low, float), np.array(high, float)
    return make(name, tuple(0.5 * (a + b)), tuple(b - a), material, color, 0.0, held)


def cylinder(name: str, base: tuple, radius: float, height: float, top: float, material: str, color: Color) -> Prop:
    """An upright cylinder or cone; it counts as its box in the collision checks."""
    a = np.linspace(0, 2 * np.pi, 25)
    ring = np.stack([np.cos(a), np.sin(a), np.zeros(25)], 1)
    up = np.array([0, 0, height])
    rows = np.stack([ring * 0, ring * radius, ring * top + up, ring * 0 + up]) + np.array(base)
    r = max(radius, top) * 0.8
    centre = np.array(base, float) + 0.5 * up
    half = np.array([r, r, 0.5 * height])
    return Prop(name, rows.reshape(-1, 3), grid_faces(4, 25), material, color, centre, half)


def bright(rng: Rng, low: float = 0.03, high: float = 0.6) -> Color:
    """A random paint."""
    return tuple(float(c) for c in rng.uniform(low, high, 3))


def wood(rng: Rng) -> Color:
    """A random wood."""
    return WOODS[int(rng.integers(len(WOODS)))]


def clutter(rng: Rng, low: tuple, high: tuple, z: float, count: int) -> list[Prop]:
    """Small things on a table: mugs, books, boxes, a laptop."""
    out = []
    for k in range(count):
        x, y = rng.uniform(low[0], high[0]), rng.uniform(low[1], high[1])
        kind = rng.integers(4)
        if kind == 0:
            out.append(cylinder(f"mug{k}", (x, y, z), 0.04, 0.1, 0.04, "paint", bright(rng)))
        elif kind == 1:
            h = rng.uniform(0.02, 0.1)
            out.append(make(f"book{k}", (x, y, z + h / 2), (0.2, 0.15, h), "paint", bright(rng), rng.uniform(0, 3)))
        elif kind == 2:
            s = rng.uniform(0.08, 0.25, 3)
            out.append(make(f"case{k}", (x, y, z + s[2] / 2), tuple(s), "paint", bright(rng), rng.uniform(0, 3)))
        else:
            yaw = rng.uniform(-0.6, 0.6)
            out.append(make(f"laptop{k}", (x, y, z + 0.01), (0.32, 0.22, 0.02), "metal", (0.3, 0.3, 0.32), yaw))
            back = turn(yaw) @ np.array([0.0, 0.12, 0.0])
            out.append(
                make(
                    f"lid{k}",
                    (x + back[0], y + back[1], z + 0.11),
                    (0.32, 0.015, 0.21),
                    "metal",
                    (0.05, 0.05, 0.06),
                    yaw,
                )
            )
    return out


def table(rng: Rng, y_edge: float, z: float, width: float, depth: float, x: float = 0.0) -> list[Prop]:
    """A table whose near edge (towards +y) lies at y_edge; it reaches to y_edge - depth."""
    color, out = wood(rng), []
    x0, x1, y0, y1 = x - width / 2, x + width / 2, y_edge - depth, y_edge
    out.append(span("top", (x0, y0, z - 0.03), (x1, y1, z), "wood", color))
    leg = (0.06, 0.06, 0.065) if rng.random() < 0.5 else color
    for k, (a, b) in enumerate(
        ((x0 + 0.02, y0 + 0.02), (x1 - 0.07, y0 + 0.02), (x0 + 0.02, y1 - 0.07), (x1 - 0.07, y1 - 0.07))
    ):
        out.append(span(f"leg{k}", (a, b, 0.0), (a + 0.05, b + 0.05, z - 0.03), "metal", leg))
    if rng.random() < 0.45:
        out.append(span("panel", (x0 + 0.05, y0 + 0.05, 0.15), (x1 - 0.05, y0 + 0.07, z - 0.03), "wood", color))
    return out + clutter(rng, (x0 + 0.15, y0 + 0.12), (x1 - 0.15, y0 + 0.35), z, int(rng.integers(0, 4)))


def chair(rng: Rng, seat: float, y_back: float, y_front: float) -> list[Prop]:
    """A chair that faces -y; its back rest's front is at y_back."""
    cloth, leg = bright(rng, 0.02, 0.4), wood(rng)
    w = 0.22
    out = [span("seat", (-w, y_front, seat - 0.05), (w, y_back, seat), "cloth", cloth)]
    top = seat + rng.uniform(0.35, 0.55)
    out.append(span("back", (-w, y_back, seat + rng.uniform(0.0, 0.18)), (w, y_back + 0.04, top), "cloth", cloth))
    if rng.random() < 0.3:  # an office chair's column and foot
        yc = 0.5 * (y_back + y_front)
        out.append(cylinder("column", (0, yc, 0.08), 0.03, seat - 0.13, 0.03, "metal", (0.05, 0.05, 0.05)))
        for k in range(3):
            out.append(
                make(f"star{k}", (0, yc, 0.06), (0.56, 0.04, 0.05), "metal", (0.05, 0.05, 0.05), k * np.pi / 3 + 0.5)
            )
        return out
    for k, (x, y) in enumerate(((-w, y_front), (w - 0.035, y_front), (-w, y_back), (w - 0.035, y_back))):
        h = seat - 0.05 if k < 2 else top - 0.05
        out.append(span(f"cleg{k}", (x, y, 0), (x + 0.035, y + 0.035, h), "wood", leg))
    return out


def sofa(rng: Rng, seat: float, y_back: float, y_front: float, width: float, x: float = 0.0) -> list[Prop]:
    """A sofa or an armchair that faces -y."""
    cloth = bright(rng, 0.03, 0.45)
    x0, x1 = x - width / 2, x + width / 2
    top = seat + rng.uniform(0.3, 0.5)
    out = [
        span("sofa", (x0, y_front, 0.06), (x1, y_back + 0.05, seat), "cloth", cloth),
        span("sofa_back", (x0 - 0.12, y_back, 0.06), (x1 + 0.12, y_back + 0.22, top), "cloth", cloth),
    ]
    for k, a in enumerate((x0 - 0.16, x1)):
        out.append(span(f"sofa_arm{k}", (a, y_front, 0.06), (a + 0.16, y_back, seat + 0.18), "cloth", cloth))
    return out


def shelf(
    rng: Rng, y_front: float, depth: float, width: float, boards: list[float], top: float, x: float
) -> list[Prop]:
    """A shelf unit open towards +y, with boards at the given heights."""
    color, out = wood(rng), []
    x0, x1, y0 = x - width / 2, x + width / 2, y_front - depth
    for k, z in enumerate([*boards, top]):
        out.append(span(f"board{k}", (x0, y0, z - 0.02), (x1, y_front, z), "wood", color))
    for k, a in enumerate((x0 - 0.02, x1)):
        out.append(span(f"side{k}", (a, y0, 0), (a + 0.02, y_front, top), "wood", color))
    if rng.random() < 0.7:
        out.append(span("rear", (x0, y0 - 0.01, 0), (x1, y0, top), "wood", color))
    return out


def books(rng: Rng, y_front: float, width: float, z: float, x: float, free: tuple[float, float]) -> list[Prop]:
    """A row of books; nothing stands between the two x of `free`."""
    out, at, k = [], x - width / 2 + 0.01, 0
    while at < x + width / 2 - 0.08:
        w, h, d = rng.uniform(0.02, 0.06), rng.uniform(0.16, 0.27), rng.uniform(0.14, 0.2)
        if (at + w < free[0] or at > free[1]) and rng.random() < 0.85:
            low, high = (at, y_front - 0.03 - d, z), (at + w - 0.002, y_front - 0.03, z + h)
            out.append(span(f"vol{k}", low, high, "paint", bright(rng, 0.02, 0.45)))
        at, k = at + w, k + 1
    return out


def plant(rng: Rng) -> list[Prop]:
    """A pot with long leaves."""
    r, h, z = rng.uniform(0.1, 0.18), rng.uniform(0.2, 0.45), rng.uniform(0.5, 1.1)
    out = [cylinder("pot", (0, 0, 0), 0.8 * r, h, r, "paint", bright(rng))]
    for k in range(int(rng.integers(14, 34))):
        a, lean, length = rng.uniform(0, 6.28), rng.uniform(0.1, 0.9), z * rng.uniform(0.5, 1.0)
        s = np.linspace(0, 1, 7)[:, None]
        along = np.array([np.cos(a), np.sin(a), 0.0])
        rise = s * np.cos(lean) - 0.35 * lean * s**2
        spine = np.array([0, 0, h]) + s * length * np.sin(lean) * along + np.array([0, 0, 1.0]) * length * rise
        side = np.cross(along, [0, 0, 1.0]) * (rng.uniform(0.015, 0.04) * np.sin(np.pi * (0.08 + 0.92 * s)))
        leaf = np.stack([spine - side, spine + side], 1).reshape(-1, 3)
        out.append(Prop(f"leaf{k}", leaf, grid_faces(7, 2), "leaf", (0.05, float(rng.uniform(0.1, 0.28)), 0.04)))
    return out


def drawer_unit(rng: Rng, y_front: float, z: float, x: float, pull: float, y_bar: float) -> list[Prop]:
    """A chest whose drawer at height z is pulled out; its front is at y_front, the carcass lies behind."""
    color, width, depth = bright(rng, 0.25, 0.7), rng.uniform(0.5, 0.9), rng.uniform(0.38, 0.5)
    x0, x1, y1 = x - width / 2, x + width / 2, y_front - pull - 0.02
    top = z + rng.uniform(0.07, 0.12) if rng.random() < 0.5 or z > 0.7 else z + rng.uniform(0.3, 0.6)
    out = [span("carcass", (x0, y1 - depth, 0), (x1, y1, z - 0.1), "paint", color)]
    if top > z + 0.15:
        out.append(span("carcass_up", (x0, y1 - depth, z + 0.1), (x1, y1, top), "paint", color))
    for k, a in enumerate((x0, x1 - 0.02)):
        out.append(span(f"cheek{k}", (a, y1 - depth, z - 0.1), (a + 0.02, y1, top), "paint", color))
    out.append(span("lid", (x0 - 0.01, y1 - depth, top), (x1 + 0.01, y1 + 0.01, top + 0.025), "wood", wood(rng)))
    out.append(span("front", (x0 + 0.01, y_front - 0.02, z - 0.09), (x1 - 0.01, y_front, z + 0.09), "paint", color))
    out.append(span("tray", (x0 + 0.03, y1 - 0.1, z - 0.08), (x1 - 0.03, y_front - 0.02, z - 0.06), "wood", wood(rng)))
    for k, a in enumerate((x0 + 0.03, x1 - 0.042)):
        out.append(span(f"rail{k}", (a, y1 - 0.1, z - 0.08), (a + 0.012, y_front - 0.02, z + 0.04), "wood", wood(rng)))
    metal = (0.25, 0.25, 0.26)
    bar = ((x - 0.08, y_bar - 0.006, z - 0.006), (x + 0.08, y_bar + 0.006, z + 0.006))
    out.append(span("bar", *bar, "metal", metal, held=True))
    for k, a in enumerate((x - 0.08, x + 0.07)):
        post = ((a, y_front, z - 0.005), (a + 0.01, y_bar, z + 0.005))
        out.append(span(f"post{k}", *post, "metal", metal, held=True))
    return out


def door(rng: Rng, handle: Array, hinge_side: float, angle: float) -> list[Prop]:
    """A door in a stretch of wall. `handle` is on the leaf's face towards +y; hinge_side +1: hinge at larger x."""
    leaf_w, leaf_h, t = 0.82, 2.03, 0.04
    along = np.array([hinge_side * np.cos(angle), -np.sin(angle), 0.0])  # from the handle to the hinge
    normal = np.array([-along[1], along[0], 0.0])
    normal *= np.sign(normal[1]) or 1.0
    base = handle - 0.055 * normal  # on the leaf's face
    hinge = base + along * (leaf_w - 0.06)
    centre = base + along * (0.5 * leaf_w - 0.06) - normal * t / 2
    yaw = float(np.arctan2(along[1], along[0]))
    paint, wall = bright(rng, 0.35, 0.75), (0.62, 0.6, 0.55)
    out = [make("leaf", (centre[0], centre[1], leaf_h / 2 + 0.005), (leaf_w, t, leaf_h), "paint", paint, yaw)]
    grip = handle + 0.045 * along
    metal = (0.3, 0.3, 0.31)
    out.append(make("grip", (grip[0], grip[1], handle[2]), (0.12, 0.018, 0.018), "metal", metal, yaw, True))
    stem = handle - 0.028 * normal
    out.append(make("stem", (stem[0], stem[1], handle[2]), (0.018, 0.055, 0.018), "metal", metal, yaw, True))
    # the wall lies along x through the hinge, the frame at both ends of the opening
    y0, y1 = hinge[1] - 0.12, hinge[1] - 0.005
    if angle < 0.05:
        y0, y1 = y0 - 0.0, y1
    ends = sorted((hinge[0], hinge[0] - hinge_side * leaf_w))
    left, right = rng.uniform(0.3, 0.8, 2)
    out.append(span("wall_l", (ends[0] - left, y0, 0), (ends[0], y1, 2.4), "wall", wall))
    out.append(span("wall_r", (ends[1], y0, 0), (ends[1] + right, y1, 2.4), "wall", wall))
    out.append(span("lintel", (ends[0], y0, leaf_h + 0.02), (ends[1], y1, 2.4), "wall", wall))
    for k, e in enumerate(ends):
        out.append(span(f"jamb{k}", (e - 0.06, y1, 0), (e + (0.0 if k == 0 else 0.06), y1 + 0.01, 2.1), "paint", paint))
    return out


def occluder(rng: Rng) -> list[Prop]:
    """Something low that hides a part of a person behind it; its middle is at the origin."""
    kind = rng.integers(6)
    if kind == 0:
        z = rng.uniform(0.7, 0.78)
        return table(rng, 0.35, z, rng.uniform(1.0, 1.6), 0.7)
    if kind == 1:
        return [
            p.moved(np.pi * rng.integers(2), np.zeros(2)) for p in sofa(rng, 0.42, 0.2, -0.4, rng.uniform(0.6, 1.6))
        ]
    if kind == 2:
        h = rng.uniform(0.85, 1.1)
        return [
            make("counter", (0, 0, h / 2), (rng.uniform(0.8, 1.6), 0.45, h), "paint", bright(rng, 0.2, 0.7)),
            *clutter(rng, (-0.4, -0.1), (0.4, 0.1), h, 2),
        ]
    if kind == 3:
        return plant(rng)
    if kind == 4:
        out = []
        z = 0.0
        for k in range(int(rng.integers(1, 4))):
            s = rng.uniform([0.3, 0.3, 0.25], [0.6, 0.5, 0.45])
            out.append(
                make(f"carton{k}", (0, 0, z + s[2] / 2), tuple(s), "paint", (0.42, 0.28, 0.16), rng.uniform(-0.3, 0.3))
            )
            z += s[2]
        return out
    return chair(rng, 0.45, 0.2, -0.24)


def against_wall(rng: Rng) -> list[Prop]:
    """Something that stands with its back (at y = 0) to a wall and faces -y."""
    kind = rng.integers(6)
    if kind == 0:
        w, d = rng.uniform(0.6, 1.4), rng.uniform(0.25, 0.35)
        levels = [0.08 + 0.36 * k for k in range(int(rng.integers(3, 6)))]
        out = [p.moved(np.pi, np.array([0, 0])) for p in shelf(rng, d, d, w, levels, levels[-1] + 0.34, 0.0)]
        for z in levels:
            rows = books(rng, d, w, z, 0.0, (9, 9))
            out += [p.moved(np.pi, np.array([0, 0])) for p in rows]
        return out
    if kind == 1:
        w, h = rng.uniform(0.8, 1.6), rng.uniform(0.5, 0.95)
        out = [span("sideboard", (-w / 2, -0.42, 0), (w / 2, 0, h), "wood", wood(rng))]
        return out + clutter(rng, (-w / 2 + 0.15, -0.3), (w / 2 - 0.15, -0.15), h, 3)
    if kind == 2:
        return [p.moved(0.0, np.array([0, -0.3])) for p in sofa(rng, 0.42, 0.05, -0.5, rng.uniform(1.2, 1.9))]
    if kind == 3:
        return [p.moved(0.0, np.array([0, -0.35])) for p in plant(rng)]
    if kind == 4:
        w = rng.uniform(0.8, 1.2)
        return [span("wardrobe", (-w / 2, -0.55, 0), (w / 2, 0, rng.uniform(1.7, 2.1)), "wood", wood(rng))]
    return [p.moved(0.0, np.array([0, -0.27])) for p in chair(rng, 0.45, 0.18, -0.25)]


def walls(rng: Rng, x0: float, x1: float, y0: float, y1: float, top: float) -> list[Prop]:
    """Floor, ceiling, four walls, a window recess and pictures on the far wall."""
    t, out = 0.1, []
    a, b = bright(rng, 0.4, 0.75), bright(rng, 0.35, 0.75)
    out.append(span("floor", (x0 - t, y0 - t, -t), (x1 + t, y1 + 0.5, 0), "floor", (0.36, 0.22, 0.13)))
    out.append(span("ceiling", (x0 - t, y0 - t, top), (x1 + t, y1 + 0.5, top + t), "wall", (0.78, 0.77, 0.74)))
    out.append(span("left", (x0 - t, y0, 0), (x0, y1, top), "wall", a))
    out.append(span("right", (x1, y0, 0), (x1 + t, y1, top), "wall", a))
    out.append(span("near", (x0 - t, y0 - t, 0), (x1 + t, y0, top), "wall", a))
    wide = min(rng.uniform(0.9, 1.8), x1 - x0 - 0.4)
    wx = rng.uniform(x0 + 0.1 + wide / 2, x1 - 0.1 - wide / 2)
    z0, z1 = rng.uniform(0.8, 1.1), rng.uniform(1.9, 2.2)
    w0, w1, d = wx - wide / 2, wx + wide / 2, rng.uniform(0.08, 0.3)
    for name, low, high in (
        ("far_a", (x0 - t, y1, 0), (w0, y1 + d, top)),
        ("far_b", (w1, y1, 0), (x1 + t, y1 + d, top)),
        ("far_c", (w0, y1, 0), (w1, y1 + d, z0)),
        ("far_d", (w0, y1, z1), (w1, y1 + d, top)),
    ):
        out.append(span(name, low, high, "wall", b))
    out.append(span("pane", (w0, y1 + d - 0.02, z0), (w1, y1 + d, z1), "window", (0.8, 0.9, 1.0)))
    for k, x in enumerate((w0, wx - 0.025, w1 - 0.05)):
        out.append(span(f"sash{k}", (x, y1 + d - 0.06, z0), (x + 0.05, y1 + d - 0.02, z1), "paint", (0.75, 0.74, 0.7)))
    for k in range(int(rng.integers(0, 3))):
        px, pz, pw = rng.uniform(x0 + 0.4, x1 - 0.4), rng.uniform(1.3, 1.8), rng.uniform(0.15, 0.35)
        if abs(px - wx) > wide / 2 + pw + 0.05:
            low, high = (px - pw, y1 - 0.025, pz - 0.25), (px + pw, y1, pz + 0.25)
            out.append(span(f"picture{k}", low, high, "picture", bright(rng)))
    sill = ((x0, y1 - 0.015, 0), (x1, y1, 0.09))
    out.append(span("skirting", *sill, "paint", (0.75, 0.74, 0.71)))
    return out
