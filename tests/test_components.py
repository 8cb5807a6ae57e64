"""Things in the depth image, on ray-cast scenes."""

import numpy as np
import pytest

from understudy.camera import Camera
from understudy.detectors.components import DepthGrid, fit_floor
from understudy.detectors.windows import Scene, tiled, windows
from understudy.types import RegisteredDepth

PITCH, HEIGHT = 0.2, 1.3  # radians downwards, metres above the floor


def room(camera: Camera, people: list[tuple[float, float]], wall: float | None = 5.0, floor: bool = True) -> np.ndarray:
    """z of a scene: floor, back wall, and people as upright cylinders (x, distance) of 0.22 m radius, 1.75 m tall."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ray = camera.unproject(np.stack([u, v], -1).astype(float), 1.0)
    c, s = np.cos(PITCH), np.sin(PITCH)
    x, down, ahead = ray[..., 0], c * ray[..., 1] + s * ray[..., 2], -s * ray[..., 1] + c * ray[..., 2]
    t = np.full(u.shape, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        if floor:
            t = np.where(down > 0, HEIGHT / down, t)
        if wall:
            t = np.minimum(t, np.where(ahead > 0, wall / ahead, np.inf))
        for px, distance in people:
            a, b, k = x**2 + ahead**2, -2 * (x * px + ahead * distance), px**2 + distance**2 - 0.22**2
            hit = (-b - np.sqrt(b * b - 4 * a * k)) / (2 * a)
            top, bottom = HEIGHT - 1.75, HEIGHT
            t = np.where((hit > 0) & (hit * down > top) & (hit * down < bottom) & (hit < t), hit, t)
    return np.where(np.isfinite(t), t, 0).astype(np.float32)  # rays have z = 1


@pytest.mark.parametrize("scale", [0.5, 1, 2])
@pytest.mark.parametrize("filled", [0.1, 1.0])
def test_people_who_overlap_are_apart(camera: Camera, scale: float, filled: float):
    people = [(-0.9, 3.0), (-0.55, 3.9), (0.8, 2.6)]
    depth_camera = camera.scale(scale)
    z = room(depth_camera, people)
    z[np.random.default_rng(0).random(z.shape) > filled] = 0
    scene = Scene(RegisteredDepth(z, depth_camera), camera)
    compact = [g for g in scene.groups if g.compact]
    assert len(compact) == 3
    for (x, distance), group in zip(
        sorted(people, key=lambda p: p[1]), sorted(compact, key=lambda g: g.z), strict=True
    ):
        middle = camera.project(np.array([[x, -np.sin(PITCH) * distance, np.cos(PITCH) * distance]]))[0]
        left, top, right, bottom = group.box
        assert left < right and top < bottom
        assert abs((left + right) / 2 - middle[0]) < 35
        assert abs(group.z - np.cos(PITCH) * distance) < 0.35


def test_floor_is_found_and_removed(camera: Camera):
    grid = DepthGrid(RegisteredDepth(room(camera, [(0.0, 3.0)]), camera), camera)
    assert grid.floor is not None
    np.testing.assert_allclose(grid.floor[:3], (0, -np.cos(PITCH), -np.sin(PITCH)), atol=0.02)
    assert grid.floor[3] == pytest.approx(HEIGHT, abs=0.03)
    near_floor = np.abs(grid.points @ grid.floor[:3] + grid.floor[3]) < 0.02
    assert not grid.labels[near_floor & (grid.z > 0)].any()


def test_no_floor_where_there_is_only_a_wall(camera: Camera):
    grid = DepthGrid(RegisteredDepth(room(camera, [], floor=False), camera), camera)
    assert grid.floor is None
    assert fit_floor(np.zeros((9, 16, 3), np.float32), np.zeros((9, 16), bool)) is None


def test_a_table_is_not_a_floor_when_the_floor_is_seen(camera: Camera):
    """Cells of a level surface at half height are many, but the floor lies beneath them."""
    u, v = np.meshgrid(np.arange(960), np.arange(540))
    ray = camera.unproject(np.stack([u, v], -1).astype(float), 1.0)
    with np.errstate(divide="ignore"):
        floor, table = np.where(ray[..., 1] > 0, HEIGHT / ray[..., 1], np.inf), 0.6 / ray[..., 1]
    on_table = (table > 1) & (table < 3) & (np.abs(ray[..., 0] * table) < 0.8)
    z = np.minimum(np.where(on_table, table, floor), 4.0).astype(np.float32)
    grid = DepthGrid(RegisteredDepth(z, camera), camera)
    assert grid.floor is not None and grid.floor[3] == pytest.approx(HEIGHT, abs=0.03)


def test_hidden_people_are_greyed_out_and_only_they(camera: Camera):
    scene = Scene(RegisteredDepth(room(camera, [(-0.6, 3.0), (0.6, 3.0)]), camera), camera)
    a, b = (i for i, g in enumerate(scene.groups) if g.compact)
    look = tiled(960, 540)[0]  # the whole image
    crop = np.full((224, 224, 3), 200, np.uint8)
    hidden = scene.hide(crop, look.region, scene.hidden(a))
    A = np.vstack([look.region.to_image(224), (0, 0, 1)])
    for group, expected in ((a, 200), (b, 128)):
        left, top, right, bottom = scene.groups[group].box
        x, y, _ = np.linalg.inv(A) @ ((left + right) / 2, (top + bottom) / 2, 1)
        assert abs(int(hidden[round(y), round(x), 0]) - expected) <= 3
    assert (crop == 200).all()


def test_cells_and_colour_pixels_agree(camera: Camera):
    """The affine map to colour pixels and the look-up of cells are inverse, also when sizes do not divide."""
    odd = camera.resize(317, 178)
    z = np.ones((178, 317), np.float32)
    grid = DepthGrid(RegisteredDepth(z, odd), camera)
    gh, gw = grid.z.shape
    col, row = (a.ravel() for a in np.meshgrid(np.arange(gw), np.arange(gh)))
    uv = np.column_stack([col, row, np.ones(gw * gh)]) @ grid.to_color().T
    r, c, inside = grid.cells_of(uv)
    assert inside.all()
    np.testing.assert_array_equal(r, row)
    np.testing.assert_array_equal(c, col)


def test_tiles_cover_the_image():
    for width, height in ((960, 540), (640, 480), (540, 960), (300, 300)):
        covered = np.zeros((height, width), bool)
        for tile in [*tiled(width, height)[1:], *windows(width, height, None)]:
            x, y, half = *tile.region.center, tile.region.size / 2
            covered[max(0, round(y - half)) : round(y + half) + 1, max(0, round(x - half)) : round(x + half) + 1] = True
        assert covered.all()


def test_cells_without_a_ray_do_no_harm(camera: Camera):
    """A lens model that folds back before the corners, depth registered to it."""
    folded = Camera(960, 540, camera.K, "brown_conrady", (-0.35, 0.0, 0.0, 0.0, 0.0))
    z = room(camera, [(0.0, 3.0)])
    grid = DepthGrid(RegisteredDepth(z, folded), folded)
    assert np.isnan(folded.normalized(np.array([[0.0, 0.0]]))).all()
    assert np.isfinite(grid.points).all()
    boxes = [g.box for g in Scene(RegisteredDepth(z, folded), folded).groups if g.compact]
    assert len(boxes) == 1 and np.isfinite(boxes).all()


def test_tiles_of_thin_images_stay_few():
    assert len(tiled(2, 2000)) + len(windows(2, 2000, None)) < 60
