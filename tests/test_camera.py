"""Laws of the camera model, with OpenCV's functions as the oracle for its formulas."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera, RGBDCamera, check_registered
from understudy.errors import CameraError
from understudy.geometry import rigid

K4A_COLOR = (0.33012131, -2.48939657, -0.00016178, -0.00012945, 1.45367086, 0.20891207, -2.30291510, 1.37512755)
K4A_DEPTH = (0.54793978, -0.02097137, 2.0557534e-5, -7.2104158e-5, -0.00265223, 0.88967907, 0.08613021, -0.01391038)
KINECT_1 = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)


pytestmark = pytest.mark.filterwarnings("ignore:Do not use the `random` module")  # the type checker samples with it


def near(centre, spread):
    return st.floats(centre - spread, centre + spread, allow_nan=False)


def around(coefficients, share):
    return st.tuples(*(near(c, abs(c) * share) for c in coefficients))


lenses = st.one_of(
    st.just(("none", ())),
    st.tuples(st.just("brown_conrady"), st.tuples(*(near(0, spread) for spread in (0.3, 0.2, 0.005, 0.005, 0.1)))),
    st.tuples(st.just("brown_conrady"), around(KINECT_1, 0.1)),
    st.tuples(st.just("rational"), around(K4A_COLOR, 0.01)),
    st.tuples(st.just("rational"), around(K4A_DEPTH, 0.05)),
)  # fmt: skip


@st.composite
def cameras(draw):
    width, height = draw(st.integers(64, 1920)), draw(st.integers(64, 1080))
    fx = draw(st.floats(0.6, 1.5)) * width
    fy = draw(st.floats(0.9, 1.1)) * fx
    cx, cy = (width - 1) / 2 * draw(st.floats(0.9, 1.1)), (height - 1) / 2 * draw(st.floats(0.9, 1.1))
    model, coefficients = draw(lenses)
    return Camera(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), model, coefficients)


def rays_within(camera, n=60, share=0.9, seed=0):
    """Normalized points of a disk within the lens model's range and about the image; shape (n, 2)."""
    rng = np.random.default_rng(seed)
    radius = min(share * camera.max_radius, 0.9) * np.sqrt(rng.random(n))
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


@settings(deadline=None)
@given(cameras(), st.floats(0.2, 10))
def test_projection_is_opencvs(camera, z):
    xy = rays_within(camera)
    points = np.column_stack([xy, np.ones(len(xy))]) * z
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-8 * camera.width, rtol=1e-9)


@settings(deadline=None)
@given(cameras(), st.floats(0.2, 10))
def test_unproject_inverts_project(camera, z):
    xy = rays_within(camera, share=0.7)
    points = np.column_stack([xy, np.ones(len(xy))]) * z
    back = camera.unproject(camera.project(points), points[:, 2])
    assert np.isfinite(back).all()
    np.testing.assert_allclose(back, points, atol=1e-6 * z)


@settings(deadline=None)
@given(cameras())
def test_project_inverts_unproject_wherever_a_pixel_has_a_ray(camera):
    u, v = np.meshgrid(np.linspace(-0.5, camera.width - 0.5, 13), np.linspace(-0.5, camera.height - 0.5, 9))
    uv = np.stack([u, v], axis=-1)
    points = camera.unproject(uv, 2.0)
    assert points.shape == (9, 13, 3)
    seen = np.isfinite(points).all(-1)
    np.testing.assert_allclose(camera.project(points[seen]), uv[seen], atol=1e-5)
    if not camera.distorted:
        assert seen.all()
    middle = camera.unproject(np.array([camera.cx, camera.cy]), 1.0)
    assert np.isfinite(middle).all()


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("brown_conrady", KINECT_1), ("brown_conrady", (-0.28, 0.07, 2e-4, 2e-5, 0.0)),
        ("rational", K4A_COLOR), ("rational", K4A_DEPTH),
    ],
)  # fmt: skip
def test_real_lenses_over_the_whole_image_as_opencv(model, coefficients):
    """Every pixel of a real camera has a ray, and it is OpenCV's to its own precision."""
    camera = Camera(640, 480, np.array([[520, 0, 320.5], [0, 521, 238], [0, 0, 1.0]]), model, coefficients)
    u, v = np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    expected = cv2.undistortPoints(uv[:, None], camera.K, np.array(coefficients), criteria=criteria)[:, 0]
    np.testing.assert_allclose(camera.normalized(uv), expected, atol=1e-7)
    np.testing.assert_allclose(camera.project(camera.unproject(uv, 3.0)), uv, atol=1e-7)


@settings(deadline=None)
@given(cameras())
def test_distortion_jacobian_is_the_slope(camera):
    xy = rays_within(camera, share=0.8)
    h = 1e-6
    numeric = np.stack(
        [(camera.distort(xy + h * e) - camera.distort(xy - h * e)) / (2 * h) for e in np.eye(2)], axis=-1
    )
    if camera.distorted:
        np.testing.assert_allclose(camera._distortion_jacobian(xy), numeric, atol=2e-7)
    else:
        np.testing.assert_allclose(numeric, np.broadcast_to(np.eye(2), numeric.shape), atol=1e-7)


def test_float32_stays_float32_and_close():
    camera = Camera(640, 480, np.array([[520, 0, 320], [0, 520, 240], [0, 0, 1.0]]), "rational", K4A_COLOR)
    xy = rays_within(camera)
    x, y = camera.distort_xy(*xy.T.astype(np.float32))
    assert x.dtype == y.dtype == np.float32
    np.testing.assert_allclose(np.column_stack([x, y]), camera.distort(xy), atol=1e-5)


# --- where there is no projection ---


def test_behind_or_in_the_lens_has_no_projection():
    for coefficients in ((), KINECT_1):
        model = "brown_conrady" if coefficients else "none"
        camera = Camera(640, 480, np.array([[520, 0, 320], [0, 520, 240], [0, 0, 1.0]]), model, coefficients)
        points = np.array([[0, 0, -1.0], [0.1, 0.1, 0.0], [0, 0, 0], [np.nan, 0, 1], [0, 0, 1]])
        uv = camera.project(points)
        assert np.isnan(uv[:3]).all() and np.isnan(uv[3]).any()
        np.testing.assert_allclose(uv[4], [320, 240])
        assert not camera.contains(camera.project(np.array([[1.0, 1.0, 1e-300]]))).any()  # and no warning


def test_beyond_the_fold_there_is_nothing():
    """k1 = -0.3: the radius grows until r = 1/sqrt(0.9) and comes back; unlimited, the far side would fold in."""
    K = np.array([[300, 0, 320], [0, 300, 240], [0, 0, 1.0]])
    camera = Camera(640, 480, K, "brown_conrady", (-0.3, 0, 0, 0, 0))
    fold = 1 / np.sqrt(0.9)
    assert camera.max_radius == pytest.approx(fold)
    inside, outside = np.array([fold * 0.999, 0, 1]), np.array([fold * 1.001, 0, 1])
    assert np.isfinite(camera.project(inside)).all() and np.isnan(camera.project(outside)).all()
    edge = 300 * fold * (1 - 0.3 * fold**2) + 320  # the farthest pixel that any ray meets
    assert np.isfinite(camera.normalized(np.array([edge - 0.5, 240.0]))).all()
    assert np.isnan(camera.normalized(np.array([edge + 0.5, 240.0]))).all()
    found = camera.normalized(np.array([[320.0 + 0.9 * (edge - 320), 240]]))
    assert np.linalg.norm(found) < fold  # the near branch


def test_a_pole_of_the_rational_model_ends_its_range():
    camera = Camera(64, 48, np.diag([50, 50, 1.0]), "rational", (0, 0, 0, 0, 0, -1.0, 0, 0))  # 1 / (1 - r^2)
    assert camera.max_radius == pytest.approx(1.0)
    assert np.isnan(camera.project(np.array([1.2, 0, 1]))).all()


@settings(deadline=None)
@given(cameras())
def test_the_radius_grows_up_to_its_limit(camera):
    limit = min(camera.max_radius, 3.0)
    r = np.linspace(0, limit * (1 - 1e-9), 500)
    k1, k2, _, _, k3, k4, k5, k6 = camera._k
    s = r * r
    distorted = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    assert (np.diff(distorted) > 0).all()


def test_contains():
    camera = Camera.from_fov(4, 3, 1.0)
    uv = np.array([[-0.5, -0.5], [3.49, 2.49], [3.5, 0], [0, 2.5], [-0.51, 0], [np.nan, 1]])
    np.testing.assert_array_equal(camera.contains(uv), [True, True, False, False, False, False])


# --- images of other sizes ---


@settings(deadline=None)
@given(cameras(), st.integers(20, 3000), st.integers(20, 3000))
def test_resize_keeps_the_place_in_the_image(camera, width, height):
    points = np.column_stack([rays_within(camera), np.full(60, 1.0)])
    small = camera.resize(width, height)
    ratio = np.array([width / camera.width, height / camera.height])
    np.testing.assert_allclose(small.project(points) + 0.5, (camera.project(points) + 0.5) * ratio, atol=1e-6)
    assert (small.width, small.height) == (width, height)


@given(cameras(), st.integers(-50, 50), st.integers(-50, 50))
def test_crop_shifts(camera, left, top):
    points = np.column_stack([rays_within(camera), np.full(60, 1.0)])
    part = camera.crop(left, top, 32, 24)
    np.testing.assert_allclose(part.project(points) + (left, top), camera.project(points), atol=1e-7)
    assert (part.width, part.height) == (32, 24)


def test_resize_agrees_with_a_resized_image():
    """A bright square's centre in the image, and in the image shrunk by OpenCV, is where the two cameras say."""
    camera = Camera.from_fov(320, 240, 1.2)
    image = np.zeros((240, 320), np.float32)
    image[100:112, 200:212] = 1
    point = camera.unproject(np.array([205.5, 105.5]), 2.0)
    for w, h in ((160, 120), (80, 60), (640, 480)):
        small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA if w < 320 else cv2.INTER_LINEAR)
        v, u = np.mgrid[:h, :w]
        centre = np.array([(u * small).sum(), (v * small).sum()]) / small.sum()
        np.testing.assert_allclose(camera.resize(w, h).project(point), centre, atol=0.02)


def test_scale_and_from_fov():
    camera = Camera.from_fov(640, 480, np.pi / 2)
    assert camera.fx == pytest.approx(320) and (camera.cx, camera.cy) == (319.5, 239.5)
    edge = camera.unproject(np.array([[-0.5, 239.5], [639.5, 239.5]]), 1.0)
    np.testing.assert_allclose(edge[:, 0], [-1, 1])
    half = camera.scale(0.5)
    assert (half.width, half.height, half.fx, half.cx) == (320, 240, pytest.approx(160), 159.5)


# --- errors, files ---

GOOD_K = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1.0]])


def changed(row, column, value):
    K = GOOD_K.copy()
    K[row, column] = value
    return K


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0, 480, GOOD_K), "width and height must be positive, got 0 x 480"),
        ((640, 480, changed(0, 0, 0)), "focal lengths must be positive, got fx = 0"),
        ((640, 480, changed(1, 1, -500)), "focal lengths must be positive"),
        ((640, 480, changed(0, 2, np.nan)), "numbers only"),
        ((640, 480, changed(0, 1, 2.0)), r"must be \[\[fx, 0, cx\]"),
        ((640, 480, changed(2, 2, 2.0)), r"must be \[\[fx, 0, cx\]"),
        ((640, 480, GOOD_K, "fisheye"), "'fisheye': must be one of 'none', 'brown_conrady', 'rational'"),
        ((640, 480, GOOD_K, "brown_conrady", (0.1,)), "brown_conrady needs 5 finite coefficients"),
        ((640, 480, GOOD_K, "rational", (0.1,) * 5), "rational needs 8 finite coefficients"),
        ((640, 480, GOOD_K, "none", (0.1,)), "none needs 0 finite coefficients"),
        ((640, 480, GOOD_K, "brown_conrady", (np.inf,) * 5), "5 finite coefficients"),
    ],
)
def test_impossible_cameras(arguments, words):
    with pytest.raises(CameraError, match=words):
        Camera(*arguments)


@given(cameras())
def test_json_round_trip(camera):
    again = Camera.from_json(camera.to_json(), "here")
    assert again.to_json() == camera.to_json()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (3, "here: must be an object"),
        ({"width": 4, "height": 3}, "here: field 'K' is missing"),
        ({"width": 4.0, "height": 3, "K": GOOD_K.tolist()}, "here: width must be a whole number"),
        ({"width": 4, "height": True, "K": GOOD_K.tolist()}, "here: height must be a whole number"),
        ({"width": 4, "height": 3, "K": [[1, "a"]]}, "here: "),
        ({"width": 4, "height": 3, "K": GOOD_K.tolist(), "distortion": "12345"}, "here: distortion must be a list"),
        ({"width": 4, "height": 3, "K": GOOD_K.tolist(), "distortion": [None]}, r"here: .*must hold numbers|here: "),
    ],
)
def test_json_errors_name_the_place(data, words):
    with pytest.raises(CameraError, match=words):
        Camera.from_json(data, "here")


def test_the_cameras_matrix_cannot_be_changed():
    K = GOOD_K.copy()
    camera = Camera(640, 480, K)
    with pytest.raises(ValueError, match="read-only"):
        camera.K[0, 0] = 1


def test_pairs_of_cameras():
    color = Camera(640, 480, GOOD_K)
    with pytest.raises(CameraError, match="T_color_depth must be a 4x4 rigid"):
        RGBDCamera(color, color, np.diag([1, 1, -1, 1.0]))
    with pytest.raises(CameraError, match=r"identity when depth\.registered is true"):
        RGBDCamera(color, color, rigid(np.eye(3), np.array([0.1, 0, 0])), registered=True)
    for depth in (color, color.scale(2), color.scale(0.25)):
        assert RGBDCamera(color, depth, registered=True).registered
    for depth in (color.crop(10, 0, 640, 480), color.resize(640, 240), Camera(640, 480, changed(0, 0, 520))):
        with pytest.raises(CameraError, match="K scaled uniformly"):
            check_registered(color, depth)


def test_arrays_of_the_caller_stay_the_callers():
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    T = np.eye(4)
    camera = Camera(640, 480, K)
    pair = RGBDCamera(camera, camera, T)
    K[0, 0], T[0, 3] = 1, 1
    assert camera.fx == 500 and pair.T_color_depth[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        camera.K[0, 0] = 3


@pytest.mark.parametrize("f", [1e-200, 1e200])
def test_absurd_focal_lengths(f):
    with pytest.raises(CameraError, match="must be in pixels"):
        Camera(640, 480, np.array([[f, 0, 320], [0, f, 240], [0, 0, 1]]))


def test_registered_depth_has_the_lens_of_colour():
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    color = Camera(640, 480, K, "brown_conrady", (0.1, 0, 0, 0, 0))
    unsaid = RGBDCamera(color, Camera(640, 480, K), registered=True)
    assert unsaid.depth.distortion == color.distortion
    zeros = Camera(640, 480, K, "brown_conrady", (0.0,) * 5)
    assert not RGBDCamera(Camera(640, 480, K), zeros, registered=True).depth.distorted
    with pytest.raises(CameraError, match="distortion must be color's"):
        RGBDCamera(color, Camera(640, 480, K, "brown_conrady", (-0.3, 0, 0, 0, 0)), registered=True)
