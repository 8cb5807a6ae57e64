"""Markers: tags rendered exactly (supersampled, blurred, noisy; depth with bias, noise and holes) against truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.errors import UnderstudyError
from understudy.geometry import rigid
from understudy.objects import marker_setup
from understudy.objects.marker_corners import fit_corners
from understudy.objects.marker_pose import model_corners
from understudy.objects.marker_setup import MarkerSetup, track_markers
from understudy.objects.markers import DICTIONARIES, MarkerTracker
from understudy.types import RegisteredDepth, RegisteredFrame

CAMERA = Camera(1280, 720, np.array([[910.0, 0, 639.5], [0, 910.0, 359.5], [0, 0, 1]]))
SIZE_M, FINE, BOARD_M = 0.1, 4, 0.5


def on_plane(T: np.ndarray, camera: Camera, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of pixels meet a marker's plane: (x, y) in the marker's frame, and z along the camera."""
    rays = np.concatenate([(uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((*uv.shape[:-1], 1))], -1)
    z = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
    return ((rays * z[..., None] - T[:3, 3]) @ T[:3, :3])[..., :2], z


def rendered(
    poses: dict[int, np.ndarray],
    seed: int = 0,
    dictionary: str = "apriltag_36h11",
    blur_px: float | tuple[float, float] = 0.7,
) -> RegisteredFrame:
    """Tags with a white border on a board each; depth at half the size."""
    random = np.random.default_rng(seed)
    color = np.full((720, 1280), 110.0)
    depth_camera = CAMERA.resize(640, 360)
    depth = np.full((360, 640), 6.0)
    grid = np.stack(np.meshgrid(np.arange(640.0), np.arange(360.0)), -1)
    for id, T in poses.items():
        family = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
        cells = family.markerSize + 2
        bits = cv2.aruco.generateImageMarker(family, id, cells, borderBits=1)
        corners = CAMERA.project(model_corners(SIZE_M * 1.6) @ T[:3, :3].T + T[:3, 3])
        low = np.maximum(np.floor(corners.min(0)).astype(int) - 4, 0)
        high = np.minimum(np.ceil(corners.max(0)).astype(int) + 4, (1280, 720))
        u, v = ((np.arange(a * FINE, b * FINE) + 0.5) / FINE - 0.5 for a, b in zip(low, high, strict=True))
        xy, _ = on_plane(T, CAMERA, np.stack(np.meshgrid(u, v), -1))
        column, row = xy[..., 0] / SIZE_M + 0.5, 0.5 - xy[..., 1] / SIZE_M
        inside = (np.abs(column - 0.5) < 0.5) & (np.abs(row - 0.5) < 0.5)
        border = np.maximum(np.abs(column - 0.5), np.abs(row - 0.5)) < 0.5 + 1 / cells
        i, j = (np.clip((x * cells).astype(int), 0, cells - 1) for x in (row, column))
        value = np.where(inside, 25 + 200.0 * (bits[i, j] > 127), np.where(border, 225.0, 150.0))
        shape = (high[1] - low[1], FINE, high[0] - low[0], FINE)
        color[low[1] : high[1], low[0] : high[0]] = value.reshape(shape).mean((1, 3))
        xy, z = on_plane(T, depth_camera, grid)
        depth = np.where((np.abs(xy) < BOARD_M / 2).all(-1) & (z > 0), z + random.normal(0, 0.002), depth)
    across, down = blur_px if isinstance(blur_px, tuple) else (blur_px, blur_px)
    color = cv2.GaussianBlur(color, (0, 0), sigmaX=across, sigmaY=down) + random.normal(0, 3, color.shape)
    rgb = np.repeat(np.clip(color, 0, 255).astype(np.uint8)[..., None], 3, 2)
    smooth = cv2.GaussianBlur(random.normal(size=depth.shape), (0, 0), 0.8)
    depth = depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * smooth / smooth.std()
    depth[random.random(depth.shape) < 0.1] = 0
    return RegisteredFrame(rgb, CAMERA, RegisteredDepth(depth.astype(np.float32), depth_camera))


def pose(distance: float, tilt_deg: float, seed: int, shift: float = 0.0) -> np.ndarray:
    """A tag that faces the camera but for a tilt about a random axis."""
    random = np.random.default_rng(seed)
    p = distance * np.array([random.uniform(-0.25, 0.25) + shift, random.uniform(-0.15, 0.15), 1])
    about = random.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0]))
    spin = Rotation.from_rotvec([0, 0, random.uniform(-0.6, 0.6)])
    return rigid((tilt * spin).as_matrix() @ np.diag([1.0, -1, -1]), p)


def error(T_true: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(dp, dr): metres, radians."""
    turn = Rotation.from_matrix(T_true[:3, :3] @ T[:3, :3].T).as_rotvec()
    return np.concatenate([T_true[:3, 3] - T[:3, 3], turn])


@pytest.mark.parametrize("distance", [0.7, 2.4, 3.5])
@pytest.mark.parametrize("tilt_deg", [0, 30])
def test_poses_with_depth(distance: float, tilt_deg: float) -> None:
    """A 10 cm tag of 26 to 130 pixels: within 1 cm and 2 degrees."""
    for seed in range(2):
        T = pose(distance, tilt_deg, seed)
        found = MarkerTracker(SIZE_M).detect(rendered({7: T}, seed))
        assert set(found) == {7} and found[7].used_depth
        e = error(T, found[7].T_cam_marker)
        assert np.linalg.norm(e[:3]) < 0.01
        assert np.degrees(np.linalg.norm(e[3:])) < 2


@pytest.mark.parametrize("distance", [0.8, 1.6])
def test_oblique_tags(distance: float) -> None:
    for seed in range(3):
        T = pose(distance, 60, seed)
        e = error(T, MarkerTracker(SIZE_M).detect(rendered({7: T}, seed))[7].T_cam_marker)
        assert np.linalg.norm(e[:3]) < 0.01 and np.degrees(np.linalg.norm(e[3:])) < 2


def test_covariances_are_honest() -> None:
    """Normalised squared errors of 6 numbers: 6 on average where all is Gaussian. From 2.0 to 3.4 m and 15 to
    60 degrees within a factor of 2.5 of that, as standard deviations.
    """
    scores = []
    for seed in range(10):
        T = pose(2.0 + 0.15 * seed, 15 + 5 * seed, seed)
        found = MarkerTracker(SIZE_M).detect(rendered({7: T}, seed))[7]
        e = error(T, found.T_cam_marker)
        scores.append(e @ np.linalg.solve(found.covariance, e))
    assert 6 / 2.5**2 < np.mean(scores) < 6 * 2.5**2, scores


def test_depth_resolves_the_mirrored_pose() -> None:
    """At 2.5 m and 25 degrees: with depth the right one always, and said to be sure; it also mends the distance."""
    without, with_depth = [], []
    for seed in range(5):
        T = pose(2.5, 25, seed)
        frame = rendered({7: T}, seed)
        for depth, errors in ((True, with_depth), (False, without)):
            found = MarkerTracker(SIZE_M, depth=depth).detect(frame)[7]
            errors.append(error(T, found.T_cam_marker))
            assert found.used_depth == depth
            if depth:
                assert found.ambiguity < 0.01 and np.degrees(np.linalg.norm(errors[-1][3:])) < 4
    assert np.median(np.abs(with_depth)[:, 2]) < 1.2 * np.median(np.abs(without)[:, 2]) + 0.002


def test_following_loses_nothing() -> None:
    """A tag that drifts, jumps across the image, hides, and comes back far away: found in each frame that shows it, as
    well as by looking at that frame alone.
    """
    tracker = MarkerTracker({7: SIZE_M})
    places = [(-0.5, 1.5), (-0.48, 1.55), (0.6, 1.5), None, (-0.4, 3.2), (-0.35, 3.2)]
    for k, place in enumerate(places):
        T = pose(1.0, 20, 5)
        T[:3, 3] = (0, 0.1, 1) if place is None else (place[0], 0.1, place[1])
        frame = rendered({} if place is None else {7: T}, k)
        found, alone = tracker.detect(frame), MarkerTracker({7: SIZE_M}).detect(frame)
        assert set(found) == set(alone) == (set() if place is None else {7})
        if place is not None:
            assert np.linalg.norm(error(T, found[7].T_cam_marker)[:3]) < 0.01
            assert np.abs(found[7].corners_2d - alone[7].corners_2d).max() < 0.3


def test_a_tag_that_is_there_twice_is_left_out() -> None:
    T, other = pose(1.2, 10, 3), pose(1.2, 10, 3)
    T[:3, 3], other[:3, 3] = (-0.4, 0, 1.2), (0.4, 0, 1.2)
    frame = rendered({7: T})
    both = frame.color.copy()
    both[:, 640:] = rendered({7: other}).color[:, 640:]
    assert set(MarkerTracker(SIZE_M).detect(frame)) == {7}
    assert MarkerTracker(SIZE_M).detect(RegisteredFrame(both, CAMERA, frame.depth)) == {}


def test_without_depth_pixels_colour_alone_is_used() -> None:
    T = pose(1.0, 30, 1)
    frame = rendered({7: T})
    dark = RegisteredFrame(frame.color, CAMERA, RegisteredDepth(np.zeros_like(frame.depth.z), frame.depth.camera))
    found = MarkerTracker({7: SIZE_M}).detect(dark)[7]
    assert not found.used_depth and np.linalg.norm(error(T, found.T_cam_marker)[:3]) < 0.01


@pytest.mark.parametrize("blur_px", [(0.5, 0.5), (1.3, 1.3), (0.7, 2.5)])
def test_blur_is_found_and_does_no_harm(blur_px: tuple[float, float]) -> None:
    """A sharp lens, one out of focus, and a marker that moves: a 10 cm tag at 1.8 m, its distance within 2 mm."""
    for seed in range(2):
        T = pose(1.8, 25, seed)
        frame = rendered({7: T}, seed, blur_px=blur_px)
        e = error(T, MarkerTracker({7: SIZE_M}).detect(frame)[7].T_cam_marker)
        assert np.linalg.norm(e[:3]) < 0.002 and np.degrees(np.linalg.norm(e[3:])) < 0.3
        gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        true = CAMERA.project(model_corners(SIZE_M) @ T[:3, :3].T + T[:3, 3])
        pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARIES["apriltag_36h11"]), 7, 8)
        found = fit_corners(gray, true + np.random.default_rng(seed).uniform(-0.7, 0.7, (4, 2)), pattern)
        assert found.blur is not None and np.abs(found.uv - true).max() < 0.08
        assert np.sqrt(np.diag(found.blur)) == pytest.approx(blur_px, abs=0.2)
        e = (found.uv - true).ravel()
        assert e @ np.linalg.solve(found.covariance, e) < 40, "8 numbers, and a covariance that holds them"


def test_what_covers_a_corner_of_a_tag_is_left_out() -> None:
    """A thumb over the white rim and a part of the black border."""
    T = pose(1.0, 15, 3)
    frame = rendered({7: T})
    corner = CAMERA.project(model_corners(SIZE_M) @ T[:3, :3].T + T[:3, 3])[0]
    color = frame.color.copy()
    cv2.circle(color, tuple(round(float(x)) for x in corner), 9, (200, 150, 130), -1)
    e = error(T, MarkerTracker({7: SIZE_M}).detect(RegisteredFrame(color, CAMERA, frame.depth))[7].T_cam_marker)
    assert np.linalg.norm(e[:3]) < 0.003 and np.degrees(np.linalg.norm(e[3:])) < 1


def test_no_pattern_no_fit() -> None:
    gray = np.random.default_rng(0).integers(0, 255, (100, 100), dtype=np.uint8)
    corners = np.array([[30.0, 30], [70, 30], [70, 70], [30, 70]])
    pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARIES["apriltag_36h11"]), 7, 8)
    found = fit_corners(gray, corners, pattern)
    assert found.blur is None and (found.uv == corners).all() and found.covariance[0, 0] > 0.1


def test_markers_of_one_thing_outvote_a_wrong_one() -> None:
    """Three say the same; the fourth, which claims to be the surest, is 5 cm away."""
    T = np.eye(4)
    wrong = rigid(np.eye(3), np.array([0.05, 0, 0]))
    C = np.diag([1e-6] * 3 + [1e-5] * 3)
    fused, covariance = marker_setup._fused([(wrong, C / 10), (T, C), (T, 2 * C), (T, C)])
    assert np.allclose(fused, T) and np.allclose(covariance, C / 2.5)


def test_other_dictionaries_and_their_ids() -> None:
    T = pose(1.0, 20, 2)
    frame = rendered({5: T}, dictionary="4x4_50")
    found = MarkerTracker(SIZE_M, "4x4_50").detect(frame)
    assert np.linalg.norm(error(T, found[5].T_cam_marker)[:3]) < 0.01
    assert MarkerTracker(SIZE_M).detect(frame) == {}
    assert MarkerTracker({4: SIZE_M}, "4x4_50").detect(frame) == {}
    with pytest.raises(UnderstudyError, match="'apriltag_36h11'"):
        MarkerTracker(SIZE_M, "qr")
    with pytest.raises(UnderstudyError, match=r"ids 0 to 49, not \[50\]"):
        MarkerTracker({50: 0.1}, "4x4_50")
    with pytest.raises(UnderstudyError, match="positive"):
        MarkerTracker(0.0)


def test_tracks_flag_what_was_missed_and_fuse_what_was_seen() -> None:
    """Two tags on the object, one on the hand which leaves in the second of three frames."""
    offset = rigid(np.eye(3), np.array([0.28, 0, 0]))  # from the first of the object's tags to the second
    T_first, T_hand = pose(1.2, 25, 3), pose(1.0, 10, 4)
    T_first[:3, 3], T_hand[:3, 3] = (-0.3, 0.15, 1.2), (0.35, -0.28, 1.0)
    T_world_cam = rigid(Rotation.from_rotvec([-1.8, 0.2, 0.1]).as_matrix(), np.array([0.5, -1, 1.4]))
    data = {
        "dictionary": "apriltag_36h11",
        "markers": [
            {"id": 1, "size_m": SIZE_M, "on": "object", "T_marker_frame": np.eye(4).tolist()},
            {"id": 2, "size_m": SIZE_M, "on": "object", "T_marker_frame": np.linalg.inv(offset).tolist()},
            {"id": 3, "size_m": SIZE_M, "on": "hand", "T_marker_frame": np.eye(4).tolist()},
        ],
    }
    setup = MarkerSetup.from_json(data, "setup.json")
    both = {1: T_first, 2: T_first @ offset}
    frames = [rendered(both | ({3: T_hand} if k != 1 else {}), k) for k in range(3)]
    tracks = track_markers(frames, setup, T_world_cam)
    assert set(tracks) == {"object", "hand"}
    assert tracks["object"].observed.all() and tracks["object"].oriented.all()
    assert tracks["hand"].observed.tolist() == [True, False, True]
    assert np.isnan(tracks["hand"].T_world_x[1]).all() and np.isinf(np.diag(tracks["hand"].covariance[1])).all()
    for k in range(3):
        e = error(T_world_cam @ T_first, tracks["object"].T_world_x[k])
        assert np.linalg.norm(e[:3]) < 0.01 and np.degrees(np.linalg.norm(e[3:])) < 2
        assert e @ np.linalg.solve(tracks["object"].covariance[k], e) < 40
    one = MarkerSetup.from_json(data | {"markers": data["markers"][:1]}, "setup.json")
    alone = track_markers(frames[:1], one, T_world_cam)["object"]
    assert np.trace(tracks["object"].covariance[0]) < np.trace(alone.covariance[0])


def test_setup_files(tmp_path: Path) -> None:
    marker = {"id": 3, "size_m": 0.1, "on": "torso", "T_marker_frame": np.eye(4).tolist()}
    path = tmp_path / "markers.json"
    path.write_text(json.dumps({"dictionary": "apriltag_36h11", "markers": [marker]}))
    setup = MarkerSetup.read(path)
    assert setup.to_json() == json.loads(path.read_text())
    for wrong, says in (
        ({"dictionary": "36h11"}, "dictionary '36h11' is not one of"),
        ({"markers": []}, "markers must be a list"),
        ({"markers": [marker, marker]}, r"markers\[1\].id 3 is there twice"),
        ({"markers": [marker | {"on": "foot"}]}, r"markers\[0\].on 'foot' is not one of 'object', 'hand', 'torso'"),
        ({"markers": [marker | {"size_m": "big"}]}, r"markers\[0\].size_m"),
        ({"markers": [marker | {"id": 1.5}]}, r"markers\[0\].id"),
        ({"markers": [marker | {"id": 900}]}, "ids 0 to 586"),
        ({"markers": [marker | {"T_marker_frame": [[1]]}]}, r"markers\[0\].T_marker_frame"),
        ({"markers": [{"id": 1}]}, r"markers\[0\] has no 'size_m'"),
    ):
        path.write_text(json.dumps({"dictionary": "apriltag_36h11", "markers": [marker]} | wrong))
        with pytest.raises(UnderstudyError, match=r"markers\.json: .*" + says):
            MarkerSetup.read(path)
