"""Registration against an exact, ray-cast scene: what the depth camera measured, where the colour camera sees it."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera, RGBDCamera
from understudy.geometry import rigid, transform_points
from understudy.registration import HIDDEN_MARGIN, DepthRegistration, register
from understudy.types import Frame

K4A_COLOR = (0.33012131, -2.48939657, -0.00016178, -0.00012945, 1.45367086, 0.20891207, -2.30291510, 1.37512755)
K4A_DEPTH = (0.54793978, -0.02097137, 2.0557534e-5, -7.2104158e-5, -0.00265223, 0.88967907, 0.08613021, -0.01391038)
KINECT_1 = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)

# --- the scene, in the colour camera's frame (metres): a wall, a floor, two balls, a cupboard, a thin post ---

PLANES = [((0.05, 0, 1.0), 4.0), ((0, 1.0, 0.02), 1.1)]  # normal, offset
SPHERES = [((-0.6, 0.1, 2.2), 0.35), ((0.25, -0.45, 1.3), 0.18)]  # centre, radius
BOXES = [((0.3, 0.0, 1.8), (0.7, 1.2, 2.2)), ((-0.1, -0.9, 2.6), (-0.04, 1.0, 2.66))]  # corners


def cast(origin, directions):
    """How many `directions` (rays with z = 1 in some camera, so: the depth there) it is to the nearest surface."""
    nearest = np.full(directions.shape[:-1], np.inf)

    def meet(t):
        np.minimum(nearest, np.where(t > 1e-6, t, np.inf), out=nearest)

    with np.errstate(divide="ignore", invalid="ignore"):
        for normal, offset in PLANES:
            meet((offset - origin @ normal) / (directions @ normal))
        for centre, radius in SPHERES:
            a, b = (directions**2).sum(-1), directions @ (origin - centre)
            q = b * b - a * (((origin - centre) ** 2).sum() - radius**2)
            meet(np.where(q > 0, (-b - np.sqrt(np.maximum(q, 0))) / a, np.inf))
        for low, high in BOXES:
            t0, t1 = (low - origin) / directions, (high - origin) / directions
            enter, leave = np.minimum(t0, t1).max(-1), np.maximum(t0, t1).min(-1)
            meet(np.where(enter < leave, enter, np.inf))
    return nearest


def rays(camera, uv):
    xy = camera.normalized(uv)
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def pixels(camera):
    return np.stack(np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)), axis=-1)


def depth_image(sensor):
    """What the depth camera measures, exactly."""
    R, t = sensor.T_color_depth[:3, :3], sensor.T_color_depth[:3, 3]
    z = cast(t, rays(sensor.depth, pixels(sensor.depth)) @ R.T)
    return np.where(np.isfinite(z), z, 0).astype(np.float32)


def surfaces_around(camera, uv, reach):
    """Nearest and farthest surface that the camera sees within `reach` pixels (a square) of each of uv."""
    steps = np.linspace(-reach, reach, 2 * int(np.ceil(2 * reach)) + 1)
    z = [cast(np.zeros(3), rays(camera, uv + (du, dv))) for dv in steps for du in steps]
    return np.min(z, axis=0), np.max(z, axis=0)


def camera(width, height, focal, distortion=(), off=(3, -2)):
    model = {0: "none", 5: "brown_conrady", 8: "rational"}[len(distortion)]
    K = np.array(
        [[focal * width, 0, (width - 1) / 2 + off[0]], [0, focal * width, (height - 1) / 2 + off[1]], [0, 0, 1]]
    )
    return Camera(width, height, K, model, distortion)


TURN = cv2.Rodrigues(np.array([0.02, -0.025, 0.01]))[0]  # about 2 degrees
SENSORS = {
    "alike": (camera(240, 180, 0.9), camera(240, 180, 0.8), (0.1, 0, 0)),
    "to finer colour": (camera(480, 270, 0.9), camera(160, 144, 0.8), (-0.06, 0.01, 0.005)),
    "to coarser colour": (camera(120, 90, 0.9), camera(320, 288, 0.8), (-0.05, -0.05, -0.03)),
    "to much coarser colour": (camera(64, 48, 0.9), camera(320, 288, 0.8), (0.08, 0, 0)),
    "one and a half": (camera(360, 270, 0.9), camera(240, 200, 0.8), (0, -0.05, 0.03)),
    "even bridge": (camera(480, 360, 0.9), camera(200, 170, 0.8), (0.07, 0.02, 0)),
    "Azure Kinect's lenses": (
        camera(480, 270, 0.48, K4A_COLOR), camera(320, 288, 0.79, K4A_DEPTH), (-0.06, 0.01, 0.005)
    ),
    "Kinect v1's lens": (camera(320, 240, 0.81, KINECT_1), camera(160, 120, 0.9), (0.05, 0, 0)),
    "320x288 to full HD": (camera(1920, 1080, 0.48), camera(320, 288, 0.79, K4A_DEPTH), (-0.05, 0.002, -0.004)),
}  # fmt: skip


@pytest.fixture(scope="module", params=SENSORS)
def case(request):
    """A sensor, its depth image of the scene, the registered depth, and how far apart samples lie in colour pixels."""
    color, depth, t = SENSORS[request.param]
    sensor = RGBDCamera(color, depth, rigid(TURN, np.array(t)))
    measured = depth_image(sensor)
    return sensor, measured, DepthRegistration(sensor)(measured), max(1.0, color.fx / depth.fx)


def test_every_value_is_the_surface_that_colour_sees(case):
    """A value lies on what the colour camera sees within half a pixel: never before it, and behind it only in a rim.

    The rim is where the background shows beside the last sample of a near surface, whose outline no sample marks: it is
    narrower than the distance between samples (in colour pixels), and holds less than 0.7 % of all values. A surface
    less than the margin (3 % and 2 cm) behind another is not told from it.
    """
    sensor, _, z, spacing = case
    v, u = np.nonzero(z)
    values, uv = z[v, u], np.column_stack([u, v]).astype(float)
    nearest, farthest = surfaces_around(sensor.color, uv, 0.5)
    assert (values >= nearest * 0.999).all()
    behind = values > farthest * 1.001
    assert behind.mean() < 0.007
    if behind.any():
        _, farthest = surfaces_around(sensor.color, uv[behind], np.ceil(spacing))
        assert (values[behind] <= farthest * (1 + HIDDEN_MARGIN) + 0.02).all()


def test_what_colour_sees_of_the_samples_is_kept(case):
    """Samples that the colour camera sees too are in the result: 99.7 % of them, and nothing else fills the image."""
    sensor, measured, z, _ = case
    points = transform_points(
        sensor.T_color_depth, sensor.depth.unproject(pixels(sensor.depth), measured.astype(float))
    ).reshape(-1, 3)
    uv = sensor.color.project(points)
    inside = sensor.color.contains(uv) & (measured.ravel() > 0)
    points, uv = points[inside], uv[inside]
    seen = points[:, 2] <= cast(np.zeros(3), points / points[:, 2:]) * 1.001
    u, v = np.floor(uv + 0.5).astype(int).T
    assert seen.sum() > 2000
    assert (z[v, u] > 0)[seen].mean() > 0.997
    hit = np.zeros(z.shape, bool)
    hit[v, u] = True
    assert ((z > 0) & ~hit).sum() <= 1e-3 * hit.sum()  # single precision may put a point on a pixel's border beyond it


def test_no_wall_shines_through_a_near_board():
    """Far denser colour pixels than samples: the gaps between the board's samples stay empty."""
    color, depth = camera(960, 540, 0.9, off=(0, 0)), camera(128, 96, 0.9, off=(0, 0))
    for t in ((0.1, 0, 0), (-0.1, 0, 0), (0, 0.08, 0), (0.06, -0.06, 0.02)):
        sensor = RGBDCamera(color, depth, rigid(TURN, np.array(t)))
        xyz = depth.unproject(pixels(depth), 1.0)
        board = (np.abs(xyz[..., 0]) < 0.25) & (np.abs(xyz[..., 1]) < 0.2)
        measured = np.where(board, 1.0, 3.0).astype(np.float32)
        z = DepthRegistration(sensor)(measured)
        corners = np.array([[-0.25, -0.2, 1], [0.25, -0.2, 1], [0.25, 0.2, 1], [-0.25, 0.2, 1]])
        outline = np.rint(color.project(transform_points(sensor.T_color_depth, corners))).astype(np.int32)
        inside = cv2.fillConvexPoly(np.zeros(z.shape, np.uint8), outline, 1)
        inside = cv2.erode(inside, np.ones((19, 19), np.uint8)) > 0  # a sample's distance (7.5) and a pixel, each side
        assert 400 < (z[inside] > 0).sum() < inside.sum() / 20
        assert z[inside].max() < 1.1
        assert (z > 2.8).sum() > 2000


# --- no value is made up ---


@settings(deadline=None, max_examples=30)
@given(
    st.integers(0, 10_000),
    st.sampled_from([(12, 9, 16, 12), (40, 30, 12, 10), (10, 8, 30, 24)]),
    st.sampled_from([(), KINECT_1, K4A_COLOR]),
)
def test_each_value_is_a_measured_point_that_projects_there(seed, sizes, distortion):
    rng = np.random.default_rng(seed)
    color, depth = camera(*sizes[:2], 0.8, distortion, (0, 0)), camera(*sizes[2:], 0.7, (), (0, 0))
    R = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0]
    sensor = RGBDCamera(color, depth, rigid(R, rng.normal(0, 0.1, 3)))
    measured = rng.choice([0.0, 0.05, 0.8, 1.0, 1.02, 3.0], (depth.height, depth.width)).astype(np.float32)
    z = DepthRegistration(sensor)(measured)

    reaching = {}  # pixel -> z of the points that project into it; clearly so, or within a thousandth of its border
    for v in range(depth.height):
        for u in range(depth.width):
            if measured[v, u] > 0:
                p = transform_points(
                    sensor.T_color_depth, depth.unproject(np.array([[u, v]]) * 1.0, float(measured[v, u]))
                )
                (at,) = color.project(p)
                for du, dv in ((0, 0), (1e-3, 1e-3), (1e-3, -1e-3), (-1e-3, 1e-3), (-1e-3, -1e-3)):
                    if np.abs(at).max() < 1e6:  # neither NaN nor absurdly far
                        pixel = tuple(np.floor(at + (du + 0.5, dv + 0.5)).astype(int))
                        reaching.setdefault(pixel, {}).setdefault((u, v), [p[0, 2], 0])[1] += 1
    for v in range(color.height):
        for u in range(color.width):
            candidates = reaching.get((u, v), {}).values()
            if z[v, u] > 0:
                assert min((abs(c - z[v, u]) for c, _ in candidates), default=1) < 1e-5
                clear = [c for c, votes in candidates if votes == 5]
                assert z[v, u] <= min(clear, default=np.inf) + 1e-5  # the nearest one wins


def test_nothing_in_nothing_out():
    color, depth, t = SENSORS["to finer colour"]
    registration = DepthRegistration(RGBDCamera(color, depth, rigid(TURN, np.array(t))))
    z = registration(np.zeros((depth.height, depth.width), np.float32))
    assert z.shape == (color.height, color.width) and z.dtype == np.float32 and not z.any()


def test_holes_stay_holes():
    color, depth = camera(480, 360, 0.9), camera(160, 120, 0.9)
    sensor = RGBDCamera(color, depth, rigid(TURN, np.array([0.05, 0, 0])))
    measured = np.full((120, 160), 2.0, np.float32)
    whole = DepthRegistration(sensor)(measured)
    measured[40:70, 60:100] = 0
    z = DepthRegistration(sensor)(measured)
    corners = depth.unproject(np.array([[60, 40], [99, 40], [99, 69], [60, 69]]) * 1.0, 2.0)
    outline = np.rint(color.project(transform_points(sensor.T_color_depth, corners))).astype(np.int32)
    hole = cv2.fillConvexPoly(np.zeros(z.shape, np.uint8), outline, 1)
    assert not z[cv2.erode(hole, np.ones((3, 3), np.uint8)) > 0].any()
    outside = cv2.dilate(hole, np.ones((5, 5), np.uint8)) == 0
    np.testing.assert_array_equal(z[outside], whole[outside])


def test_points_that_colour_cannot_see_are_dropped():
    color, depth = camera(64, 48, 0.9), camera(64, 48, 0.9)
    measured = np.full((48, 64), 1.0, np.float32)
    for T in (
        rigid(np.eye(3), np.array([0, 0, -1.5])),  # behind the colour camera
        rigid(np.eye(3), np.array([0, 0, -1.0])),  # in its lens
        rigid(np.eye(3), np.array([50.0, 0, 0])),  # far beside the image
        rigid(np.diag([-1.0, 1, -1]), np.zeros(3)),  # looking back
    ):
        assert not DepthRegistration(RGBDCamera(color, depth, T))(measured).any()


# --- the simple cases are exact ---


def test_one_camera_for_both_changes_nothing():
    for distortion in ((), KINECT_1, K4A_COLOR):
        one = camera(160, 120, 0.9, distortion, (0.3, -0.4))
        sensor = RGBDCamera(one, one)
        u, v = pixels(one)[..., 0], pixels(one)[..., 1]
        measured = (2 + 0.01 * np.sin(u / 9) + 0.01 * np.cos(v / 7)).astype(np.float32)
        np.testing.assert_allclose(DepthRegistration(sensor)(measured), measured, rtol=1e-6)


def test_registered_depth_passes_through():
    color = camera(64, 48, 0.9)
    for factor in (1, 2, 0.5):
        depth_camera = color.scale(factor)
        measured = np.ones((depth_camera.height, depth_camera.width), np.float32)
        frame = Frame(
            np.zeros((48, 64, 3), np.uint8), measured, RGBDCamera(color, depth_camera, registered=True), 7, 1.5
        )
        out = register(frame)
        assert out.depth.z is measured and out.color is frame.color
        assert out.depth.camera is depth_camera and out.depth.scale_to(color) == factor
        assert (out.index, out.timestamp_s) == (7, 1.5)


def test_frames_do_not_share_memory():
    color, depth, t = SENSORS["alike"]
    sensor = RGBDCamera(color, depth, rigid(TURN, np.array(t)))
    image = np.zeros((color.height, color.width, 3), np.uint8)
    first = register(Frame(image, np.full((180, 240), 1.0, np.float32), sensor))
    before = first.depth.z.copy()
    second = register(Frame(image, np.full((180, 240), 2.0, np.float32), sensor))
    np.testing.assert_array_equal(first.depth.z, before)
    assert second.depth.z.max() > 1.8 and second.depth.camera is color
