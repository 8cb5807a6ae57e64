"""Distance over a measured floor: right for drawn people, and better than the size alone for tall and short ones."""

from dataclasses import replace

import numpy as np
import pytest
from test_apparent_size import BODY
from test_roots import CAMERA

from understudy.apparent_size import LOG_DISTANCES, distance_of, size_log_likelihood
from understudy.floor import Floor
from understudy.roots import find_roots
from understudy.skeleton import JOINT, JOINTS, N_JOINTS, TORSO
from understudy.standing import NETWORK_SIGMA, floor_log_likelihood, stood
from understudy.types import Keypoints2D, RegisteredDepth, RegisteredFrame
from understudy.voxel_lifting import VoxelLifter

ANKLE, HIPS = 0.11, 0.79  # metres: ankles over the floor, hips over the ankles
UP = np.array([0.0, -1.0, 0.0])


def standing(distance: float, camera: float, size: float = 1.0) -> np.ndarray:
    """Joints (metres, level camera `camera` metres over the floor) of somebody `size` times as large as an adult."""
    x, y = np.array([BODY[n.split("_")[-1]] for n in JOINTS]).T
    x = np.where([n.startswith("right") for n in JOINTS], -x, x)
    down = camera - size * (HIPS + ANKLE - y)
    return np.column_stack([size * x, down, np.full(N_JOINTS, distance)])


def pitched(angle: float) -> np.ndarray:
    """R_cam_level of a camera that looks down by `angle` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rays(points: np.ndarray) -> np.ndarray:
    return points[:, :2] / points[:, 2:]


def judged(distance: float, camera: float, size: float = 1.0, pitch: float = 0.0) -> tuple[float, float]:
    R = pitched(pitch)
    ray = rays(standing(distance, camera, size) @ R.T)
    said = floor_log_likelihood(ray, Floor(R @ UP, -camera))
    assert said is not None
    return distance_of(said)


@pytest.mark.parametrize("pitch", [0.0, 0.35])
@pytest.mark.parametrize("camera", [0.6, 1.2, 2.0])
@pytest.mark.parametrize("distance", [1.5, 3.0, 5.0])
def test_who_stands_is_where_the_floor_says(distance: float, camera: float, pitch: float):
    """Turned by the same pitch, camera and floor say the same."""
    found, sigma = judged(distance, camera, pitch=pitch)
    true = np.linalg.norm(standing(distance, camera)[[JOINT["neck"], JOINT["right_hip"], JOINT["left_hip"]]].mean(0))
    assert abs(np.log(found / true)) < 0.1
    assert sigma < 0.2


@pytest.mark.parametrize("size", [0.86, 1.14])
def test_tall_and_short_people(size: float):
    """Their size alone puts them wrong by how far it is from the usual one; the floor takes most of that back."""
    camera, distance = 1.4, 3.0
    ray = rays(standing(distance, camera, size))
    sized = size_log_likelihood(ray)
    said = floor_log_likelihood(ray, Floor(UP, -camera))
    alone, together = (abs(np.log(distance_of(x)[0] / distance)) for x in (sized, sized + said))
    assert alone > 0.1
    assert together < 0.6 * alone


def test_nothing_to_go_by():
    floor = Floor(UP, -1.2)
    assert floor_log_likelihood(np.full((N_JOINTS, 2), np.nan), floor) is None
    arm = np.full((N_JOINTS, 2), np.nan)
    arm[JOINT["left_wrist"]] = 0.1
    assert floor_log_likelihood(arm, floor) is None
    steep = pitched(1.5)
    assert floor_log_likelihood(rays(standing(3.0, 1.2)), Floor(steep @ UP, -1.2)) is None


def beside_the_depth_image(size: float, camera: float = 1.1) -> tuple[np.ndarray, Keypoints2D, RegisteredDepth]:
    """Joints, 2D keypoints, and the depth of a floor without the person: as beside the narrower image of a Kinect."""
    points = standing(3.0, camera, size)
    v, _ = np.mgrid[0:540, 0:960].astype(np.float64)
    slope = (v - 269.5) / 540.7
    z = np.where(slope > 0.1, camera / np.maximum(slope, 0.1), 0.0)
    z[:, 380:580] = 0  # nothing around the person
    who = Keypoints2D.where(CAMERA.project(points), np.full(N_JOINTS, 0.9))
    return points, who, RegisteredDepth(z.astype(np.float32), CAMERA)


@pytest.mark.parametrize("size", [0.87, 1.0, 1.13])
def test_a_root_outside_the_depth_image(size: float):
    """The floor is measured, the person is not."""
    camera, distance = 1.1, 3.0
    _, who, depth = beside_the_depth_image(size, camera)
    without, with_it = (find_roots(who, depth, CAMERA, floor=f)[0] for f in (None, Floor(UP, -camera)))
    assert with_it.evidence == "size"
    off = [abs(root.point[2] / distance - 1) for root in (without, with_it)]
    assert off[1] < 0.1
    assert with_it.floor_likelihood is not None and without.floor_likelihood is None
    assert size == 1.0 or off[1] < 0.7 * off[0]


@pytest.mark.parametrize("floor_sigma", [0.02, 0.1, 100.0])
def test_between_the_network_and_the_floor(floor_sigma: float):
    """Product of two normal distributions of the log distance; nothing moves off its ray."""
    joints = standing(3.0, 1.2)
    trunk = np.linalg.norm(joints[TORSO].mean(0))
    says = np.log(trunk) + 0.15
    out = stood(joints, -0.5 * ((LOG_DISTANCES - says) / floor_sigma) ** 2)
    share = 1 / floor_sigma**2 / (1 / floor_sigma**2 + 1 / NETWORK_SIGMA**2)
    assert np.allclose(out, joints * np.exp(0.15 * share), rtol=2e-3)


def test_the_lifter_puts_who_was_not_measured_there(monkeypatch: pytest.MonkeyPatch):
    """The last word on the distance is `stood`'s; nobody else is moved."""
    _, who, depth = beside_the_depth_image(1.0)
    frame = RegisteredFrame(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA, depth)
    (before,) = VoxelLifter().lift(frame, [who])
    moved: list[np.ndarray] = []

    def away(joints: np.ndarray, floor_likelihood: np.ndarray) -> np.ndarray:
        moved.append(joints)
        return 1.5 * joints

    monkeypatch.setattr("understudy.voxel_lifting.stood", away)
    (after,) = VoxelLifter().lift(frame, [who])
    assert len(moved) == 1
    np.testing.assert_array_equal(after.keypoints, 1.5 * moved[0])
    ratio = np.linalg.norm(after.keypoints, axis=1) / np.linalg.norm(before.keypoints, axis=1)
    assert np.ptp(ratio) < 1e-9  # along the rays
    wall = replace(depth, z=np.full_like(depth.z, 3.0))
    VoxelLifter().lift(replace(frame, depth=wall), [who])
    assert len(moved) == 1
