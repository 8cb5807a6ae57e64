"""The room and its furniture as boxes and cylinders with named materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from layout import Array
from meshes import Faces, box, grid_faces
from motion import HANDLE

X_LEFT, X_RIGHT, Y_NEAR, Y_BACK, Z_TOP = -2.35, 1.63, -0.9, 4.75, 2.55


@dataclass
class Thing:
    """A static mesh; `drawer` things slide with the drawer."""

    name: str
    vertices: Array
    faces: Faces
    material: str
    color: tuple[float, float, float]
    drawer: bool = False


def cylinder(
    base: tuple[float, float, float], radius: float, height: float, top: float | None = None, n: int = 28
) -> tuple[Array, Faces]:
    """A closed upright cylinder or cone."""
    a = np.linspace(0, 2 * np.pi, n)
    ring = np.stack([np.cos(a), np.sin(a), np.zeros(n)], 1)
    up = np.array([0, 0, height])
    r2 = radius if top is None else top
    rows = np.stack([ring * 0, ring * radius, ring * r2 + up, ring * 0 + up]) + np.array(base)
    return rows.reshape(-1, 3), grid_faces(4, n)


def shell_of_room() -> list[Thing]:
    """Floor, ceiling, walls with a skirting board, and a window in the back wall."""
    out = []

    def add(name: str, low: tuple, high: tuple, material: str, color: tuple) -> None:
        out.append(Thing(name, *box(low, high), material, color))

    t = 0.1
    wall, white = (0.63, 0.60, 0.54), (0.75, 0.74, 0.71)
    add("floor", (X_LEFT, Y_NEAR, -t), (X_RIGHT, Y_BACK, 0.0), "floor", (0.36, 0.22, 0.13))
    add("ceiling", (X_LEFT, Y_NEAR, Z_TOP), (X_RIGHT, Y_BACK, Z_TOP + t), "wall", (0.78, 0.77, 0.74))
    add("left", (X_LEFT - t, Y_NEAR, 0), (X_LEFT, Y_BACK, Z_TOP), "wall", wall)
    add("right", (X_RIGHT, Y_NEAR, 0), (X_RIGHT + t, Y_BACK, Z_TOP), "wall", wall)
    add("near", (X_LEFT, Y_NEAR - t, 0), (X_RIGHT, Y_NEAR, Z_TOP), "wall", wall)
    back = (0.46, 0.53, 0.52)
    wx0, wx1, wz0, wz1 = -0.28, 0.62, 1.02, 2.12  # the window's hole
    add("back_low", (X_LEFT, Y_BACK, 0), (X_RIGHT, Y_BACK + t, wz0), "wall", back)
    add("back_high", (X_LEFT, Y_BACK, wz1), (X_RIGHT, Y_BACK + t, Z_TOP), "wall", back)
    add("back_a", (X_LEFT, Y_BACK, wz0), (wx0, Y_BACK + t, wz1), "wall", back)
    add("back_b", (wx1, Y_BACK, wz0), (X_RIGHT, Y_BACK + t, wz1), "wall", back)
    add("pane", (wx0, Y_BACK + 0.06, wz0), (wx1, Y_BACK + 0.07, wz1), "window", (0.80, 0.90, 1.0))
    f = 0.05
    for k, (x0, x1) in enumerate(((wx0, wx0 + f), (wx1 - f, wx1), (0.15, 0.19))):
        add(f"frame_v{k}", (x0, Y_BACK - 0.01, wz0), (x1, Y_BACK + 0.05, wz1), "paint", white)
    for k, (z0, z1) in enumerate(((wz0 - 0.03, wz0 + f), (wz1 - f, wz1), (1.68, 1.71))):
        deep = 0.10 if k == 0 else 0.014
        add(f"frame_h{k}", (wx0 - 0.02, Y_BACK - deep, z0), (wx1 + 0.02, Y_BACK + 0.05, z1), "paint", white)
    for k, (low, high) in enumerate(
        (
            ((X_LEFT, Y_BACK - 0.015, 0), (X_RIGHT, Y_BACK, 0.09)),
            ((X_LEFT, Y_NEAR, 0), (X_LEFT + 0.015, Y_BACK, 0.09)),
            ((X_RIGHT - 0.015, Y_NEAR, 0), (X_RIGHT, Y_BACK, 0.09)),
        )
    ):
        add(f"skirting{k}", low, high, "paint", white)
    add("picture_frame", (-1.78, Y_BACK - 0.025, 1.38), (-1.18, Y_BACK, 1.86), "paint", (0.05, 0.04, 0.035))
    add("picture", (-1.74, Y_BACK - 0.03, 1.42), (-1.22, Y_BACK - 0.02, 1.82), "picture", (0.5, 0.4, 0.2))
    return out


def drawer_unit() -> list[Thing]:
    """A chest of five drawers against the right wall; the top one is the one that A opens."""
    out = []
    x0, y0, y1, top = 1.21, 1.64, 2.36, 1.16
    body, front, metal = (0.60, 0.56, 0.50), (0.66, 0.62, 0.55), (0.25, 0.25, 0.26)
    board = 0.02

    def add(name: str, low: tuple, high: tuple, material: str, color: tuple, moves: bool = False) -> None:
        out.append(Thing(name, *box(low, high), material, color, moves))

    add("unit_low", (x0 + 0.02, y0, 0.0), (X_RIGHT - 0.02, y1, 0.925), "paint", body)
    add("unit_sides_a", (x0 + 0.02, y0, 0.925), (X_RIGHT - 0.02, y0 + board, top), "paint", body)
    add("unit_sides_b", (x0 + 0.02, y1 - board, 0.925), (X_RIGHT - 0.02, y1, top), "paint", body)
    add("unit_back", (X_RIGHT - 0.04, y0, 0.925), (X_RIGHT - 0.02, y1, top), "paint", body)
    add(
        "unit_top",
        (x0, y0 - 0.01, top),
        (X_RIGHT - 0.02, y1 + 0.01, top + 0.025),
        "wood",
        (0.30, 0.17, 0.085),
    )
    edges = [0.05, 0.27, 0.49, 0.71, 0.93, 1.145]
    for k in range(5):
        z0, z1, last = edges[k] + 0.006, edges[k + 1] - 0.006, k == 4
        add(f"front{k}", (x0, y0 + 0.008, z0), (x0 + 0.02, y1 - 0.008, z1), "paint", front, last)
        zc = float(HANDLE[2]) if last else 0.5 * (z0 + z1) + 0.02
        yc, hx = float(HANDLE[1]), float(HANDLE[0])
        add(
            f"bar{k}",
            (hx - 0.006, yc - 0.10, zc - 0.006),
            (hx + 0.006, yc + 0.10, zc + 0.006),
            "metal",
            metal,
            last,
        )
        for j, dy in enumerate((-0.088, 0.088)):
            add(
                f"post{k}{j}",
                (hx, yc + dy - 0.005, zc - 0.005),
                (x0, yc + dy + 0.005, zc + 0.005),
                "metal",
                metal,
                last,
            )
    inner = (0.45, 0.36, 0.25)
    for name, low, high in (
        ("bottom", (x0 + 0.02, y0 + 0.03, 0.94), (1.56, y1 - 0.03, 0.95)),
        ("side_a", (x0 + 0.02, y0 + 0.03, 0.94), (1.56, y0 + 0.042, 1.09)),
        ("side_b", (x0 + 0.02, y1 - 0.042, 0.94), (1.56, y1 - 0.03, 1.09)),
        ("rear", (1.55, y0 + 0.03, 0.94), (1.56, y1 - 0.03, 1.09)),
    ):
        add(f"drawer_{name}", low, high, "wood", inner, True)
    add("books", (1.36, 2.10, top + 0.025), (1.58, 2.26, top + 0.06), "paint", (0.30, 0.05, 0.05))
    add("books2", (1.37, 2.11, top + 0.06), (1.57, 2.26, top + 0.10), "paint", (0.05, 0.13, 0.20))
    out.append(Thing("pot", *cylinder((1.46, 1.83, top + 0.025), 0.055, 0.11, 0.07), "paint", (0.50, 0.20, 0.10)))
    rng = np.random.default_rng(4)
    for k in range(26):
        a, lean, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.75), rng.uniform(0.16, 0.30)
        s = np.linspace(0, 1, 7)[:, None]
        along = np.array([np.cos(a), np.sin(a), 0.0])
        spine = (
            np.array([1.46, 1.83, top + 0.12])
            + s * length * (np.sin(lean) * along)
            + np.array([0, 0, 1.0]) * length * (s * np.cos(lean) - 0.35 * lean * s**2)
        )
        spine[:, 0] = np.minimum(spine[:, 0], X_RIGHT - 0.02)
        side = np.cross(along, [0, 0, 1.0]) * (0.016 * np.sin(np.pi * (0.08 + 0.92 * s)))
        leaf = np.stack([spine - side, spine + side], 1).reshape(-1, 3)
        out.append(Thing(f"leaf{k}", leaf, grid_faces(7, 2), "leaf", (0.05, 0.16 + 0.08 * rng.random(), 0.035)))
    return out


def desk_and_shelf() -> list[Thing]:
    """A desk with a pedestal before B, a chair beside it, and a book shelf at the back wall."""
    out = []

    def add(name: str, low: tuple, high: tuple, material: str, color: tuple) -> None:
        out.append(Thing(name, *box(low, high), material, color))

    wood, dark = (0.40, 0.23, 0.11), (0.06, 0.06, 0.065)
    x0, x1, y0, y1 = -1.95, -0.585, 2.42, 2.98
    add("desk_top", (x0, y0, 0.70), (x1, y1, 0.73), "wood", wood)
    add("desk_panel", (x0 + 0.05, y0 + 0.12, 0.14), (x1 - 0.05, y0 + 0.14, 0.70), "wood", (0.34, 0.19, 0.09))
    for k, (x, y) in enumerate(
        ((x0 + 0.03, y0 + 0.03), (x1 - 0.07, y0 + 0.03), (x0 + 0.03, y1 - 0.07), (x1 - 0.07, y1 - 0.07))
    ):
        add(f"desk_leg{k}", (x, y, 0.0), (x + 0.04, y + 0.04, 0.70), "metal", dark)
    add("laptop", (-1.78, 2.55, 0.73), (-1.46, 2.77, 0.745), "metal", (0.35, 0.35, 0.37))
    lid, faces = box((-1.78, 2.55, 0.0), (-1.46, 2.56, 0.21))
    lid[:, 1] -= 0.25 * lid[:, 2]
    out.append(Thing("laptop_lid", lid + np.array([0, 0, 0.745]), faces, "metal", (0.35, 0.35, 0.37)))
    out.append(Thing("mug", *cylinder((-1.10, 2.60, 0.73), 0.04, 0.095), "paint", (0.75, 0.55, 0.08)))
    add("paper", (-1.38, 2.52, 0.73), (-1.17, 2.80, 0.733), "paint", (0.8, 0.8, 0.78))
    sx0, sx1, d = -2.33, -1.83, 0.28
    sy = Y_BACK - d
    for k, z in enumerate((0.0, 0.36, 0.72, 1.08)):
        add(f"shelf{k}", (sx0, sy, z), (sx1, Y_BACK - 0.02, z + 0.02), "wood", wood)
    for k, x in enumerate((sx0, sx1 - 0.02)):
        add(f"shelf_side{k}", (x, sy, 0.0), (x + 0.02, Y_BACK - 0.02, 1.10), "wood", wood)
    rng = np.random.default_rng(2)
    for k, z in enumerate((0.02, 0.38, 0.74)):
        x = sx0 + 0.03
        j = 0
        while x < sx1 - 0.09:
            w, h = rng.uniform(0.02, 0.05), rng.uniform(0.19, 0.29)
            color = tuple(float(c) for c in rng.uniform(0.03, 0.45, 3))
            add(f"book{k}_{j}", (x, sy + 0.02, z), (x + w - 0.002, sy + 0.2, z + h), "paint", color)
            x, j = x + w, j + 1
    cx, cy = 0.20, 4.22  # a chair near the back wall
    seat = (0.10, 0.16, 0.17)
    add("chair_seat", (cx - 0.22, cy - 0.22, 0.425), (cx + 0.22, cy + 0.22, 0.475), "cloth", seat)
    add("chair_back", (cx - 0.21, cy + 0.185, 0.60), (cx + 0.21, cy + 0.225, 0.91), "cloth", seat)
    for k, (dx, dy, h) in enumerate(((-0.2, -0.2, 0.43), (0.17, -0.2, 0.43), (-0.2, 0.19, 0.9), (0.17, 0.19, 0.9))):
        add(f"chair_leg{k}", (cx + dx, cy + dy, 0), (cx + dx + 0.03, cy + dy + 0.03, h), "wood", wood)
    return out


def build_room() -> list[Thing]:
    """Everything that is not a person."""
    return shell_of_room() + drawer_unit() + desk_and_shelf()
