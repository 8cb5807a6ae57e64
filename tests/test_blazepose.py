"""The default detector: its geometry and decoding exactly, then people in real and rendered images."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy import recordings
from understudy.detectors import Detector, create
from understudy.detectors.blazepose import Candidate, Sighting, distinct, merge_duplicates
from understudy.detectors.blazepose_nets import _ANCHORS, _MIRROR, Region, _refine, weighted_suppression
from understudy.registration import register
from understudy.skeleton import JOINT, N_JOINTS, rows
from understudy.types import Keypoints2D

points = st.tuples(st.floats(0, 900), st.floats(0, 500)).map(np.array)


@given(points, points)
def test_region_puts_its_points_where_they_belong(center, rim):
    """The centre in the middle of the crop, the rim point straight above it at 1 / 2.5 of the side."""
    if np.linalg.norm(rim - center) < 1:
        return
    A = Region.from_points(center, rim).to_image(200)
    to_crop = np.linalg.inv(np.vstack([A, (0, 0, 1)]))
    np.testing.assert_allclose(to_crop @ (*center, 1), (99.5, 99.5, 1), atol=1e-6)
    np.testing.assert_allclose(to_crop @ (*rim, 1), (99.5, 99.5 - 200 / 2.5, 1), atol=1e-6)


@given(st.floats(-3, 3), st.floats(60, 200), points)
@settings(max_examples=25)
def test_crop_shows_what_the_map_says(angle, size, center):
    v, u = np.mgrid[:540, :960].astype(np.float32)
    region = Region((float(center[0]), float(center[1])), size, angle)
    crop = region.crop(np.dstack([u, v, np.ones_like(u)]), 64, fill=-1)
    A = region.to_image(64)
    y, x = np.mgrid[:64, :64]
    expected = np.stack([x, y, np.ones_like(x)], -1).astype(float) @ A.T
    inside = crop[..., 2] == 1
    np.testing.assert_allclose(crop[inside][:, :2], expected[inside], atol=0.1)  # OpenCV interpolates in 1/32 pixels


def test_anchors_and_mirror():
    assert _ANCHORS.shape == (2254, 2)
    np.testing.assert_allclose(_ANCHORS[:3], [[0.5 / 28] * 2, [0.5 / 28] * 2, [1.5 / 28, 0.5 / 28]])
    np.testing.assert_allclose(_ANCHORS[-1], [6.5 / 7] * 2)
    mirror = np.array(_MIRROR)
    assert sorted(_MIRROR) == list(range(33)) and (mirror[mirror] == np.arange(33)).all()
    assert [_MIRROR[i] for i in (0, 2, 7, 9, 11, 23, 31)] == [0, 5, 8, 10, 12, 24, 32]


def test_suppression_merges_by_score():
    corners = np.array([[0, 0, 1, 1], [0.1, 0, 1.1, 1], [5, 5, 6, 6.0]])
    keypoints = np.zeros((3, 4, 2))
    keypoints[0], keypoints[1], keypoints[2] = 10, 20, 50
    out = weighted_suppression(np.array([0.6, 0.9, 0.8]), corners, keypoints)
    np.testing.assert_allclose(out[:, 0], [0.9, 0.8])
    np.testing.assert_allclose(out[0, 1:], (0.6 * 10 + 0.9 * 20) / 1.5)
    np.testing.assert_allclose(out[1, 1:], 50)
    assert weighted_suppression(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4, 2))).shape == (0, 9)


def test_refinement_finds_the_blob():
    heatmaps = np.full((64, 64, 39), -20.0, np.float32)
    heatmaps[29:32, 41:44, 0] = 6  # rows 29..31, columns 41..43
    xy = np.full((39, 2), 0.5)
    xy[0] = (40.5 / 64, 31.2 / 64)
    refined = _refine(xy, heatmaps)
    np.testing.assert_allclose(refined[0] * 64, (42, 30), atol=1e-3)
    np.testing.assert_array_equal(refined[1:], xy[1:])  # no confident blob: as it was
    edge = np.full((39, 2), 1.3)
    np.testing.assert_array_equal(_refine(edge, heatmaps), edge)


def candidate(x: float, group: int, score: float = 0.9) -> Candidate:
    return Candidate(score, Region((x, 100.0), 200, 0.0), np.array([x, 100.0]), 60.0, group)


def test_candidates_of_one_person_are_merged_and_of_two_kept():
    kept = distinct([candidate(100, 0, 0.7), candidate(110, 0, 0.9), candidate(160, 0, 0.8), candidate(118, 1, 0.6)])
    assert [(c.hip[0], c.group) for c in kept] == [(110, 0), (160, 0), (118, 1)]
    assert len(distinct([candidate(100, -1), candidate(120, 0)])) == 1


def person(x: float, score: float = 0.9) -> Sighting:
    uv = np.column_stack([np.full(N_JOINTS, x), np.linspace(100, 300, N_JOINTS)])
    uv[rows("right_shoulder", "left_shoulder"), 1] = 130
    uv[rows("right_hip", "left_hip"), 1] = 190
    return Sighting(Keypoints2D.where(uv, np.full(N_JOINTS, score)), 60.0)


def test_duplicates_go_and_neighbours_stay():
    people = merge_duplicates([person(100, 0.7), person(105, 0.9), person(130, 0.8), person(300, 0.5)])
    assert [(p.uv[0, 0], p.score[0]) for p in people] == [(105, 0.9), (130, 0.8)]


def test_somebody_in_a_leg_goes_unless_depth_tells_them_apart():
    """A small figure whose joints all lie on the lower leg of a large one."""
    large = person(100)
    u, v = np.full(N_JOINTS, 102.0), np.linspace(200, 290, N_JOINTS)
    keypoints = Keypoints2D.where(np.column_stack([u, v]), np.full(N_JOINTS, 0.7))
    assert len(merge_duplicates([large, Sighting(keypoints, 20.0)])) == 1
    both = [Sighting(large.keypoints, 60.0, group=0), Sighting(keypoints, 20.0, group=1)]
    assert len(merge_duplicates(both)) == 2


# --- with the networks ---


@pytest.fixture(scope="module")
def detector(models: None) -> Detector:
    return create("blazepose")


def check_people(found: list[Keypoints2D], width: int, height: int) -> None:
    """What holds for the people of any detector."""
    for p in found:
        assert p.uv.shape == (18, 2) and np.isfinite(p.uv).all()
        assert (p.score >= 0).all() and (p.score <= 1).all() and p.found.sum() >= 4
        assert (p.uv[~p.found] == 0).all()
        inside = (p.uv >= -0.5).all(1) & (p.uv < (width - 0.5, height - 0.5)).all(1)
        assert inside[p.found].all()
        neck, shoulders = JOINT["neck"], rows("right_shoulder", "left_shoulder")
        if p.found[shoulders].all():
            np.testing.assert_allclose(p.uv[neck], p.uv[shoulders].mean(0))


def test_nobody_in_an_empty_image(detector: Detector):
    rng = np.random.default_rng(0)
    assert detector.detect(np.zeros((540, 960, 3), np.uint8)) == []
    assert detector.detect(rng.integers(0, 255, (120, 90, 3)).astype(np.uint8)) == []


@pytest.mark.parametrize("with_depth", [True, False])
def test_four_real_people(detector: Detector, freiburg, with_depth: bool):
    """Positions read off the image by eye (nose or face side, hips), left to right."""
    frame = register(recordings.open(freiburg)[0])
    found = detector.detect(frame.color, frame.depth if with_depth else None)
    check_people(found, 960, 540)
    found.sort(key=lambda p: p.uv[JOINT["neck"], 0])
    assert len(found) == 4
    noses = [p.uv[JOINT["nose"]] for p in found]
    for nose, by_eye in zip(noses, [(339, 176), (470, 185), (513, 205), (638, 165)], strict=True):
        assert np.linalg.norm(nose - by_eye) < (12 if with_depth else 25)
    hips = [p.uv[rows("right_hip", "left_hip")].mean(0) for p in found]
    for hip, by_eye in zip(hips, [(318, 285), (455, 290), (512, 285), (662, 298)], strict=True):
        assert np.linalg.norm(hip - by_eye) < (14 if with_depth else 30)
    if with_depth:
        assert found[0].torso_z == pytest.approx(3.68, abs=0.15)
        assert found[2].torso_z == pytest.approx(4.29, abs=0.15)


def test_hidden_arm_of_the_overlapped_man_is_not_trusted(detector: Detector, freiburg):
    """The third man's right forearm is behind the second man."""
    frame = register(recordings.open(freiburg)[0])
    third = sorted(detector.detect(frame.color, frame.depth), key=lambda p: p.uv[JOINT["neck"], 0])[2]
    assert (third.score[rows("right_elbow", "right_wrist")] < 0.3).all()
    assert (third.score[rows("left_elbow", "left_wrist", "left_knee", "right_knee")] > 0.6).all()


def test_people_at_other_scales_and_sides(detector: Detector, freiburg):
    """A mirrored image has mirrored people with left and right exchanged."""
    frame = register(recordings.open(freiburg)[0])
    plain = detector.detect(frame.color, frame.depth)
    flipped = detector.detect(
        np.ascontiguousarray(frame.color[:, ::-1]),
        type(frame.depth)(np.ascontiguousarray(frame.depth.z[:, ::-1]), frame.depth.camera),
    )
    assert len(flipped) == len(plain) == 4
    plain.sort(key=lambda p: p.uv[1, 0])
    flipped.sort(key=lambda p: -p.uv[1, 0])
    a, b = rows("right_hip", "left_hip", "right_ankle"), rows("left_hip", "right_hip", "left_ankle")
    for p, q in zip(plain, flipped, strict=True):
        np.testing.assert_allclose(p.uv[a], (959, 0) + q.uv[b] * (-1, 1), atol=12)
