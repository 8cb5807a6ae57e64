import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera
from understudy.lifting import BALL_68, RADIUS, NaiveLifter, nearest_depths
from understudy.registration import register
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import MISSING, OBSERVED, Frame, Keypoints2D, RegisteredDepth, RegisteredFrame

COLOR = Camera(96, 54, np.array([[54.0, 0, 47.5], [0, 54.0, 26.5], [0, 0, 1.0]]))


def by_search(depth, color, uv, k, radius):
    """The definition, literally: all valid pixels, sorted by distance, then row, then column."""
    scale = depth.camera.width / color.width
    out = np.full((len(uv), k), np.nan)
    v, u = np.nonzero(depth.z > 0)
    for i, (x, y) in enumerate((uv + 0.5) * scale - 0.5):
        if not np.isfinite((x, y)).all():
            continue
        d2 = (u - x) ** 2 + (v - y) ** 2
        order = np.lexsort((u, v, d2))[:k]
        if len(order) == k and (d2[order] <= (radius * depth.camera.width) ** 2).all():
            out[i] = depth.z[v[order], u[order]]
    return out


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 1, 2, 3]), st.sampled_from([0.01, 0.1, 0.9]), st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_nearest_depths_are_the_nearest(seed, scale, filled, k):
    rng = np.random.default_rng(seed)
    camera = COLOR.scale(scale)
    z = rng.uniform(1, 5, (camera.height, camera.width)).astype(np.float32)
    z[rng.random(z.shape) > filled] = 0
    uv = rng.uniform(-4, (100, 58), (30, 2))
    uv[0] = np.nan
    depth = RegisteredDepth(z, camera)
    radius = 0.11
    np.testing.assert_allclose(nearest_depths(depth, COLOR, uv, k, radius), by_search(depth, COLOR, uv, k, radius))


def keypoints(uv, score=0.9):
    rows = np.zeros((N_JOINTS, 3))
    for name, (u, v) in uv.items():
        rows[JOINT[name]] = u, v, score
    return Keypoints2D.from_rows(rows)


def frame_of(z: np.ndarray, camera: Camera) -> RegisteredFrame:
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    return RegisteredFrame(color, camera, RegisteredDepth(z, camera))


def test_median_of_three_not_of_more():
    z = np.zeros((54, 96), np.float32)
    z[20, 30], z[20, 31], z[21, 30], z[25, 30] = 2.0, 3.0, 2.5, 9.0
    person = NaiveLifter().lift(frame_of(z, COLOR), [keypoints({"nose": (30.2, 20.1)})])
    # fewer than 3 within 2 % of the width (1.9 px)? All three are, the fourth is not
    np.testing.assert_allclose(person[0].keypoints[0], COLOR.unproject(np.array([30.2, 20.1]), 2.5))
    z[21, 30] = 0
    lifted = NaiveLifter().lift(frame_of(z, COLOR), [keypoints({"nose": (30.2, 20.1)})])[0]
    assert np.hypot(0.2, 4.9) > RADIUS * 96  # the third nearest is now too far
    assert lifted.failed is not None


def test_exact_on_a_plane(flat_frame: Frame):
    """Points of a wall, seen exactly: the lifted joints project back onto their keypoints and lie on the wall."""
    registered = register(flat_frame)
    rng = np.random.default_rng(1)
    rows = np.column_stack([rng.uniform(30, 500, (N_JOINTS, 2)), np.full(N_JOINTS, 0.8)])
    rows[JOINT["left_knee"]] = 0
    rows[JOINT["right_knee"], 2] = 0.1  # below min_score
    person = NaiveLifter(min_score=0.2).lift(registered, [Keypoints2D.from_rows(rows)])[0]
    missing = [JOINT["left_knee"], JOINT["right_knee"]]
    rest = np.setdiff1d(np.arange(N_JOINTS), missing)
    assert np.isnan(person.keypoints[missing]).all() and np.isnan(person.sigma_m[missing]).all()
    np.testing.assert_allclose(person.keypoints[rest, 2], 2.0)
    np.testing.assert_allclose(flat_frame.camera.color.project(person.keypoints[rest]), rows[rest, :2], atol=1e-9)
    assert [person.source[i] for i in missing] == [MISSING, MISSING]
    assert {person.source[i] for i in rest} == {OBSERVED}
    assert (person.confidence[missing] == 0).all() and (person.confidence[rest] > 0.3).all()
    assert (person.confidence <= 0.8).all()
    # hips lie deepest under the surface, so they are the least certain
    assert person.sigma_m[JOINT["left_hip"]] == pytest.approx(np.nanmax(person.sigma_m))


def test_people_without_depth_are_listed_as_failed():
    z = np.zeros((54, 96), np.float32)
    z[:, 60:] = 2.0
    seen = [keypoints({"nose": (20, 20), "neck": (20, 30)}), keypoints({"nose": (80, 20), "neck": (20, 30)})]
    people = NaiveLifter().lift(frame_of(z, COLOR), seen)
    assert [p.failed for p in people] == ["no depth near any of the 2D keypoints", None]
    assert people[0].keypoints_2d is seen[0]
    np.testing.assert_array_equal(np.isfinite(people[1].keypoints).all(1), np.arange(N_JOINTS) == 0)


def test_order_and_company_do_not_matter(flat_frame: Frame):
    registered = register(flat_frame)
    seen = [keypoints({"nose": (100 + 50 * i, 90), "neck": (100 + 50 * i, 140)}) for i in range(4)]
    together = NaiveLifter().lift(registered, seen)
    for k, person in zip(seen, together, strict=True):
        np.testing.assert_array_equal(NaiveLifter().lift(registered, [k])[0].keypoints, person.keypoints)
    assert NaiveLifter().lift(registered, []) == []


def test_a_joint_on_something_else_is_inferred(flat_frame: Frame):
    """A knee measured on a table 0.9 m before the torso: the paper's position, but nobody is told to trust it."""
    z = flat_frame.depth + np.float32(1.0)  # 3 m
    z[380:, :] = 2.1
    registered = RegisteredFrame(flat_frame.color, flat_frame.camera.color, RegisteredDepth(z, flat_frame.camera.color))
    seen = keypoints(
        {
            "neck": (480, 150), "right_shoulder": (445, 150), "left_shoulder": (515, 150),
            "right_hip": (455, 260), "left_hip": (505, 260), "left_knee": (505, 340), "right_knee": (455, 400),
        }
    )  # fmt: skip
    person = NaiveLifter().lift(registered, [seen])[0]
    knee, other = JOINT["right_knee"], JOINT["left_knee"]
    assert person.keypoints[knee, 2] == pytest.approx(2.1)
    assert (person.source[knee], person.source[other]) == ("inferred", OBSERVED)
    assert person.sigma_m[knee] > 0.8 * BALL_68 and person.confidence[knee] < 0.02
    assert person.sigma_m[other] < 0.1 * BALL_68 and person.confidence[other] > 0.6


def test_shoulders_that_are_too_narrow_are_not_trusted(flat_frame: Frame):
    """0.12 m apart, as of somebody in profile whose far shoulder is lifted to the near side; then 0.36 m."""
    registered = register(flat_frame)
    confidence, sigma = [], []
    for half in (0.06, 0.18):
        pixels = half * 540.7 / 2
        seen = keypoints({"right_shoulder": (480 - pixels, 200), "left_shoulder": (480 + pixels, 200)})
        person = NaiveLifter().lift(registered, [seen])[0]
        rows_ = [JOINT["right_shoulder"], JOINT["left_shoulder"]]
        confidence.append(person.confidence[rows_].max())
        sigma.append(person.sigma_m[rows_].min() / BALL_68)
    assert confidence[0] < 0.5 < confidence[1]
    assert sigma[0] > 0.1 > sigma[1]


def test_keypoints_of_low_score_are_inferred(flat_frame: Frame):
    registered = register(flat_frame)
    rows_ = np.column_stack([np.linspace(300, 600, N_JOINTS), np.full((N_JOINTS, 1), 200), np.full((N_JOINTS, 1), 0.9)])
    sure = NaiveLifter().lift(registered, [Keypoints2D.from_rows(rows_)])[0]
    rows_[JOINT["left_wrist"], 2] = 0.25
    weak = NaiveLifter().lift(registered, [Keypoints2D.from_rows(rows_)])[0]
    wrist = JOINT["left_wrist"]
    assert (sure.source[wrist], weak.source[wrist]) == (OBSERVED, "inferred")
    assert weak.sigma_m[wrist] / BALL_68 > 0.14 > sure.sigma_m[wrist] / BALL_68
    assert weak.confidence[wrist] < 0.3 * sure.confidence[wrist]
    np.testing.assert_array_equal(weak.keypoints, sure.keypoints)  # positions are the paper's
