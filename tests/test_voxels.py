"""The person's view: laws of its rotation, the way there and back, columns, and the depth grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera
from understudy.types import RegisteredDepth
from understudy.voxels import CELL, CELLS, EMPTY, HALF, LIMIT, PersonView, cloud, rotation_to

DIRECTIONS = st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)).map(lambda t: unit(np.array([*t, 1.0])))


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def people_at(seed: int, n: int) -> np.ndarray:
    """Points before the camera, metres."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.8, 6, n)
    return np.column_stack([rng.uniform(-0.7, 0.7, (n, 2)) * z[:, None], z])


@given(direction=DIRECTIONS)
def test_rotation_is_the_smallest_one_to_the_axis(direction):
    R = rotation_to(direction)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ direction, [0, 0, 1], atol=1e-12)
    assert np.trace(R) == pytest.approx(1 + 2 * direction[2])  # its angle is that between the two directions
    np.testing.assert_allclose(rotation_to(np.array([0.0, 0, 1])), np.eye(3))
    mirrored = rotation_to(direction * (-1, 1, 1))  # no sideways roll: left and right are treated alike
    np.testing.assert_allclose(mirrored, np.diag([-1, 1, 1]) @ R @ np.diag([-1, 1, 1]), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_there_and_back(seed):
    center, *points = people_at(seed, 40)
    view = PersonView.towards(center)
    np.testing.assert_allclose(view.from_cam(center), 0, atol=1e-12)
    points = np.array(points)
    points = points[(points @ view.R_view_cam.T)[:, 2] > 0.2]
    np.testing.assert_allclose(view.to_cam(view.from_cam(points)), points, atol=1e-12)
    x = np.random.default_rng(seed).uniform(-0.5, 0.5, (7, 18, 3))
    np.testing.assert_allclose(view.from_cam(view.to_cam(x)), x, atol=1e-12)
    assert np.isnan(view.from_cam(-points)[:, 2]).all()


def test_scale_at_the_root():
    """A metre across is a metre in view coordinates at the root's depth, and so is a metre along the axis."""
    view = PersonView.towards(np.array([0.8, -0.3, 2.5]))
    away = view.to_cam(np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])) - np.array([0.8, -0.3, 2.5])
    np.testing.assert_allclose(away @ view.R_view_cam.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_keypoint_is_the_column_of_its_point_at_any_depth(seed, camera: Camera):
    points = people_at(seed, 20)
    view = PersonView.towards(points[0])
    for depth in (0.7, 1.0, 1.6):
        uv = camera.project(points * depth)
        np.testing.assert_allclose(view.columns(camera, uv), view.from_cam(points)[:, :2], atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_mirrored_view_has_the_other_x_and_leads_back_to_the_same_places(seed):
    points = people_at(seed, 300)
    view = PersonView.towards(points[0])
    mirror = view.mirrored()
    there = mirror.from_cam(points)
    np.testing.assert_allclose(there, view.from_cam(points) * [-1, 1, 1], atol=1e-9)
    np.testing.assert_allclose(mirror.to_cam(there), points, atol=1e-9)
    away = np.abs(view.from_cam(points)[:, :2] / CELL % 1 - 0.5).max(1) < 0.499  # from the edges of the cells
    cells = points[away].astype(np.float32)
    np.testing.assert_array_equal(mirror.depth_grid(cells), view.depth_grid(cells)[..., ::-1])


def test_no_ray_no_column():
    fisheye = Camera(
        640, 480, np.array([[200.0, 0, 320], [0, 200.0, 240], [0, 0, 1]]), "brown_conrady", (-0.3, 0, 0, 0, 0)
    )
    uv = np.array([[320.0, 240], [0.0, 0]])
    columns = PersonView.towards(np.array([0, 0, 2.0])).columns(fisheye, uv)
    assert np.isfinite(columns[0]).all()
    assert np.isfinite(columns[1]).all() == np.isfinite(fisheye.normalized(uv)[1]).all()


def grid_by_loop(view: PersonView, points: np.ndarray) -> np.ndarray:
    out = np.full((2, CELLS, CELLS), EMPTY)
    for x, y, z in view.from_cam(points.astype(float)):
        if not np.isfinite(z):
            continue
        i, j = int(np.floor((x + HALF) / CELL)), int(np.floor((y + HALF) / CELL))
        if not (0 <= i < CELLS and 0 <= j < CELLS):
            continue
        out[0, j, i] = min(out[0, j, i], np.clip(z, -LIMIT, LIMIT))
        if abs(z) < HALF:
            out[1, j, i] = z if out[1, j, i] == EMPTY else max(out[1, j, i], z)
    return out


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 300))
def test_depth_grid_against_a_loop(seed, n):
    rng = np.random.default_rng(seed)
    center = people_at(seed, 1)[0]
    points = (center + rng.normal(0, 0.9, (n, 3))).astype(np.float32)
    view = PersonView.towards(center)
    grid, slow = view.depth_grid(points), grid_by_loop(view, points)
    assert grid.dtype == np.float32 and grid.shape == (2, CELLS, CELLS)
    same = np.isclose(grid, slow, atol=1e-5)
    assert (~same).sum() <= 2  # a point on the border of two columns may fall to either
    occupied = grid[1] < EMPTY
    assert (grid[0][occupied] <= grid[1][occupied]).all()


def test_depth_grid_does_not_count(camera: Camera):
    """A coarse and a fine sensor that see the same wall give the same grid."""
    view = PersonView.towards(np.array([0.2, 0.1, 2.5]))
    coarse = camera.resize(480, 270)
    walls = [RegisteredDepth(np.full((c.height, c.width), 2.5, np.float32), c) for c in (camera, coarse)]
    fine, rough = (view.depth_grid(cloud(w)) for w in walls)
    middle = (slice(None), slice(8, -8), slice(2, -2))  # the image does not reach the grid's upper and lower rim
    np.testing.assert_allclose(fine[middle], rough[middle], atol=0.02)


def test_points_at_the_very_side_of_the_grid():
    """In single precision, some that are just inside divide to just outside."""
    view = PersonView.towards(np.array([0.0, 0.0, 2.0]))
    z = np.linspace(1.2, 3.0, 20_001, dtype=np.float32)
    edge = np.nextafter(z * np.float32(CELLS // 2), np.float32(0)) / np.float32(2.0 / CELL)
    for x, y in ((edge, 0 * z), (0 * z, edge), (edge, edge), (-edge, -edge)):
        near, _ = view.depth_grid(np.stack([x, y, z], 1))
        assert (near < EMPTY).any()


def test_enough_points_are_spread_over_the_frame():
    camera = Camera(200, 100, np.array([[150.0, 0, 99.5], [0, 150.0, 49.5], [0, 0, 1]]))
    depth = RegisteredDepth(np.full((100, 200), 2.0, np.float32), camera)
    every = cloud(depth)
    assert len(cloud(depth, 20_000)) == len(cloud(depth, 14_000)) == len(every) == 20_000
    some = cloud(depth, 5000)
    assert len(some) == 5000
    assert np.array_equal(some, every[::4])
    assert len(cloud(RegisteredDepth(np.zeros((100, 200), np.float32), camera), 5000)) == 0


def test_cloud_has_every_measured_point(camera: Camera):
    z = np.zeros((540, 960), np.float32)
    z[10, 20], z[500, 900] = 1.5, 3.0
    points = cloud(RegisteredDepth(z, camera))
    np.testing.assert_allclose(camera.project(points.astype(float)), [[20, 10], [900, 500]], atol=1e-3)
    np.testing.assert_allclose(points[:, 2], [1.5, 3.0])


def test_the_simulation_uses_the_same_view():
    """Training makes grids and columns in torch; use makes them here."""
    torch = pytest.importorskip("torch")
    from understudy.synthetic import view as batches

    rng = np.random.default_rng(3)
    centers = people_at(3, 4)
    points = (centers[:, None] + rng.normal(0, 0.7, (4, 500, 3))).astype(np.float32)
    R = batches.rotation_to(torch.tensor(centers)).numpy()
    root_z = np.linalg.norm(centers, axis=1)
    in_view = np.einsum("bij,bnj->bni", R, points)
    ok = torch.ones(4, 500, dtype=torch.bool)
    grids = batches.depth_grid(torch.tensor(in_view).float(), ok, torch.tensor(root_z).float()).numpy()
    columns = batches.columns(torch.tensor(in_view), torch.tensor(root_z)).numpy()
    for i, center in enumerate(centers):
        view = PersonView.towards(center)
        np.testing.assert_allclose(view.R_view_cam, R[i], atol=1e-12)
        assert (np.abs(view.depth_grid(points[i]) - grids[i]) > 1e-4).sum() <= 4
        good = in_view[i, :, 2] > 0.15
        np.testing.assert_allclose(view.from_cam(points[i].astype(float))[good], columns[i][good], atol=1e-6)
