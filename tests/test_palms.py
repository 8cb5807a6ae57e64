"""Palms: the hand's frame; in people.json and back; in pictures; in the viewer."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.camera import Camera
from understudy.drawing import WHITE
from understudy.errors import RecordingError
from understudy.hand_overlay import PALM_ARROW_M, palm_middle
from understudy.overlay import PALETTE, draw_people, left_color, person_color
from understudy.people_file import FramePeople, PeopleFile, frame_from_json, frame_to_json
from understudy.skeleton import HAND_BONES, HAND_KEYPOINTS, JOINT
from understudy.types import OBSERVED, Hands, Keypoints2D, Palm, Person
from understudy.viewer.results import Moment
from understudy.viewer.scene import shade

CAMERA = Camera.from_fov(640, 480, np.deg2rad(60))
SIDES = ("left", "right")

# An open right hand in its own frame: x towards the fingers, z out of the palm, the thumb at -y; metres.
OPEN = np.array([
    [0, 0, 0], [.02, -.03, .01], [.05, -.05, .02], [.08, -.065, .02], [.1, -.075, .02],
    [.09, -.025, 0], [.125, -.03, .01], [.15, -.03, .01], [.17, -.035, .02],
    [.095, 0, 0], [.135, 0, .01], [.16, 0, .01], [.185, 0, .02],
    [.09, .02, 0], [.125, .02, .01], [.15, .02, .01], [.17, .025, .02],
    [.08, .04, 0], [.105, .045, .01], [.125, .05, .01], [.145, .05, .02],
])  # fmt: skip
MIDDLE = OPEN[[0, 5, 17]].mean(axis=0)
TOWARDS, AWAY, RIGHTWARDS = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


def person(z=1.5, **hands) -> Person:
    """The wrists are far to the image's left and right, the other joints low, the head (with the label) high."""
    joints = np.tile((0.0, 0.6, z), (18, 1))
    joints[:, 0] += np.linspace(-0.2, 0.2, 18)
    joints[JOINT["nose"]] = 0.0, -0.45, z
    joints[JOINT["right_wrist"]], joints[JOINT["left_wrist"]] = (-0.4, 0.0, z), (0.4, 0.0, z)
    uv = CAMERA.project(joints)
    return Person(
        Keypoints2D.where(uv, np.full(18, 0.9)),
        joints,
        np.full(18, 0.9),
        np.full(18, 0.02),
        (OBSERVED,) * 18,
        hands=Hands(**hands),
    )


def hand(side: str, normal=TOWARDS, confidence=0.9, up=(0.0, -1.0, 0.0), z=1.5) -> Palm:
    """The hand of `person`, open, fingers up (or as `up` says)."""
    bare = Palm(np.array(normal), confidence, np.array(up))
    own = OPEN * (1, 1 if side == "right" else -1, 1)
    wrist = person(z).keypoints[JOINT[f"{side}_wrist"]]
    return Palm(bare.normal, confidence, bare.direction, wrist + own @ bare.R_cam_hand.T)


def draw(someone: Person) -> np.ndarray:
    return draw_people(np.full((480, 640, 3), 128, np.uint8), [someone], CAMERA, legend=False)


def added(side: str, palm: Palm, z=1.5) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (u, v) that a palm changes in the picture of a person, and the picture."""
    image = draw(person(z, **{side: palm}))
    v, u = np.nonzero((image != draw(person(z))).any(axis=2))
    return np.column_stack([u, v]), image


def at(image, point) -> tuple[int, ...]:
    u, v = np.rint(CAMERA.project(np.asarray(point))).astype(int)
    return tuple(int(c) for c in image[v, u])


# --- the hand's frame ---


@given(st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_the_hand_frame_is_a_rotation_of_the_documented_axes(seed):
    rng = np.random.default_rng(seed)
    normal, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    R = Palm(normal, 0.9, direction).R_cam_hand
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 2], normal)
    np.testing.assert_allclose(R[:, 1], np.cross(R[:, 2], R[:, 0]), atol=1e-9)
    assert R[:, 0] @ direction >= 0 and abs(R[:, 1] @ direction) < 1e-9  # x is the part of it across the normal


@pytest.mark.parametrize("side, thumb", [("right", 1), ("left", -1)])
def test_the_thumb_of_a_raised_open_hand_points_to_the_other_side(side, thumb):
    """Palms towards the camera, fingers up: the right hand's thumb is on the image's right, the left hand's left."""
    palm = hand(side)
    off = palm.keypoints[HAND_KEYPOINTS.index("thumb_4")] - palm.keypoints[HAND_KEYPOINTS.index("pinky_4")]
    assert np.sign(off[0]) == thumb
    assert (palm.R_cam_hand.T @ off)[1] * thumb < 0  # right: at -y


def test_without_a_direction_across_the_normal_there_is_no_frame():
    normal = np.array([0.6, 0.0, 0.8])
    assert Palm(normal, 0.9).R_cam_hand is None
    assert Palm(normal, 0.9, normal).R_cam_hand is None and Palm(normal, 0.9, -normal).R_cam_hand is None


def test_hands_are_a_mapping_of_two_sides():
    palm = hand("left")
    hands = Hands(left=palm, why={"right": "too far"})
    assert dict(hands) == {"left": palm, "right": None} and len(hands) == 2 and hands.get("middle") is None
    with pytest.raises(KeyError):
        hands["middle"]


# --- people.json ---


def random_palm(rng: np.random.Generator) -> Palm:
    normal, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    keypoints = rng.normal(0, 1, (21, 3))
    keypoints[rng.random(21) < 0.3] = np.nan
    seen = np.column_stack([rng.uniform(-9, 900, (21, 2)), rng.uniform(0, 1, 21)])
    return Palm(normal, float(rng.random()), *(x if rng.random() < 0.7 else None for x in (direction, keypoints, seen)))


@given(st.integers(0, 2**31), st.dictionaries(st.sampled_from(SIDES), st.text()), st.booleans())
@settings(max_examples=40, deadline=None)
def test_palms_come_back_from_the_file(seed, why, failed):
    rng = np.random.default_rng(seed)
    hands = Hands(*(random_palm(rng) if rng.random() < 0.7 else None for _ in SIDES), why)
    someone = replace(person(), hands=hands, failed="why" if failed else None)
    data = json.loads(json.dumps(frame_to_json(FramePeople(0, (someone,))), allow_nan=False))
    back = frame_from_json(data, "x")
    assert frame_to_json(back) == data
    (again,) = back.people
    assert isinstance(again.hands, Hands) and again.hands.why == why
    assert ("hands_missing" in data["people"][0]) == bool(why)
    for side in SIDES:
        one, other = hands[side], again.hands[side]
        assert (one is None) == (other is None)
        if one is None or other is None:
            continue
        assert other.confidence == pytest.approx(one.confidence, abs=1e-4)
        for name, digits in (("normal", 5), ("direction", 5), ("keypoints", 4), ("keypoints_2d", 3)):
            a, b = getattr(one, name), getattr(other, name)
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_allclose(a, b, atol=0.51 * 10**-digits)


def test_the_keys_of_a_palm():
    palm = hand("right")
    palm.keypoints[3, 1] = np.nan
    seen = np.column_stack([CAMERA.project(palm.keypoints), np.full(21, 0.8)])  # one row is NaN
    full = Palm(palm.normal, 0.75, palm.direction, palm.keypoints, seen)
    someone = person(left=Palm(palm.normal, 0.5), right=full)
    data = frame_to_json(FramePeople(0, (someone,)))["people"][0]
    assert data["hands"]["left"] == {"normal": [0, 0, -1], "confidence": 0.5} and "hands_missing" not in data
    right = data["hands"]["right"]
    assert set(right) == {"normal", "confidence", "direction", "keypoints", "keypoints_2d"}
    assert right["direction"] == [0, -1, 0] and len(right["keypoints"]) == len(right["keypoints_2d"]) == 21
    assert right["keypoints"][0] == [-0.4, 0, 1.5] and right["keypoints"][3] is None
    assert right["keypoints_2d"][3] == [0, 0, 0] and right["keypoints_2d"][0][2] == 0.8
    why = frame_to_json(FramePeople(0, (person(why={"right": "too far"}),)))["people"][0]
    assert why["hands_missing"] == {"right": "too far"} and why["hands"] == {"left": None, "right": None}


def test_files_from_before_still_read(tmp_path):
    data = frame_to_json(FramePeople(0, (person(),)))
    data["people"][0]["hands"] = {"left": {"normal": [0.6, 0.0, -0.8], "confidence": 0.8}, "right": None}
    (tmp_path / "people.json").write_text(json.dumps({"format": "people/1", "frames": [data]}))
    (someone,) = PeopleFile.read(tmp_path / "people.json").frames[0].people
    assert isinstance(someone.hands, Hands) and not someone.hands.why and someone.hands["right"] is None
    palm = someone.hands["left"]
    assert palm is not None and palm.normal.tolist() == [0.6, 0.0, -0.8] and palm.confidence == 0.8
    assert palm.direction is None and palm.keypoints is None and palm.keypoints_2d is None


def test_lengths_that_are_nearly_one_become_one():
    palm = {"normal": [0.0, 0.0, -1.009], "confidence": 1}
    back = frame_from_json(frame_data(palm), "x").people[0].hands["left"]
    assert back is not None and back.normal.tolist() == [0, 0, -1]


def frame_data(palm, **fields) -> dict:
    data = frame_to_json(FramePeople(0, (person(),)))
    data["people"][0] |= {"hands": {"left": palm, "right": None}} | fields
    return data


ROWS = [[1.0, 2.0, 0.5]] * 21


@pytest.mark.parametrize(
    "change, message",
    [
        ({"normal": None}, "normal: must be 3 numbers"),
        ({"normal": [0, 0]}, "normal: must be 3 numbers"),
        ({"normal": [[0], [0], [1]]}, "normal: must be 3 numbers"),
        ({"normal": "001"}, "normal: must be 3 numbers"),
        ({"normal": [0, "0", 1]}, "normal: must be 3 numbers"),
        ({"normal": [False, False, True]}, "normal: must be 3 numbers"),
        ({"normal": [0, float("nan"), 1]}, "normal: must be 3 numbers"),
        ({"normal": [0, 0, 10**400]}, "normal: must be 3 numbers"),
        ({"normal": [0, 0, 1.02]}, r"normal: must be a unit vector, got \[0, 0, 1.02\]"),
        ({"normal": [0, 0, 0]}, "normal: must be a unit vector"),
        ({"direction": [1e200, 1e200, 1e200]}, "direction: must be a unit vector"),
        ({"direction": 5}, "direction: must be 3 numbers"),
        ({"confidence": 1.01}, r"confidence: must be a number in \[0, 1\], got 1.01"),
        ({"confidence": -0.1}, "confidence: must be"),
        ({"confidence": None}, "confidence: must be"),
        ({"confidence": True}, "confidence: must be"),
        ({"confidence": "0.5"}, "confidence: must be"),
        ({"confidence": float("nan")}, "confidence: must be"),
        ({"keypoints": ROWS[:18]}, "keypoints: must be a list of 21 rows"),
        ({"keypoints": 5}, "keypoints: must be a list of 21 rows"),
        ({"keypoints": [[1.0, 2.0]] * 21}, "keypoints: each row must be 3 numbers or null"),
        ({"keypoints": [["1", "2", "3"], *ROWS[1:]]}, "keypoints: each row must be 3 numbers or null"),
        ({"keypoints": [10 * [1.0], *ROWS[1:]]}, "keypoints: each row must be 3 numbers or null"),
        ({"keypoints": [[1.0, 2.0, 10**400], *ROWS[1:]]}, "keypoints: each row must be 3 numbers or null"),
        ({"keypoints": [[1.0, float("nan"), 2.0], *ROWS[1:]]}, "keypoints: must be finite"),
        ({"keypoints": [[1.0, float("inf"), 2.0], *ROWS[1:]]}, "keypoints: must be finite"),
        ({"keypoints_2d": ROWS[:20]}, "keypoints_2d: must be a list of 21 rows"),
        ({"keypoints_2d": [[1.0, 2.0, 1.5], *ROWS[1:]]}, r"keypoints_2d: scores must lie in \[0, 1\]"),
        ({"keypoints_2d": [[1.0, float("inf"), 0.5], *ROWS[1:]]}, "keypoints_2d: must be finite"),
    ],
)
def test_damaged_palms(change, message):
    palm = {"normal": [0, 0, -1], "confidence": 0.9, "keypoints": [None, *ROWS[1:]], "keypoints_2d": ROWS}
    assert frame_from_json(frame_data(palm), "file").people[0].hands["left"] is not None
    with pytest.raises(RecordingError, match=rf"^file\.people\[0\]\.hands\.left\.{message}"):
        frame_from_json(frame_data(palm | change), "file")


@pytest.mark.parametrize(
    "why, message",
    [
        ([1], "hands_missing: must be an object"),
        ({"Left": "x"}, "hands_missing: 'Left' must be one of 'left', 'right'"),
        ({"left": 5}, "hands_missing.left: must be a text, got 5"),
    ],
)
def test_damaged_reasons(why, message):
    with pytest.raises(RecordingError, match=rf"^file\.people\[0\]\.{message}"):
        frame_from_json(frame_data(None, hands_missing=why), "file")


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


PALM_KEYS = ("normal", "confidence", "direction", "keypoints", "keypoints_2d")
INTACT = frame_to_json(FramePeople(0, (person(),)))["people"][0]


@given(
    st.sampled_from(("hands", "hands_missing", "left", *PALM_KEYS)),
    ANYTHING | st.lists(ANYTHING, min_size=3, max_size=3) | st.lists(ANYTHING, min_size=21, max_size=21),
)
@settings(max_examples=100, deadline=None)
def test_whatever_stands_there_is_read_or_refused_by_name(key, value):
    palm = {"normal": [0, 0, -1], "confidence": 0.9} | ({key: value} if key in PALM_KEYS else {})
    fields = {"hands": {"left": value if key == "left" else palm}} | ({key: value} if key.startswith("hands") else {})
    try:
        read, refused = frame_from_json({"index": 0, "people": [INTACT | fields]}, "file"), None
    except RecordingError as e:
        read, refused = None, str(e)
    if read is None:
        assert refused.startswith("file.people[0].hands")  # hands_missing too
    else:
        json.dumps(frame_to_json(read), allow_nan=False)


# --- pictures ---


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.8, 0.0, -0.6), (-0.8, 0.0, 0.6)])
def test_arrows_go_from_the_middle_of_the_palm_the_way_it_faces(side, normal):
    palm = hand(side, normal)
    image = draw(person(**{side: palm}))
    middle = palm.keypoints[[0, 5, 17]].mean(axis=0)
    np.testing.assert_allclose(palm_middle(person(**{side: palm}), side), middle)
    for part in (0.5, 0.7):
        assert at(image, middle + part * PALM_ARROW_M * np.array(normal)) == WHITE
    for part in (-0.7, 1.3):
        assert at(image, middle + part * PALM_ARROW_M * np.array(normal)) != WHITE


def test_the_middle_is_of_what_is_known():
    palm = hand("right")
    palm.keypoints[[0, 17]] = np.nan
    np.testing.assert_array_equal(palm_middle(person(right=palm), "right"), palm.keypoints[5])
    palm.keypoints[5] = np.nan
    someone = person(right=palm)
    np.testing.assert_array_equal(palm_middle(someone, "right"), someone.keypoints[JOINT["right_wrist"]])
    assert palm_middle(someone, "left") is None
    someone.keypoints[:] = np.nan
    assert palm_middle(someone, "right") is None
    assert draw(someone).shape == (480, 640, 3)


def test_arrows_at_the_camera_show_as_discs_and_those_away_from_it_as_rings():
    for normal, inside in ((TOWARDS, WHITE), (AWAY, left_color(PALETTE[0]))):
        someone = person(left=Palm(np.array(normal), 0.9))
        someone.keypoints[JOINT["left_wrist"]] = 0.0, 0.0, 1.5  # on the optical axis: the arrow is a dot
        row = draw(someone)[240, 300:340].astype(int)
        assert (row == inside).all(axis=1).sum() >= 4 and (row == WHITE).all(axis=1).sum() >= 2
        beside = (row == 128).all(axis=1)
        assert beside[:5].all() and not beside[17:23].any()


@pytest.mark.parametrize("side", SIDES)
def test_doubtful_palms_are_thinner_and_fainter(side):
    sure, _ = added(side, hand(side, RIGHTWARDS, 0.5))
    faint, image = added(side, hand(side, RIGHTWARDS, 0.49))
    assert 0 < len(faint) < len(sure)
    palm = hand(side, RIGHTWARDS, 0.49)
    assert at(image, palm.keypoints[[0, 5, 17]].mean(axis=0) + (0.09, 0, 0)) != WHITE
    tips = [points[:, 0].max() for points in (sure, faint)]  # the arrow is as long
    assert abs(tips[0] - tips[1]) <= 2


@pytest.mark.parametrize("side", SIDES)
def test_bones_of_hands_are_in_the_colour_of_the_side(side):
    palm = hand(side)
    image = draw(person(**{side: palm}))
    color = PALETTE[0] if side == "right" else left_color(PALETTE[0])
    for a, b in ((9, 10), (17, 18), (3, 4)):
        u, v = np.rint(CAMERA.project(palm.keypoints[[a, b]]).mean(axis=0)).astype(int)
        patch = image[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3).astype(int)
        assert np.abs(patch - color).sum(axis=1).min() < 60, (a, b)
    assert all(0 <= a < b < 21 for a, b in HAND_BONES)


def test_detected_keypoints_come_before_projected_ones():
    palm = hand("right")
    uv = CAMERA.project(palm.keypoints) + (0, 100)
    score = np.full(21, 0.9)
    seen = Palm(palm.normal, 0.9, palm.direction, palm.keypoints, np.column_stack([uv, score]))
    unseen = Palm(palm.normal, 0.9, palm.direction, palm.keypoints, np.column_stack([uv, 0 * score]))
    only = Palm(palm.normal, 0.9, keypoints_2d=np.column_stack([uv, score]))
    tip = HAND_KEYPOINTS.index("middle_4")
    for shown, there in ((seen, True), (unseen, False), (only, True)):
        points, _ = added("right", shown)
        assert (np.linalg.norm(points - uv[tip], axis=1).min() < 2) == there
        assert (np.linalg.norm(points - uv[tip] + (0, 100), axis=1).min() < 2) != there


def test_hands_that_look_small_have_no_bones():
    far = hand("right", RIGHTWARDS, z=8.0)
    points, _ = added("right", far, z=8.0)
    tip = CAMERA.project(far.keypoints[HAND_KEYPOINTS.index("middle_4")])
    assert len(points) and np.linalg.norm(points - tip, axis=1).min() > 2


@pytest.mark.parametrize("z", [1e-6, 0.05, 0.1, 1.5, 1e6])
@pytest.mark.parametrize("normal", [TOWARDS, AWAY, RIGHTWARDS])
def test_hands_anywhere_do_no_harm(z, normal):
    palm = hand("left", normal, up=(0.0, -1.0, 0.0), z=z)
    assert draw(person(z, left=palm)).shape == (480, 640, 3)
    behind = Palm(palm.normal, 0.2, palm.direction, -palm.keypoints, np.full((21, 3), 1.0) * (1e12, -1e12, 1))
    assert draw(person(z, left=behind, right=behind)).shape == (480, 640, 3)


# --- the viewer ---


class Recorder:
    """Stands in for viser's server: keeps what is added, by name."""

    def __init__(self):
        self.scene = self.initial_camera = self
        self.added = {}

    def __getattr__(self, kind):
        def add(name="", *args, **options):
            node = type("Node", (), {"name": name, "kind": kind, "args": args, "options": options})()
            self.added[name] = node
            return node

        return add


def test_the_viewer_draws_arrows_and_hands():
    pytest.importorskip("viser", reason="the viewer's ball comes with viser (the extra 'viewer')")
    from understudy.viewer.scene import Scene

    left, right = hand("left", RIGHTWARDS, 0.3), hand("right", TOWARDS)
    left.keypoints[8] = np.nan
    bare = Palm(np.array(TOWARDS), 0.9)
    moment = Moment(FramePeople(0, (person(left=left, right=right), person(left=bare))))
    recorder = Recorder()
    scene = Scene(recorder, CAMERA, moment)
    scene.draw(moment)
    names = {name for name in recorder.added if "palm" in name or "hand" in name}
    assert names == {
        "/skeletons/0/left_palm", "/skeletons/0/right_palm", "/skeletons/0/left_hand", "/skeletons/0/right_hand",
        "/skeletons/1/left_palm",
    }  # fmt: skip
    arrow = recorder.added["/skeletons/0/right_palm"].args[0]
    middle = right.keypoints[[0, 5, 17]].mean(axis=0)
    np.testing.assert_allclose(arrow, [[middle, middle + PALM_ARROW_M * right.normal]])
    wrist = person().keypoints[JOINT["left_wrist"]]
    np.testing.assert_allclose(recorder.added["/skeletons/1/left_palm"].args[0][0, 0], wrist)
    bones, colors = recorder.added["/skeletons/0/right_hand"].args
    np.testing.assert_allclose(bones, right.keypoints[np.array(HAND_BONES)], atol=1e-6)
    assert colors.shape == (20, 2, 3) and (np.abs(colors - shade(person_color(0), False)) <= 1).all()
    assert recorder.added["/skeletons/0/left_hand"].args[0].shape == (19, 2, 3)  # one fingertip is not known
    sure, faint = (recorder.added[f"/skeletons/0/{side}_palm"].options["shaft_radius"] for side in ("right", "left"))
    assert faint < sure
