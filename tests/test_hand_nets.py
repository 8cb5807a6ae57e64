"""The colour path of palm normals: geometry and combination exactly, then the networks on rendered hands."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from understudy import assets, recordings
from understudy.camera import Camera
from understudy.detectors.blazepose_nets import Region
from understudy.geometry import angle_between
from understudy.hands.color_path import (
    ColorPath,
    body_scale,
    hand_place,
    hand_shape,
    jittered,
    palm_normal,
)
from understudy.hands.nets import (
    _ANCHORS,
    HAND_SIZE,
    INDEX,
    MIDDLE,
    PALM_SIZE,
    PALM_WRIST,
    PINKY,
    WRIST,
    HandLandmarks,
    HandNets,
    palm_region,
)
from understudy.registration import register
from understudy.skeleton import FLIP, JOINT, N_JOINTS
from understudy.types import OBSERVED, Keypoints2D, Person, RegisteredDepth, RegisteredFrame
from understudy.voxels import rotation_to

CAMERA = Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))


def person(joints: dict[str, tuple[float, float, float]] | np.ndarray, uv: np.ndarray | None = None) -> Person:
    """Somebody with these 3D joints (metres), and these 2D ones (default: none)."""
    if isinstance(joints, dict):
        keypoints = np.full((N_JOINTS, 3), np.nan)
        for name, position in joints.items():
            keypoints[JOINT[name]] = position
    else:
        keypoints = joints
    nothing = np.zeros((N_JOINTS, 2))
    keypoints_2d = Keypoints2D.where(nothing if uv is None else uv, np.full(N_JOINTS, 0.0 if uv is None else 0.9))
    return Person(keypoints_2d, keypoints, np.ones(N_JOINTS), np.full(N_JOINTS, 0.03), (OBSERVED,) * N_JOINTS)


def right_hand() -> np.ndarray:
    """Joints (21, 3) of a right hand, palm to the camera, fingers up, metres from the wrist."""
    joints = np.zeros((21, 3))
    for finger, (x, y) in enumerate([(0.05, -0.05), (0.03, -0.09), (0.01, -0.095), (-0.01, -0.09), (-0.03, -0.08)]):
        for i in range(4):
            joints[1 + 4 * finger + i] = np.array([x, y, 0]) * (1 + 0.3 * i)
    return joints


def frame_of(color: np.ndarray, camera: Camera = CAMERA) -> RegisteredFrame:
    depth = RegisteredDepth(np.zeros((camera.height, camera.width), np.float32), camera)
    return RegisteredFrame(color, camera, depth)


# --- where a hand is ---

coordinates = st.floats(-0.5, 0.5)


@given(coordinates, coordinates, st.floats(1, 4), st.floats(-3.1, 3.1), st.floats(-1.1, 1.1))
def test_forearm_comes_from_below(x, y, z, turn, tilt):
    """Wrist and elbow lie on the vertical middle line of the window, the elbow lowest; the size is metric."""
    wrist = np.array([x, y, z])
    elbow = wrist + 0.25 * np.array([np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt), np.sin(tilt)])
    place = hand_place(CAMERA, person({"right_wrist": tuple(wrist), "right_elbow": tuple(elbow)}), "right")
    uv = CAMERA.project(np.stack([wrist, elbow]))
    if not CAMERA.contains(uv)[0]:
        assert place is None
        return
    apparent = np.linalg.norm(uv[1] - uv[0]) / (0.25 * CAMERA.fx / z)
    if apparent < 0.35:
        return
    to_crop = np.linalg.inv(np.vstack([place.window.to_image(200), (0, 0, 1)]))
    in_crop = np.column_stack([uv, np.ones(2)]) @ to_crop.T
    np.testing.assert_allclose(in_crop[:, 0], 99.5, atol=1e-6)
    assert 99.5 < in_crop[0, 1] < in_crop[1, 1]
    assert place.window.size == pytest.approx(0.43 * CAMERA.fx / z)
    np.testing.assert_allclose(place.wrist, uv[0])


def test_forearm_along_the_view_gives_an_upright_window():
    place = hand_place(CAMERA, person({"left_wrist": (0, 0, 2), "left_elbow": (0.01, 0.0, 2.25)}), "left")
    assert place.window.angle == 0
    np.testing.assert_allclose(place.window.center, (479.5, 269.5), atol=2)
    alone = hand_place(CAMERA, person({"left_wrist": (0, 0, 2)}), "left")
    assert alone.window.angle == 0 and alone.window.center == (479.5, 269.5)


def test_absent_wrists():
    nobody = person({"right_elbow": (0, 0, 2)})
    assert hand_place(CAMERA, nobody, "right") is None
    assert hand_place(CAMERA, person({"right_wrist": (3, 0, 2)}), "right") is None
    assert hand_place(CAMERA, person({"right_wrist": (0, 0, -2)}), "right") is None


def test_without_3d_the_2d_keypoints_serve():
    """Distance from the size of the body: half of it off is too much."""
    recording = recordings.open("sample")
    truth = recording.truth.frames[0][0].keypoints
    whole = hand_place(CAMERA, person(truth), "right")
    flat = hand_place(CAMERA, person(np.full((N_JOINTS, 3), np.nan), CAMERA.project(truth)), "right")
    np.testing.assert_allclose(flat.wrist, whole.wrist, atol=1e-6)
    assert 0.6 < flat.window.size / whole.window.size < 1.6
    turn = np.angle(np.exp(1j * (flat.window.angle - whole.window.angle)))
    assert abs(turn) < 1e-6


def test_body_scale():
    truth = recordings.open("sample").truth.frames[0][0].keypoints
    assert body_scale(person(truth)) == pytest.approx(1.0, abs=0.12)
    assert body_scale(person(0.8 * truth)) == pytest.approx(0.8 * body_scale(person(truth)), abs=0.01)
    assert body_scale(person({})) == 1


def test_jitter_is_the_same_each_time_and_small():
    region = Region((100.0, 50.0), 40.0, 0.3)
    regions = jittered(region, 8)
    assert regions == jittered(region, 8) and regions[:4] == jittered(region, 4)
    assert regions[0] == region and len(set(regions)) == 8
    for r in regions:
        assert np.abs(np.subtract(r.center, region.center)).max() <= 0.04 * 40 * np.sqrt(2)
        assert abs(np.log(r.size / 40)) <= 0.12 and abs(r.angle - 0.3) <= 0.26


def test_palm_region():
    """Fingers upwards, the box around the palm in the lower half, at 1 / 2.6 of the side."""
    palm = np.zeros(19)
    palm[1:5] = 40, 60, 80, 100
    palm[PALM_WRIST] = 60, 100
    palm[9:11] = 60, 60
    region = palm_region(palm, np.array([[1.0, 0, 0], [0, 1, 0]]))
    assert region.center == (60, 60) and region.size == pytest.approx(104) and region.angle == 0
    quarter = palm_region(palm, np.array([[0, -2.0, 7], [2, 0, 9]]))  # turned clockwise, twice as large
    assert quarter.angle == pytest.approx(np.pi / 2) and quarter.size == pytest.approx(208)
    np.testing.assert_allclose(quarter.center, (-2 * 60 + 7, 2 * 60 + 9))


# --- which way it faces ---


def test_normals_point_out_of_the_palm():
    """A right hand, fingers up and thumb to the right of the image, shows its palm; its mirror image is a left one."""
    hand = right_hand()
    np.testing.assert_allclose(palm_normal(hand, "right"), (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(palm_normal(hand * (-1, 1, 1), "left"), (0, 0, -1), atol=1e-12)
    back = hand * (-1, 1, -1)  # turned about the fingers
    np.testing.assert_allclose(palm_normal(back, "right"), (0, 0, 1), atol=1e-12)


unit = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.2)


def look_at(shape: np.ndarray, at: np.ndarray, side: str = "right", presence: float = 0.9, unit: float = 1.0):
    """What perfect networks say of a hand at a point (metres)."""
    view = shape @ rotation_to(at / np.linalg.norm(at)).T
    metre = CAMERA.fx / at[2]
    palm = view[[WRIST, INDEX, PINKY]].mean(0)
    uv = CAMERA.project(at) + (view - palm)[:, :2] * metre
    right = 0.9 if side == "right" else 0.1
    return HandLandmarks(uv, (view[:, 2] - view[WRIST, 2]) * metre, (view - view.mean(0)) * unit, presence, right)


@given(unit, st.floats(0, 3), coordinates, coordinates, st.floats(0.5, 2))
@settings(max_examples=50)
def test_shape_is_that_of_the_hand_wherever_it_is(axis, turn, x, y, unit):
    """Also when the network takes the hand for larger or smaller than it is."""
    shape = right_hand() @ Rotation.from_rotvec(turn * axis / np.linalg.norm(axis)).as_matrix().T
    at = np.array([x, y, 1.5])
    found = hand_shape(CAMERA, look_at(shape, at, unit=unit), at[2] / CAMERA.fx)
    np.testing.assert_allclose(found, shape, atol=1e-6)


class PerfectNets(HandNets):
    """Says what it is told to."""

    def __init__(self, looks: list[HandLandmarks], palms: bool = True):
        self.looks, self.found = looks, palms

    def palms(self, crops):
        palm = np.zeros(19)
        palm[:5] = 0.9, 60, 60, 130, 130
        palm[PALM_WRIST] = 95.5, 122.3  # 6 cm below the middle
        palm[9:11] = 95.5, 80
        return [palm[None] if self.found else np.zeros((0, 19)) for _ in crops]

    def landmarks(self, crops, regions, mirrored=False):
        assert len(crops) == len(regions) == len(mirrored)
        assert [bool(m) for m in mirrored] == [False, True, False, True][: len(mirrored)]
        return self.looks[: len(crops)]


BLACK = np.zeros((540, 960, 3), np.uint8)
AT = np.array([0.0, 0.0, 1.5])
BODY = person({"right_wrist": (0, 0.06, 1.5), "right_elbow": (0, 0.31, 1.5)})


def test_looks_that_agree_win():
    """Three palms to the camera and a back: the palm, with the back in the spread."""
    palm, back = look_at(right_hand(), AT), look_at(right_hand() * (-1, 1, -1), AT)
    found = ColorPath(PerfectNets([palm, back, palm, palm]), crops=4).estimate(frame_of(BLACK), BODY)
    assert found["left"] is None
    hand = found["right"]
    np.testing.assert_allclose(hand.normal, (0, 0, -1), atol=1e-6)
    np.testing.assert_allclose(hand.direction, right_hand()[MIDDLE] / np.linalg.norm(right_hand()[MIDDLE]), atol=1e-6)
    assert hand.share == 0.75 and hand.spread == pytest.approx(np.pi / 2) and hand.presence == pytest.approx(0.9)
    assert hand.side_probability == pytest.approx(0.9)
    np.testing.assert_allclose(hand.shape, right_hand(), atol=1e-6)
    np.testing.assert_allclose(hand.keypoints_2d[:, :2], palm.uv)


def test_two_looks_that_disagree_say_less():
    """As many as are taken by default: neither has a majority, and the quality says so."""
    palm, back = look_at(right_hand(), AT), look_at(right_hand() * (-1, 1, -1), AT)
    split = ColorPath(PerfectNets([palm, back])).estimate(frame_of(BLACK), BODY)["right"]
    agreed = ColorPath(PerfectNets([palm, palm])).estimate(frame_of(BLACK), BODY)["right"]
    assert split.share == 0.5 and split.spread == pytest.approx(np.pi / 2**0.5) and abs(split.normal[2]) > 0.99
    assert split.quality < agreed.quality - 0.2


def test_looks_that_saw_something_else_do_not_count():
    palm = look_at(right_hand(), AT)
    elsewhere = look_at(right_hand(), AT + (0.3, 0, 0))
    nothing = look_at(right_hand(), AT, presence=0.4)
    found = ColorPath(PerfectNets([palm, elsewhere, nothing, palm]), crops=4).estimate(frame_of(BLACK), BODY)
    assert found["right"].share == 0.5 and found["right"].spread == pytest.approx(0, abs=1e-6)
    assert ColorPath(PerfectNets([elsewhere, nothing] * 2)).estimate(frame_of(BLACK), BODY)["right"] is None
    assert ColorPath(PerfectNets([palm] * 4, palms=False)).estimate(frame_of(BLACK), BODY)["right"] is None


def test_one_palm_is_one_hand():
    """Both wrists near one palm: it belongs to the nearer one."""
    both = {"right_wrist": (0, 0.06, 1.5), "right_elbow": (0, 0.31, 1.5)}
    both |= {"left_wrist": (0.04, 0.06, 1.5), "left_elbow": (0.04, 0.31, 1.5)}
    path = ColorPath(PerfectNets([look_at(right_hand(), AT)] * 4))
    own = path._nets.palms([BLACK])[0]
    shifted = own - np.array([0, *[0.04 / 0.43 * PALM_SIZE, 0] * 9])
    path._nets.palms = lambda crops: [shifted, own]  # left, right
    found = path.estimate(frame_of(BLACK), person(both))
    assert found["right"] is not None and found["left"] is None


# --- with the networks ---


@pytest.fixture(scope="module")
def nets(models: None) -> HandNets:
    return HandNets(assets.model_path("palm_detection_full"), assets.model_path("hand_landmark_full"))


@pytest.fixture(scope="module")
def clear() -> tuple[RegisteredFrame, Person, np.ndarray]:
    """A frame, somebody in it, and the true normal of their right hand, which is in clear view (its back)."""
    recording = recordings.open("sample")
    truth = recording.truth.frames[0][0]
    return register(recording[0]), person(truth.keypoints), truth.palms["right"]


def interpreter(name: str):
    litert = pytest.importorskip("ai_edge_litert.interpreter", reason="the oracle ai-edge-litert is not installed")
    out = litert.Interpreter(str(assets.model_path(name)), num_threads=1)
    out.allocate_tensors()
    return out


def run(oracle, image: np.ndarray) -> dict[str, np.ndarray]:
    oracle.set_tensor(oracle.get_input_details()[0]["index"], image[None].astype(np.float32) / 255)
    oracle.invoke()
    return {sink["name"]: oracle.get_tensor(sink["index"])[0] for sink in oracle.get_output_details()}


def test_anchors():
    assert _ANCHORS.shape == (2016, 2)
    np.testing.assert_allclose(
        _ANCHORS[[0, 1, 2, -1]], [[0.5 / 24] * 2, [0.5 / 24] * 2, [1.5 / 24, 0.5 / 24], [11.5 / 12] * 2]
    )


def test_palms_as_litert_computes_them(nets, clear):
    """The best anchor, decoded by hand; the suppression averages its neighbours in, which moves it a little."""
    oracle = interpreter("palm_detection_full")
    frame, body, _ = clear
    window = hand_place(frame.camera, body, "right").window
    crop = window.crop(frame.color, PALM_SIZE)
    raw = run(oracle, crop)
    best = int(np.argmax(raw["Identity_1"][:, 0]))
    found = nets.palms([crop])[0]
    assert len(found) == 1
    assert found[0, 0] == pytest.approx(1 / (1 + np.exp(-raw["Identity_1"][best, 0])), abs=1e-4)
    cell = np.repeat(_ANCHORS[best][None] * PALM_SIZE, 7, axis=0)
    np.testing.assert_allclose(found[0, 5:].reshape(7, 2), raw["Identity"][best, 4:].reshape(7, 2) + cell - 0.5, atol=3)
    wrist = window.to_image(PALM_SIZE) @ (*found[0, PALM_WRIST], 1)
    assert np.linalg.norm(wrist - frame.camera.project(body.keypoints[JOINT["right_wrist"]])) < 12


@pytest.mark.parametrize("mirrored", [False, True])
def test_landmarks_as_litert_computes_them(nets, clear, mirrored):
    """In a region that is not turned, the crop's pixels are the image's, shifted."""
    oracle = interpreter("hand_landmark_full")
    frame, body, _ = clear
    window = hand_place(frame.camera, body, "right").window
    image = window.crop(frame.color, HAND_SIZE)
    raw = run(oracle, image[:, ::-1] if mirrored else image)
    center = (HAND_SIZE - 1) / 2
    look = nets.landmarks([image], [Region((center + 10, center + 20), HAND_SIZE, 0.0)], mirrored)[0]
    screen, world = raw["Identity"].reshape(21, 3), raw["Identity_3"].reshape(21, 3)
    x = HAND_SIZE - screen[:, 0] if mirrored else screen[:, 0]
    np.testing.assert_allclose(look.uv, np.column_stack([x, screen[:, 1]]) + (9.5, 19.5), atol=0.02)
    np.testing.assert_allclose(look.z, 2.5 * (screen[:, 2] - screen[0, 2]), atol=0.02)
    np.testing.assert_allclose(look.world, world * (-1 if mirrored else 1, 1, 1), atol=1e-4)
    assert look.presence == pytest.approx(float(raw["Identity_1"][0]), abs=1e-3)
    right = float(raw["Identity_2"][0])
    assert look.right == pytest.approx(1 - right if mirrored else right, abs=1e-3)


def test_mirrored_looks_are_looks_at_the_mirror_image(nets, clear):
    """In a turned region: positions, world and handedness of the mirror image, mirrored."""
    frame, body, _ = clear
    region = hand_place(frame.camera, body, "right").window
    width = frame.color.shape[1]
    flipped = np.ascontiguousarray(frame.color[:, ::-1])
    there = Region((width - 1 - region.center[0], region.center[1]), region.size, -region.angle)
    assert abs(region.angle) > 0.1
    one = nets.landmarks([region.crop(frame.color, HAND_SIZE)], [region], [True])[0]
    other = nets.landmarks([there.crop(flipped, HAND_SIZE)], [there], [False])[0]
    np.testing.assert_allclose(one.uv, (width - 1, 0) + other.uv * (-1, 1), atol=0.5)
    np.testing.assert_allclose(one.world, other.world * (-1, 1, 1), atol=2e-3)
    assert one.right == pytest.approx(1 - other.right, abs=0.05)


def test_a_hand_in_clear_view(nets, clear):
    frame, body, truth = clear
    path = ColorPath(nets)
    hand = path.estimate(frame, body)["right"]
    assert np.degrees(angle_between(hand.normal, truth)) < 35
    assert hand.share == 1 and hand.presence > 0.9 and hand.spread < np.radians(20) and hand.side_probability > 0.6
    assert np.linalg.norm(hand.normal) == pytest.approx(1) and np.linalg.norm(hand.direction) == pytest.approx(1)
    assert 0.06 < np.linalg.norm(hand.shape[MIDDLE]) < 0.14  # metres: from the wrist to the middle knuckle
    wrist = frame.camera.project(body.keypoints[JOINT["right_wrist"]])
    assert np.linalg.norm(hand.keypoints_2d[WRIST, :2] - wrist) < 12
    again = path.estimate(frame, body)["right"]
    np.testing.assert_array_equal(hand.normal, again.normal)


def test_mirror_image_has_the_mirrored_palm(nets, clear):
    """Left and right exchanged, the normal mirrored."""
    frame, body, _ = clear
    K = frame.camera.K.copy()
    K[0, 2] = frame.camera.width - 1 - K[0, 2]
    camera = Camera(frame.camera.width, frame.camera.height, K)
    flipped = frame_of(np.ascontiguousarray(frame.color[:, ::-1]), camera)
    other = person(body.keypoints[FLIP] * (-1, 1, 1))
    path = ColorPath(nets)
    one, two = path.estimate(frame, body)["right"], path.estimate(flipped, other)["left"]
    assert np.degrees(angle_between(one.normal, two.normal * (-1, 1, 1))) < 20
    assert two.side_probability > 0.6


def test_no_hand_where_there_is_none(nets, clear):
    frame, body, _ = clear
    path = ColorPath(nets)
    assert path.estimate(frame_of(np.full((540, 960, 3), 120, np.uint8)), body) == {"left": None, "right": None}
    assert path.estimate(frame, person({})) == {"left": None, "right": None}
    assert path.estimate(frame, person({"right_wrist": (0, -0.6, 3.5)}))["right"] is None  # the wall
