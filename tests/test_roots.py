"""The root of a person's grid, on drawn depth images: occluders, holes, half people, no depth at all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera
from understudy.roots import Root, find_roots
from understudy.skeleton import FACE, JOINTS, N_JOINTS, rows
from understudy.types import Keypoints2D, RegisteredDepth

CAMERA = Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))
_SIDE = {
    "shoulder": (0.17, -0.35), "elbow": (0.22, -0.05), "wrist": (0.24, 0.2), "hip": (0.11, 0.15), "knee": (0.11, 0.57),
    "ankle": (0.11, 0.97), "eye": (0.03, -0.62), "ear": (0.075, -0.6),
}  # fmt: skip


def standing(x: float, z: float) -> np.ndarray:
    """Joints of an adult who faces the camera, metres; the trunk's middle lies 0.1 m above the camera's axis."""
    out = np.zeros((N_JOINTS, 3))
    for i, name in enumerate(JOINTS):
        side, _, part = name.rpartition("_")
        right, y = _SIDE.get(part, (0.0, -0.58 if part == "nose" else -0.35))
        out[i] = x + (right if side == "left" else -right), y, z
    return out


def person(x: float = 0.0, z: float = 3.0, only: tuple[str, ...] = JOINTS, score: float = 0.9) -> Keypoints2D:
    kept = np.isin(JOINTS, only)
    uv = CAMERA.project(standing(x, z))
    return Keypoints2D.where(uv, np.where(kept, score, 0.0))


def image(*rectangles: tuple[float, float, float, float, float], wall: float = 5.0) -> RegisteredDepth:
    """A wall, and before it rectangles (x0, x1, y0, y1, z): metres at their depth; the last one is painted over."""
    z = np.full((540, 960), wall, np.float32)
    for x0, x1, y0, y1, depth in rectangles:
        corners = np.array([[x0, y0, depth or 3.0], [x1, y1, depth or 3.0]])
        (u0, v0), (u1, v1) = CAMERA.project(corners).round().astype(int).clip(0, 960)
        z[v0:v1, u0:u1] = depth
    return RegisteredDepth(z, CAMERA)


def body(x: float = 0.0, z: float = 3.0) -> tuple[float, float, float, float, float]:
    return (x - 0.3, x + 0.3, -0.7, 1.1, z)


def find(who: Keypoints2D, depth: RegisteredDepth) -> Root:
    """The likeliest place."""
    return find_roots(who, depth, CAMERA)[0]


def found_at(depth: RegisteredDepth, who: Keypoints2D, x: float = 0.0, z: float = 3.0, off: float = 0.2) -> None:
    root = find(who, depth)
    assert abs(root.point[2] - z) < off, root
    assert abs(root.point[0] - x) < 0.25 and abs(root.point[1] + 0.1) < 0.45, root


def test_in_the_open():
    found_at(image(body()), person(), off=0.15)
    alone = find_roots(person(), image(body()), CAMERA)
    assert [root.evidence for root in alone] == ["depth"]  # no other place is worth a look


def test_neck_behind_an_occluder():
    """The paper's root would be at 1.5 m."""
    found_at(image(body(), (-0.1, 0.1, -0.3, -0.05, 1.5)), person())


def test_shoulders_behind_an_occluder():
    found_at(image(body(), (-0.3, 0.3, -0.35, -0.08, 1.5)), person())


def test_trunk_behind_a_table_that_leaves_the_head_and_the_legs():
    """Everything measured on the trunk is the table's."""
    places = find_roots(person(), image(body(), (-0.5, 0.5, -0.25, 0.12, 1.4)), CAMERA)
    assert min(abs(root.point[2] - 3) for root in places) < 0.35  # among those that the network looks at


def test_no_depth_at_the_neck():
    hole = (-0.2, 0.2, -0.5, -0.2, 0.0)
    found_at(image(body(), hole), person(), off=0.15)


@pytest.mark.parametrize(
    "only",
    [
        ("right_hip", "left_hip"), ("right_shoulder",), ("left_shoulder",), ("neck",), tuple(JOINTS[i] for i in FACE),
        ("nose",), ("right_knee", "right_ankle"), ("left_wrist",), ("right_shoulder", "right_elbow"),
    ],
)  # fmt: skip
def test_parts_of_people(only):
    root = find(person(only=only), image(body()))
    assert abs(root.point[2] - 3) < 0.2 and abs(root.point[0]) < 0.4, root


def test_no_depth_at_all_leaves_the_apparent_size():
    nothing = RegisteredDepth(np.zeros((540, 960), np.float32), CAMERA)
    for z in (2.0, 3.0, 4.5):
        root = find(person(z=z), nothing)
        assert root.evidence == "size"
        assert abs(root.point[2] / z - 1) < 0.25
    head = find(person(only=tuple(JOINTS[i] for i in FACE)), nothing)
    assert head.evidence == "size" and abs(head.point[2] / 3 - 1) < 0.25


def test_only_the_wall_behind_is_measured():
    """A person of whom the sensor sees nothing (black clothes) does not stand in the wall."""
    root = find(person(z=2.0), image(wall=7.0))
    assert abs(root.point[2] - 2) < 0.5 and root.evidence == "size"


def test_two_people_at_different_depths():
    depth = image(body(-0.9, 4.0), body(0.4, 2.0))
    found_at(depth, person(-0.9, 4.0), x=-0.9, z=4.0)
    found_at(depth, person(0.4, 2.0), x=0.4, z=2.0)


def test_one_person_half_behind_another():
    depth = image(body(0.1, 3.5), (-0.3, 0.1, -0.7, 1.1, 2.0))
    places = find_roots(person(0.1, 3.5), depth, CAMERA)
    assert min(abs(root.point[2] - 3.5) for root in places) < 0.3


def test_low_scores_count_only_when_there_is_nothing_else():
    ghost = person(0.0, 3.0, ("left_hip",), 0.1)
    mixed = Keypoints2D.where(person().uv, np.where(rows_mask("left_hip"), 0.1, 0.9))
    assert find_roots(ghost, image(body()), CAMERA)
    found_at(image(body()), mixed)


def rows_mask(*names: str) -> np.ndarray:
    out = np.zeros(N_JOINTS, bool)
    out[rows(*names)] = True
    return out


@settings(max_examples=60, deadline=None)
@given(
    kept=st.sets(st.sampled_from(JOINTS), min_size=1),
    score=st.floats(0.01, 1),
    depth=st.sampled_from(["none", "wall", "body", "noise", "specks"]),
    seed=st.integers(0, 1000),
)
def test_nobody_is_dropped(kept, score, depth, seed):
    rng = np.random.default_rng(seed)
    z = {
        "none": np.zeros((540, 960)), "wall": np.full((540, 960), 4.0), "body": image(body()).z,
        "noise": rng.uniform(0.3, 8, (540, 960)), "specks": np.where(rng.random((540, 960)) < 1e-4, 2.0, 0.0),
    }[depth]  # fmt: skip
    who = person(only=tuple(kept), score=score)
    who = Keypoints2D.where(who.uv + rng.normal(0, 30, (N_JOINTS, 2)), who.score)
    places = find_roots(who, RegisteredDepth(z.astype(np.float32), CAMERA), CAMERA)
    assert 1 <= len(places) <= 3
    assert all(np.isfinite(root.point).all() and root.point[2] > 0.1 for root in places)


def test_nobody_there():
    empty = Keypoints2D.where(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS))
    assert find_roots(empty, image(), CAMERA) == []
