"""The paper's grid, input, result and lifter."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera
from understudy.lifting import Lifter
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import INFERRED, OBSERVED, Keypoints2D, RegisteredDepth, RegisteredFrame
from understudy.voxelposenet import paper_lifter
from understudy.voxelposenet.paper_grid import (
    PaperGrid,
    PaperRoot,
    assemble_paper,
    depth_points,
    network_input,
    occupancy,
    paper_root,
    score_maps,
    volume_peaks,
)

CAMERA = Camera(240, 160, np.array([[130.0, 0, 120.5], [0, 131.0, 78.0], [0, 0, 1.0]]))
NECK, RIGHT_HIP, LEFT_HIP = JOINT["neck"], JOINT["right_hip"], JOINT["left_hip"]
CELL = 2.2 * 1.2 / 64


def seen(points, score=0.9):
    """2D keypoints of some joints' points (metres): {row: point}."""
    rows = np.zeros((N_JOINTS, 3))
    for joint, point in points.items():
        rows[joint] = *CAMERA.project(np.array(point, dtype=np.float64)), score
    return Keypoints2D.from_rows(rows)


def wall(z):
    return RegisteredDepth(np.full((CAMERA.height, CAMERA.width), z, np.float32), CAMERA)


def grid_at(x, y, z, joint=NECK):
    return PaperGrid.around(PaperRoot(joint, np.array([x, y, z], dtype=np.float64)))


# --- root ---


def test_root_is_the_neck_then_right_hip_then_left_hip():
    all_three = {NECK: (0.1, -0.3, 2.0), RIGHT_HIP: (-0.1, 0.2, 2.0), LEFT_HIP: (0.2, 0.2, 2.0)}
    for joint in (NECK, RIGHT_HIP, LEFT_HIP):
        root = paper_root(seen(all_three), wall(2.0), CAMERA)
        assert root is not None and root.joint == joint
        np.testing.assert_allclose(root.xyz, all_three.pop(joint), atol=1e-6)
    assert paper_root(seen(all_three), wall(2.0), CAMERA) is None
    assert paper_root(seen({NECK: (0, 0, 2.0)}, score=0.5), wall(2.0), CAMERA) is None
    assert paper_root(seen({JOINT["nose"]: (0, 0, 2.0)}), wall(2.0), CAMERA) is None


def test_root_takes_the_median_of_three_and_needs_depth():
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth[78, 120], depth[78, 121], depth[77, 120], depth[75, 120] = 2.0, 3.5, 2.2, 9.0
    keypoints = seen({NECK: (0, 0, 2.0), LEFT_HIP: (0.5, 0.5, 2.0)})
    root = paper_root(keypoints, RegisteredDepth(depth, CAMERA), CAMERA)
    assert root is not None and root.joint == NECK
    assert root.xyz[2] == pytest.approx(2.2)
    depth[75:79] = 0
    depth[95:125, 140:170] = 2.5
    root = paper_root(keypoints, RegisteredDepth(depth, CAMERA), CAMERA)
    assert root is not None and root.joint == LEFT_HIP


# --- grid ---


@pytest.mark.parametrize("joint, low, high", [(NECK, -0.4, 1.8), (RIGHT_HIP, -1.1, 1.1), (LEFT_HIP, -1.1, 1.1)])
def test_box(joint, low, high):
    root = np.array([0.3, -0.2, 2.5])
    grid = PaperGrid.around(PaperRoot(joint, root))
    np.testing.assert_allclose(grid.origin - root, 1.2 * np.array([-1.1, low, -1.1]))
    np.testing.assert_allclose(grid.origin + 64 * grid.cell - root, 1.2 * np.array([1.1, high, 1.1]))
    np.testing.assert_allclose(grid.metres(np.zeros(3)), grid.origin + grid.cell / 2)
    np.testing.assert_allclose(grid.index(grid.origin), -0.5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_index_and_metres_are_inverse(seed):
    rng = np.random.default_rng(seed)
    grid = grid_at(*rng.uniform(-2, 4, 3))
    points = rng.uniform(-5, 5, (50, 3))
    np.testing.assert_allclose(grid.metres(grid.index(points)), points, atol=1e-9)
    index = rng.integers(0, 64, (50, 3))
    np.testing.assert_allclose(grid.index(grid.metres(index)), index, atol=1e-9)
    assert grid.contains(grid.metres(index)).all()
    inside = ((grid.index(points) >= -0.5) & (grid.index(points) < 63.5)).all(1)
    np.testing.assert_array_equal(grid.contains(points), inside)
    assert not grid.contains(np.full(3, np.nan))


@given(st.integers(0, 2**32 - 1), st.integers(0, 400))
@settings(max_examples=30, deadline=None)
def test_occupancy_of_known_points(seed, n):
    rng = np.random.default_rng(seed)
    grid = grid_at(*rng.uniform(-1, 3, 3))
    index = rng.integers(-3, 67, (n, 3))
    points = grid.metres(index + rng.uniform(-0.49, 0.49, (n, 3))).astype(np.float32)
    points = np.concatenate([points, np.full((1, 3), np.nan, np.float32), np.full((1, 3), 1e30, np.float32)])
    expected = np.zeros((64, 64, 64), np.float32)
    inside = index[((index >= 0) & (index < 64)).all(1)]
    expected[tuple(inside.T)] = 1
    np.testing.assert_array_equal(occupancy(points, grid), expected)


def test_occupancy_is_fast():
    """Target: 2 ms for 100 000 points. The bound here is loose, for busy machines."""
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (100_000, 3)).astype(np.float32)
    grid = grid_at(0, 0, 0)
    times = []
    for _ in range(10):
        start = time.perf_counter()
        occupancy(points, grid)
        times.append(time.perf_counter() - start)
    assert min(times) < 0.01


def test_depth_points_are_the_pixels():
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth[3, 5], depth[100, 200] = 1.5, 2.5
    expected = CAMERA.unproject(np.array([[5.0, 3.0], [200.0, 100.0]]), np.array([1.5, 2.5]))
    np.testing.assert_allclose(depth_points(RegisteredDepth(depth, CAMERA)), expected, atol=1e-6)


# --- input ---


def test_score_maps():
    root = PaperRoot(NECK, np.array([0.1, -0.3, 2.0]))
    grid = PaperGrid.around(root)
    wrist = grid.metres(np.array([40, 22, 0])) + (0.01, -0.01, 0)  # within its cell
    wrist[2] = 2.0
    elbow = grid.metres(np.array([0, 22, 0]))  # the outermost cells
    elbow[2] = 2.0
    keypoints = seen({NECK: root.xyz, 4: wrist, 3: elbow, 10: (0, 1.99, 2.0)})  # 10: below the box
    maps = score_maps(keypoints, CAMERA, root)
    x, y = np.mgrid[:64, :64]
    np.testing.assert_allclose(maps[:, :, 4], np.exp(-((x - 40) ** 2 + (y - 22) ** 2) / 9), atol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(maps.any((0, 1))), [NECK, 4])
    assert np.unravel_index(maps[:, :, NECK].argmax(), (64, 64)) == tuple(np.rint(grid.index(root.xyz)[:2]).astype(int))
    weak = Keypoints2D.where(keypoints.uv, np.where(np.arange(18) == 4, 0.5, keypoints.score))
    assert not score_maps(weak, CAMERA, root)[:, :, 4].any()


def test_score_maps_lie_at_the_roots_depth():
    """Orthographic: a keypoint at another depth is put where its ray meets the root's plane."""
    root = PaperRoot(NECK, np.array([0.0, 0.0, 2.0]))
    maps = score_maps(seen({4: (0.6, 0.3, 2.4)}), CAMERA, root)
    expected = np.rint(PaperGrid.around(root).index(np.array([0.5, 0.25, 2.0])))[:2]
    assert np.unravel_index(maps[:, :, 4].argmax(), (64, 64)) == tuple(expected.astype(int))


def test_network_input():
    root = PaperRoot(RIGHT_HIP, np.array([0.0, 0.2, 2.0]))
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (500, 3)).astype(np.float32)
    keypoints = seen({RIGHT_HIP: root.xyz, 0: (0.1, -0.6, 2.0)})
    x = network_input(points, keypoints, CAMERA, root)
    assert x.shape == (64, 64, 64, 19) and x.dtype == np.float32
    np.testing.assert_array_equal(x[..., 0], occupancy(points, PaperGrid.around(root)))
    for z in (0, 31, 63):
        np.testing.assert_array_equal(x[:, :, z, 1:], score_maps(keypoints, CAMERA, root))


# --- output ---


def test_peaks():
    grid = grid_at(0, 0, 2)
    volumes = np.random.default_rng(0).uniform(-1, 0.2, (18, 64, 64, 64)).astype(np.float32)
    index = np.random.default_rng(1).integers(0, 64, (18, 3))
    volumes[(np.arange(18), *index.T)] = np.linspace(0.3, 1.1, 18)
    xyz, score = volume_peaks(volumes, grid)
    np.testing.assert_allclose(xyz, grid.metres(index))
    np.testing.assert_allclose(score, np.linspace(0.3, 1.1, 18), atol=1e-6)


def test_assembly():
    """The true joints; the network errs across the ray, never in depth."""
    rng = np.random.default_rng(0)
    truth = rng.uniform((-0.6, -0.5, 1.8), (0.6, 0.5, 2.6), (18, 3))
    network = truth + np.column_stack([rng.normal(0, 0.03, (18, 2)), np.zeros(18)])
    rows = np.column_stack([CAMERA.project(truth), np.full(18, 0.7)])
    rows[5] = 0  # not found
    score3d = np.where(np.arange(18) % 2, 0.6, 0.8)
    got = assemble_paper(Keypoints2D.from_rows(rows), CAMERA, network, score3d)
    by_2d = (score3d < 0.7) & (np.arange(18) != 5)
    np.testing.assert_allclose(got[by_2d], truth[by_2d], atol=1e-9)
    np.testing.assert_array_equal(got[~by_2d], network[~by_2d])
    np.testing.assert_array_equal(got[:, 2], network[:, 2])


def test_assembly_keeps_what_has_no_ray():
    lens = Camera(240, 160, CAMERA.K, "brown_conrady", (-0.4, 0.0, 0.0, 0.0, 0.0))
    xyz = np.tile([0.1, 0.2, 2.0], (18, 1))
    xyz[3, 2] = -0.2  # the box reaches behind a close camera
    uv = np.tile([120.0, 80.0], (18, 1))
    uv[2] = 1e4  # no ray of this lens
    got = assemble_paper(Keypoints2D(uv, np.full(18, 0.9)), lens, xyz, np.full(18, 0.1))
    assert np.isfinite(got).all()
    np.testing.assert_array_equal(got[[2, 3]], xyz[[2, 3]])
    assert not np.allclose(got[4], xyz[4])


# --- lifter ---


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    pytest.importorskip("torch")
    pytest.importorskip("safetensors")
    from test_paper_net import formula_weights

    from understudy.voxelposenet.tensorflow_weights import save_paper_weights

    path = tmp_path_factory.mktemp("weights") / "fast.safetensors"
    save_paper_weights(formula_weights("paper-fast"), path)
    return path


def frame_of(z):
    color = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return RegisteredFrame(color, CAMERA, wall(z))


def test_lifter_runs_the_network(weights):
    lifter = paper_lifter.PaperLifter(weights)
    assert isinstance(lifter, Lifter) and lifter.variant == "paper-fast"
    root = np.array([0.1, -0.3, 2.0])
    people = [seen({0: (0, 0, 2.0)}), seen({NECK: root, RIGHT_HIP: (0.0, 0.2, 2.0)})]
    first, second = lifter.lift(frame_of(2.0), people)
    assert first.failed == paper_lifter.NO_ROOT and first.keypoints_2d is people[0]
    assert second.failed is None and np.isfinite(second.keypoints).all()
    assert second.source == tuple(OBSERVED if j in (NECK, RIGHT_HIP) else INFERRED for j in range(18))
    assert ((second.confidence >= 0) & (second.confidence <= 1)).all()
    assert ((second.sigma_m > 0) & (second.sigma_m <= 0.5)).all()
    again = lifter.lift(frame_of(2.0), people)[1]
    np.testing.assert_array_equal(again.keypoints, second.keypoints)
    assert lifter.lift(frame_of(2.0), []) == []


def test_lifter_with_a_perfect_network(weights, monkeypatch):
    """Volumes as the loss asks for: joints come back within half a cell, with assembly on their rays."""
    torch = pytest.importorskip("torch")
    from understudy.voxelposenet.paper_net import target_volumes

    rng = np.random.default_rng(3)
    truth = rng.uniform((-0.6, -0.3, 1.8), (0.6, 0.9, 2.6), (18, 3))
    truth[NECK] = 0.05, -0.2, 2.0
    grid = PaperGrid.around(PaperRoot(NECK, truth[NECK]))
    scale = np.where(np.arange(18) < 9, 1.0, 0.5)  # the network is sure of the first nine
    index = torch.from_numpy(grid.index(truth)[None])
    volumes = (target_volumes(index, (64, 64, 64))[0] * torch.from_numpy(scale)[:, None, None, None]).float().numpy()
    keypoints = Keypoints2D(CAMERA.project(truth), np.full(18, 0.7))
    for assembly in (True, False):
        lifter = paper_lifter.PaperLifter(weights, assembly)
        monkeypatch.setattr(lifter, "_score_volume", lambda net, x: volumes)
        (person,) = lifter.lift(frame_of(2.0), [keypoints])
        error = np.abs(person.keypoints - truth)
        assert error[:, 2].max() < CELL / 2 + 1e-5
        if assembly:
            ray_error = np.abs(CAMERA.project(person.keypoints) - keypoints.uv).max(1)
            assert (ray_error[9:] < 1e-6).all() and (ray_error[:9] > 1e-3).all()
        else:
            assert error.max() < CELL / 2 + 1e-5
        assert (person.confidence[:9] > 0.9).all() and (person.confidence[9:] < 0.51).all()
        assert person.sigma_m[:9].max() < person.sigma_m[9:].min()


def test_sigma_is_that_of_a_mean_of_targets():
    rng = np.random.default_rng(0)
    offsets = rng.standard_normal((400_000, 3))
    for s in (1.0, 2.5):  # cells
        peak = np.exp(-((s * offsets) ** 2).sum(1) / 9).mean()
        sigma = paper_lifter.sigma_of_score(np.full(18, peak), 1e-3)
        np.testing.assert_allclose(sigma, 1e-3 * np.sqrt(s**2 + 1 / 12), rtol=0.02)
    assert paper_lifter.sigma_of_score(np.full(18, -0.1), CELL).max() <= 0.5
