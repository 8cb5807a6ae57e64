"""Pictures: joints land where the camera projects them, in the colours and marks that the legend promises."""

import numpy as np
import pytest

from understudy.camera import Camera
from understudy.drawing import OUTLINE, WHITE, Canvas
from understudy.overlay import (
    NO_DEPTH,
    PALETTE,
    describe,
    draw_depth,
    draw_frame,
    draw_people,
    left_color,
    person_color,
    torso_distance,
)
from understudy.skeleton import JOINT, N_JOINTS, TORSO
from understudy.types import (
    INFERRED,
    MISSING,
    OBSERVED,
    Keypoints2D,
    Palm,
    Person,
    RegisteredDepth,
    RegisteredFrame,
)

CAMERA = Camera.from_fov(640, 480, np.deg2rad(60))
LENS = Camera(640, 480, CAMERA.K, "brown_conrady", (-0.2, 0.05, 0.001, -0.001, 0.0))

# A person who stands straight and faces the camera: x right, y down, metres from the neck.
STANDING = np.array([
    [0, -0.2, 0], [0, 0, 0],
    [-0.2, 0, 0], [-0.3, 0.3, 0], [-0.35, 0.55, 0], [0.2, 0, 0], [0.3, 0.3, 0], [0.35, 0.55, 0],
    [-0.12, 0.55, 0], [-0.12, 0.95, 0], [-0.12, 1.35, 0], [0.12, 0.55, 0], [0.12, 0.95, 0], [0.12, 1.35, 0],
    [-0.04, -0.25, 0], [0.04, -0.25, 0], [-0.09, -0.22, 0.08], [0.09, -0.22, 0.08],
])  # fmt: skip


def standing(at=(0.0, -0.5, 3.0), id=0, camera=CAMERA, source=None, **changes) -> Person:
    """A person whose 2D detections agree with the 3D joints."""
    joints = STANDING + at
    source = source or (OBSERVED,) * N_JOINTS
    missing = np.array([s == MISSING for s in source])
    uv = camera.project(joints)
    return Person(
        changes.pop("keypoints_2d", Keypoints2D.where(uv, np.full(N_JOINTS, 0.9))),
        np.where(missing[:, None], np.nan, joints),
        np.where(missing, 0.0, 0.9),
        np.where(missing, np.nan, 0.02),
        source,
        id,
        **changes,
    )


def gray(camera=CAMERA, level=128) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), level, np.uint8)


def pixel(image, uv) -> tuple[int, ...]:
    u, v = np.rint(uv).astype(int)
    return tuple(int(c) for c in image[v, u])


def changed(image, background) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of the pixels that differ."""
    v, u = np.nonzero((image != background).any(axis=2))
    return u, v


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["ideal", "lens"])
def test_observed_joints_are_discs_at_their_projections(camera):
    person = standing(camera=camera, id=3)
    image = draw_people(gray(camera), [person], camera)
    for name in ("neck", "right_wrist", "right_knee", "left_elbow", "left_ankle"):
        expected = person_color(3) if not name.startswith("left") else left_color(person_color(3))
        assert pixel(image, camera.project(person.keypoints)[JOINT[name]]) == expected, name


def test_bones_join_the_joints_and_the_left_side_is_darker():
    person = standing()
    image, uv = draw_people(gray(), [person], CAMERA), CAMERA.project(person.keypoints)
    for side, expected in (("right", PALETTE[0]), ("left", left_color(PALETTE[0]))):
        shin = (uv[JOINT[f"{side}_knee"]] + uv[JOINT[f"{side}_ankle"]]) / 2
        assert pixel(image, shin) == expected
    assert sum(left_color(PALETTE[0])) < 0.6 * sum(PALETTE[0])


def test_inferred_joints_are_rings():
    source = tuple(INFERRED if i == JOINT["right_knee"] else OBSERVED for i in range(N_JOINTS))
    person = standing(source=source)
    image, uv = draw_people(gray(), [person], CAMERA), CAMERA.project(person.keypoints)
    assert pixel(image, uv[JOINT["right_knee"]]) == OUTLINE  # hollow
    assert pixel(image, uv[JOINT["right_ankle"]]) == PALETTE[0]


def test_what_is_only_in_2d_is_a_cross_there_and_joins_nothing_it_should_not():
    source = tuple(MISSING if i == JOINT["right_wrist"] else OBSERVED for i in range(N_JOINTS))
    uv = CAMERA.project(STANDING + (0.0, -0.5, 3.0))
    uv[JOINT["right_wrist"]] = 100, 100
    person = standing(source=source, keypoints_2d=Keypoints2D.where(uv, np.full(N_JOINTS, 0.9)))
    image = draw_people(gray(), [person], CAMERA)
    assert pixel(image, (100, 100)) == PALETTE[0]
    nowhere = standing(source=source, keypoints_2d=Keypoints2D.where(uv, 0.9 * (np.arange(N_JOINTS) != 4)))
    image = draw_people(gray(), [nowhere], CAMERA)
    assert pixel(image, (100, 100)) == (128, 128, 128)


def test_detections_that_disagree_with_the_3d_show_as_dots():
    uv = CAMERA.project(STANDING + (0.0, -0.5, 3.0))
    uv[JOINT["right_ankle"]] += 0, 30
    person = standing(keypoints_2d=Keypoints2D.where(uv, np.full(N_JOINTS, 0.9)))
    image = draw_people(gray(), [person], CAMERA)
    assert min(pixel(image, uv[JOINT["right_ankle"]])) > 200
    assert pixel(image, CAMERA.project(person.keypoints)[JOINT["right_ankle"]]) == PALETTE[0]


def test_doubtful_limbs_are_thinner_and_fainter():
    uv, score = CAMERA.project(STANDING + (0.0, -0.5, 3.0)), np.full(N_JOINTS, 0.9)
    score[JOINT["right_ankle"]] = 0.3
    sure, unsure = standing(), standing(keypoints_2d=Keypoints2D.where(uv, score))
    shin = np.rint((uv[JOINT["right_knee"]] + uv[JOINT["right_ankle"]]) / 2).astype(int)
    row = [draw_people(gray(), [p], CAMERA, legend=False)[shin[1], shin[0] - 12 : shin[0] + 13] for p in (sure, unsure)]
    touched = [(r != 128).any(axis=1).sum() for r in row]
    contrast = [np.abs(r.astype(int) - 128).max() for r in row]
    assert 0 < touched[1] < touched[0] and contrast[1] < contrast[0]


def test_a_near_person_covers_a_far_one():
    far, near = standing((0.0, -0.5, 4.0), id=0), standing((0.0, -0.375, 3.0), id=1)  # hips on the same pixel row
    for people in ([far, near], [near, far]):
        image = draw_people(gray(), people, CAMERA)
        assert pixel(image, CAMERA.project(near.keypoints)[JOINT["neck"]]) == PALETTE[1]


def test_palm_normals_are_arrows_from_the_wrist():
    palm = Palm(np.array([-1.0, 0.0, 0.0]), 0.8)
    person = standing(hands={"left": None, "right": palm})
    image = draw_people(gray(), [person], CAMERA)
    wrist = person.keypoints[JOINT["right_wrist"]]
    assert pixel(image, CAMERA.project(wrist - (0.06, 0, 0))) == WHITE
    assert pixel(image, CAMERA.project(wrist - (0.30, 0, 0))) == (128, 128, 128)


def test_nobody_changes_nothing_and_the_input_is_never_modified():
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    before = image.copy()
    assert (draw_people(image, [], CAMERA) == image).all()
    drawn = draw_people(image, [standing()], CAMERA)
    assert (image == before).all() and (drawn != image).any()
    image.setflags(write=False)
    draw_people(image, [standing()], CAMERA)
    draw_people(image[:, ::-1], [standing()], CAMERA)  # not contiguous


def test_failed_people_are_drawn_by_their_detections_with_the_reason():
    found = standing().keypoints_2d
    person = Person.failure(found, "no depth in the torso").with_id(2)
    assert describe(person) == "#2 failed: no depth in the torso"
    image = draw_people(gray(), [person], CAMERA, legend=False)
    assert pixel(image, found.uv[JOINT["neck"]]) == PALETTE[2]
    _, v = changed(image, gray())
    assert v.min() < found.uv[:, 1].min() - 10  # the label
    blind = Person.failure(Keypoints2D.from_rows(np.zeros((N_JOINTS, 3))), "nothing at all")
    assert (draw_people(gray(), [blind], CAMERA, legend=False) == 128).all()


def test_labels_say_id_and_torso_distance():
    person = standing((1.0, -0.5, 3.0), id=2)
    distance = np.linalg.norm((STANDING + (1.0, -0.5, 3.0))[TORSO].mean(axis=0))
    assert torso_distance(person) == pytest.approx(distance)
    assert describe(person) == f"#2 {distance:.2f} m"


@pytest.mark.parametrize("above", [(0, 0), (639, 0), (320, -500), (-900, 470), (5000, 5000)])
def test_labels_stay_inside_the_image(above):
    image = gray()
    box = Canvas(image).label("#12 10.25 m", above, PALETTE[0])
    assert box is not None
    left, top, right, bottom = box
    assert left >= 0 and top >= 0 and right <= 640 and bottom <= 480
    u, v = changed(image, gray())
    assert u.min() >= left and u.max() < right and v.min() >= top and v.max() < bottom
    assert (image[top:bottom, left:right] == WHITE).all(axis=2).any()


def test_labels_keep_off_each_other_and_shrink_to_the_image():
    canvas, boxes = Canvas(gray()), []
    for i in range(4):
        box = canvas.label(f"#{i} 3.00 m", (320, 200), PALETTE[i], boxes)
        assert box is not None
        assert all(box[3] <= b[1] or box[1] >= b[3] or box[2] <= b[0] or box[0] >= b[2] for b in boxes)
        boxes.append(box)
    long = canvas.label("#4 failed: " + "x" * 80, (320, 100), PALETTE[4])
    assert long is not None and long[0] >= 0 and long[2] <= 640 and long[2] - long[0] > 500
    longer = canvas.label("#4 failed: " + "x" * 800, (320, 100), PALETTE[4])
    assert longer is not None and longer[0] >= 0 and longer[2] <= 640


@pytest.mark.parametrize("width, height", [(32, 32), (1, 1), (64, 48), (3840, 2160)])
def test_any_size(width, height):
    camera = Camera.from_fov(width, height, np.deg2rad(60))
    people = [standing((0.3, -0.5, 3.0), camera=camera), Person.failure(standing(camera=camera).keypoints_2d, "why")]
    image = draw_people(gray(camera), people, camera)
    assert image.shape == (height, width, 3) and (image != 128).any()


def test_people_behind_and_beside_the_camera_do_no_harm():
    behind, beside = standing((0.0, 0.0, -2.0)), standing((5e4, 0.0, 0.01))
    half = standing((0.0, 0.0, 0.0))  # around the camera itself: z is 0 for most joints
    for person in (behind, beside, half):
        assert draw_people(gray(), [person], CAMERA).shape == (480, 640, 3)
    wild = standing(keypoints_2d=Keypoints2D.where(np.full((N_JOINTS, 2), -1e12), np.full(N_JOINTS, 0.9)))
    assert draw_people(gray(), [wild], CAMERA).shape == (480, 640, 3)


# --- depth ---


def test_depth_colours_run_from_near_to_far_and_holes_are_grey():
    depth = np.tile(np.linspace(1, 4, 200, dtype=np.float32), (100, 1))
    depth[:, 50] = 0
    image = draw_depth(depth, near_m=1.0, far_m=4.0)
    brightness = image[10].astype(float).sum(axis=1)
    known = np.delete(brightness, 50)
    assert pixel(image, (50, 10)) == NO_DEPTH
    assert known[0] > 1.8 * known[-1] and (np.diff(known[::10]) < 0).all()


def test_sparse_depth_is_drawn_with_larger_dots_that_cover_no_measurement():
    depth = np.zeros((120, 120), np.float32)
    depth[::4, ::4] = 2.0
    depth[60:, ::4] *= 2
    image = draw_depth(depth, near_m=1.0, far_m=5.0)
    assert (image != NO_DEPTH).any(axis=2)[5:110, 5:110].mean() > 0.9
    dense = np.repeat(np.float32([2.0, 4.0]), 60)[:, None] * np.ones((1, 120), np.float32)
    full = draw_depth(dense, near_m=1.0, far_m=5.0)
    assert (image[depth > 0] == full[depth > 0]).all()


def test_depth_of_nothing_and_of_one_distance():
    assert (draw_depth(np.zeros((4, 5), np.float32)) == NO_DEPTH).all()
    assert draw_depth(np.full((4, 5), 2.0, np.float32)).shape == (4, 5, 3)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_colour_and_depth_side_by_side(scale):
    depth_camera = CAMERA.scale(scale)
    depth = RegisteredDepth(np.full((depth_camera.height, depth_camera.width), 3.0, np.float32), depth_camera)
    person = standing()
    image = draw_frame(RegisteredFrame(gray(), CAMERA, depth), [person])
    assert image.shape == (480, 1280, 3)
    uv = CAMERA.project(person.keypoints)[JOINT["right_knee"]]
    assert pixel(image, uv) == pixel(image, uv + (640, 0)) == PALETTE[0]
