"""Palms: laws of the hand's view, the network in use, reasons why there is no palm; and what the method reaches."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy import recordings, runtime
from understudy.camera import Camera
from understudy.errors import ModelFileError, UnderstudyError
from understudy.estimator import Estimator
from understudy.hands import HandNormalEstimator, predictor
from understudy.hands import estimator as hands_module
from understudy.hands.color_path import ColorPalm
from understudy.hands.crop import (
    CELL,
    CELLS,
    CONTEXT,
    EMPTY,
    GREY,
    HALF,
    LIMIT,
    PIXEL,
    PIXELS,
    SIGMA,
    HandView,
    arm_context,
    crop_rotation,
)
from understudy.hands.estimator import supported, within_10_cm, wrist_of
from understudy.hands.predictor import HandPrediction, HandPredictor, color_word, pooled
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Keypoints2D, Person, RegisteredDepth, RegisteredFrame, Wrist

SIDES = ("left", "right")
MIRROR = np.array([-1.0, 1.0, 1.0])


def skeleton(seed: int = 0) -> np.ndarray:
    """A person 2.5 m away, arms wherever."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.25, (N_JOINTS, 3)) + [0.2, 0, 2.5]


def person(joints: np.ndarray) -> Person:
    nothing = Keypoints2D(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS))
    return Person(nothing, joints, np.ones(N_JOINTS), np.full(N_JOINTS, 0.02), ("observed",) * N_JOINTS)


def mirrored_sides(joints: np.ndarray) -> np.ndarray:
    """Left and right joints exchanged."""
    out = joints.copy()
    for name, row in JOINT.items():
        other = name.replace("left", "?").replace("right", "left").replace("?", "right")
        out[JOINT[other]] = joints[row]
    return out


def cloud_around(view: HandView, n: int = 4000, seed: int = 1) -> np.ndarray:
    return view.center + np.random.default_rng(seed).normal(0, 0.1, (n, 3))


@pytest.mark.parametrize("side", SIDES)
def test_view_goes_there_and_back(side: str) -> None:
    joints = skeleton()
    view = HandView.of(joints, side)
    assert view is not None
    assert np.linalg.det(view.R) == pytest.approx(1.0 if side == "right" else -1.0)
    np.testing.assert_allclose(view.R @ view.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(view.to_cam(view.context), arm_context(joints, side), atol=1e-12)
    np.testing.assert_allclose(view.directions_to_cam(view.directions_from_cam(np.eye(3))), np.eye(3), atol=1e-12)
    forearm = view.context[0] - view.context[1]
    assert abs(forearm[0]) < 1e-9 and forearm[1] < 0  # upwards in the crop


def test_a_turned_world_gives_the_same_crop() -> None:
    """The crop does not depend on where in the image, or how turned, the hand is."""
    joints = skeleton(3)
    view = HandView.of(joints, "right")
    points = cloud_around(view)
    turn = Rotation.from_rotvec([0.2, -0.1, 0.9]).as_matrix()
    other = HandView.of(joints @ turn.T, "right")
    np.testing.assert_allclose(other.context, view.context, atol=1e-9)
    np.testing.assert_allclose(other.depth_crop(points @ turn.T), view.depth_crop(points), atol=1e-6)
    np.testing.assert_allclose(
        other.directions_to_cam(np.eye(3)), view.directions_to_cam(np.eye(3)) @ turn.T, atol=1e-9
    )


def test_a_left_hand_is_a_right_one_in_the_mirror() -> None:
    joints = skeleton(4)
    left = HandView.of(joints, "left")
    right = HandView.of(mirrored_sides(joints) * MIRROR, "right")
    points = cloud_around(left)
    np.testing.assert_allclose(right.context, left.context, atol=1e-12)
    np.testing.assert_array_equal(right.depth_crop(points * MIRROR), left.depth_crop(points))
    np.testing.assert_allclose(right.directions_to_cam(np.eye(3)), left.directions_to_cam(np.eye(3)) * MIRROR)


def test_crop_of_a_plane_is_flat_and_whole() -> None:
    view = HandView.of(skeleton(5), "right")
    steps = (np.arange(CELLS) + 0.5) * CELL - HALF
    x, y = np.meshgrid(steps, steps)
    plane = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    crop = view.depth_crop(view.to_cam(plane))
    assert crop[1].all()
    np.testing.assert_allclose(crop[0], 0.0, atol=1e-6)
    assert (view.depth_crop(view.to_cam(plane + [0, 0, -LIMIT - 0.01]))[0] == EMPTY).all()  # an occluder before it
    scale = (view.distance + 1.0) / view.distance
    far = view.depth_crop(view.to_cam(plane * scale + [0, 0, 1.0]))
    np.testing.assert_allclose(far[0][far[1] > 0], LIMIT, atol=1e-6)


def test_crop_needs_only_the_points_near() -> None:
    camera = Camera(320, 240, np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]))
    z = np.random.default_rng(2).uniform(1.5, 3.5, (240, 320)).astype(np.float32)
    depth = RegisteredDepth(z, camera)
    v, u = np.mgrid[0:240.0, 0:320.0]
    everything = camera.unproject(np.stack([u.ravel(), v.ravel()], 1), z.ravel().astype(np.float64))
    for seed in range(6):
        view = HandView.of(skeleton(seed) + [0.4 * (seed % 3 - 1), 0, 0], SIDES[seed % 2])
        np.testing.assert_allclose(view.depth_crop(view.points_near(depth)), view.depth_crop(everything), atol=1e-5)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("focal", [280.0, 1400.0])
def test_colour_crop_shows_what_lies_there(side: str, focal: float) -> None:
    """Each pixel of the crop has the colour of the image where its place at the hand's distance is seen."""
    camera = Camera(
        1000, 800, np.array([[focal, 0, 499.5], [0, focal, 399.5], [0, 0, 1]]), "brown_conrady", (0.08, -0.1, 0, 0, 0)
    )
    v, u = np.mgrid[0:800, 0:1000]
    image = np.stack([u / 4, v / 4, np.zeros_like(u)], -1).astype(np.uint8)
    view = HandView.of(skeleton(5) * [0.3, 0.3, 1.0], side)
    crop = view.color_crop(camera, image).astype(float)
    steps = (np.arange(PIXELS) + 0.5) * PIXEL - HALF
    x, y = np.meshgrid(steps, steps)
    uv = camera.project(view.to_cam(np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))).reshape(PIXELS, PIXELS, 2)
    inside = ((uv > 4) & (uv < [995, 795])).all(-1)
    assert inside.mean() > 0.3
    np.testing.assert_allclose(crop[..., :2][inside], uv[inside] / 4, atol=1.5)


def test_colour_crop_is_grey_outside_the_image_and_mirrored_for_left_hands() -> None:
    camera = Camera(320, 240, np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]))
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    joints = skeleton(4) * [0.3, 0.3, 1.0]
    left, right = HandView.of(joints, "left"), HandView.of(mirrored_sides(joints) * MIRROR, "right")
    apart = np.abs(left.color_crop(camera, image).astype(int) - right.color_crop(camera, image[:, ::-1].copy()))
    assert (apart <= 1).all()
    assert (HandView.of(joints + [9, 0, 0], "left").color_crop(camera, image) == GREY).all()


def test_views_know_how_sure_the_arm_is() -> None:
    sigma = np.full(N_JOINTS, 0.02)
    sigma[JOINT["left_wrist"]], sigma[JOINT["left_elbow"]] = 0.3, np.nan
    np.testing.assert_allclose(HandView.of(skeleton(), "left", sigma).sigma, [0.3, SIGMA])
    np.testing.assert_allclose(HandView.of(skeleton(), "right", sigma).sigma, [0.02, 0.02])
    np.testing.assert_allclose(HandView.of(skeleton(), "right").sigma, [SIGMA, SIGMA])


def test_forearm_towards_the_camera_still_has_a_view() -> None:
    center = np.array([0.1, 0.2, 2.0])
    R = crop_rotation(center, -center / np.linalg.norm(center))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert R[1, 1] > 0.9  # the image's own upright


def test_no_view_without_an_arm() -> None:
    joints = skeleton()
    joints[JOINT["right_elbow"]] = np.nan
    assert HandView.of(joints, "right") is None
    assert HandView.of(joints, "left") is not None
    joints[JOINT["nose"]] = np.nan
    assert np.isfinite(HandView.of(joints, "left").context).all()
    joints[JOINT["left_wrist"], 2] = -1.0
    assert HandView.of(joints, "left") is None


def test_support_needs_a_surface_at_the_right_depth() -> None:
    view = HandView.of(skeleton(), "left")
    marks = view.to_cam(np.array([[0.0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0], [0.0, 0.5, 0]]))
    cloud = view.to_cam(np.array([[0.0, 0.005, -0.01], [0.1, 0, -0.15], [-0.05, 0, 0]]))
    assert supported(view, view.depth_crop(cloud), marks).tolist() == [True, False, False, False]
    assert not supported(view, view.depth_crop(np.zeros((0, 3))), marks).any()


def test_color_word_is_in_the_view() -> None:
    view = HandView.of(skeleton(), "left")
    palm = ColorPalm(view.directions_to_cam(np.array([0.0, 0, 1])), view.directions_to_cam(np.array([0.0, -1, 0])),
                     0.1, 0.9, np.zeros((21, 3)), np.zeros((21, 3)), 1.0, 0.8, 40.0)  # fmt: skip
    word = color_word(view, palm)
    np.testing.assert_allclose(word[:6], [0, 0, 1, 0, -1, 0], atol=1e-6)
    assert word[6] == pytest.approx(np.log(0.1)) and 0 < word[7] < 1 and word[8] == 1
    assert not color_word(view, None).any()


# -- the network in use --------------------------------------------------------------------------------------------


def frame_of(z: float | np.ndarray = 2.5) -> RegisteredFrame:
    camera = Camera(320, 240, np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]))
    depth = np.broadcast_to(np.float32(z), (240, 320)).astype(np.float32)
    return RegisteredFrame(np.full((240, 320, 3), 90, np.uint8), camera, RegisteredDepth(depth, camera))


def test_mirror_image_gives_mirrored_palms() -> None:
    """A law that no weights can break: the other hand in the mirror faces the mirrored way."""
    estimator = HandNormalEstimator(color=False, least_confidence=0.0)
    frame = frame_of(np.random.default_rng(0).uniform(2.2, 2.6, (240, 320)))
    flipped = RegisteredFrame(
        frame.color[:, ::-1].copy(), frame.camera, RegisteredDepth(frame.depth.z[:, ::-1].copy(), frame.camera)
    )
    joints = skeleton(7) - [0.2, 0, 0]
    hands = estimator.estimate(frame, person(joints))
    other = estimator.estimate(flipped, person(mirrored_sides(joints) * MIRROR))
    for a, b in (("left", "right"), ("right", "left")):
        np.testing.assert_allclose(other[b].normal, hands[a].normal * MIRROR, atol=2e-3)
        assert other[b].confidence == pytest.approx(hands[a].confidence, abs=2e-3)


def test_palm_has_what_a_gripper_needs() -> None:
    hands = HandNormalEstimator(color=False, least_confidence=0.0).estimate(
        frame_of(), person(skeleton(7) - [0.2, 0, 0])
    )
    for palm in hands.values():
        assert np.linalg.norm(palm.normal) == pytest.approx(1) and np.linalg.norm(palm.direction) == pytest.approx(1)
        R = palm.R_cam_hand
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1)
        np.testing.assert_allclose(R[:, 2], palm.normal, atol=1e-9)
        assert palm.keypoints.shape == (21, 3) and palm.keypoints_2d.shape == (21, 3)
        assert 0 <= palm.confidence <= 1


def test_everybody_at_once_is_the_same_as_one_by_one() -> None:
    estimator = HandNormalEstimator(color=False, least_confidence=0.0)
    people = [person(skeleton(k) - [0.2, 0, 0]) for k in range(3)]
    together = estimator.estimate_all(frame_of(), people)
    for one, hands in zip(people, together, strict=True):
        alone = estimator.estimate(frame_of(), one)
        for side in SIDES:
            if hands[side] is None:
                assert alone[side] is None
            else:
                np.testing.assert_allclose(alone[side].normal, hands[side].normal, atol=1e-5)


def test_says_why_there_is_no_palm() -> None:
    joints = skeleton() - [0.2, 0, 0]
    joints[JOINT["left_elbow"]] = np.nan
    joints[JOINT["right_wrist"]] = [3.0, 0, 2.5]
    hands = HandNormalEstimator(color=False).estimate(frame_of(), person(joints))
    assert hands.left is None and "elbow" in hands.why["left"]
    assert hands.right is None and "outside" in hands.why["right"]
    failed = Person.failure(Keypoints2D(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS)), "no depth")
    hands = HandNormalEstimator(color=False).estimate(frame_of(), failed)
    assert all("no depth" in hands.why[side] for side in SIDES)
    sure = HandNormalEstimator(color=False, least_confidence=1.0).estimate(frame_of(), person(skeleton() - [0.2, 0, 0]))
    assert all(sure[s] is not None or "unsure" in sure.why[s] or "outside" in sure.why[s] for s in SIDES)
    assert sure.why


def test_bad_settings_are_named() -> None:
    with pytest.raises(UnderstudyError, match="least_confidence"):
        HandNormalEstimator(least_confidence=1.5)
    with pytest.raises(UnderstudyError, match="hands 'both': must be"):
        Estimator(hands="both")


def test_without_the_colour_networks_depth_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(threads: int = 2) -> None:
        raise ModelFileError("offline: run `understudy models fetch`")

    monkeypatch.setattr(hands_module, "load_nets", absent)
    with pytest.warns(UserWarning, match="without the colour path.*understudy models fetch"):
        estimator = HandNormalEstimator()
    assert estimator.color_path is None
    assert estimator.estimate(frame_of(), person(skeleton(7) - [0.2, 0, 0])) is not None


def test_nobody_no_hands() -> None:
    assert HandNormalEstimator(color=False).estimate_all(frame_of(), []) == []
    assert Estimator("naive", hands="off").find_hands(frame_of(), []) == []


def test_exported_network_says_what_torch_says() -> None:
    torch = pytest.importorskip("torch")
    from safetensors.torch import load_file

    from understudy.hands.net import HandNormalNet
    from understudy.hands.predictor import weights_path

    net = HandNormalNet()
    state = load_file(weights_path().with_suffix(".safetensors"))
    net.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()})
    rng = np.random.default_rng(0)
    view = HandView.of(skeleton(), "right")
    depth = np.stack([view.depth_crop(cloud_around(view, seed=k)) for k in range(5)])
    color = rng.normal(0, 0.5, (5, 9)).astype(np.float32)
    # pure noise would make the network guess, and a guess magnifies rounding
    image = np.clip(rng.normal(rng.uniform(60, 200, (5, 1, 1, 3)), 10, (5, PIXELS, PIXELS, 3)), 0, 255).astype(np.uint8)
    said = HandPredictor()([view] * 5, depth, color, image)
    context = torch.tensor(np.stack([view.context] * 5)).float()
    with torch.no_grad():
        picture, sigma = torch.tensor(image).permute(0, 3, 1, 2).float(), torch.tensor(np.stack([view.sigma] * 5))
        out = net.eval()(
            torch.tensor(depth), context, torch.full((5, 1), view.distance), torch.tensor(color), sigma.float(), picture
        )
    for k, word in enumerate(said):
        np.testing.assert_allclose(view.directions_from_cam(word.normal), out.normal[k].numpy(), atol=1e-3)
        np.testing.assert_allclose((word.landmarks - view.center) @ view.R.T, out.landmarks[k].numpy(), atol=1e-3)
        assert word.confidence == pytest.approx(float(out.sure[k].sigmoid()), abs=1e-3)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_hands_do_not_depend_on_the_number_of_threads(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    several = HandPredictor()
    monkeypatch.setenv(runtime.THREADS, "1")
    single = HandPredictor()
    rng = np.random.default_rng(n)
    view = HandView.of(skeleton(), "right")
    depth = np.stack([view.depth_crop(cloud_around(view, seed=k)) for k in range(n)])
    color = rng.normal(0, 0.5, (n, 9)).astype(np.float32)
    image = rng.integers(0, 256, (n, PIXELS, PIXELS, 3), dtype=np.uint8)
    for one, two in zip(*(ask([view] * n, depth, color, image) for ask in (single, several)), strict=True):
        for a, b in zip(astuple(one), astuple(two), strict=True):
            np.testing.assert_array_equal(a, b)


def test_networks_of_other_versions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor, "CONTEXT", CONTEXT[:7])
    with pytest.raises(
        ModelFileError, match=r"handnormalnet\.onnx: .*'context' has the shape \(1, 11, 3\), not \(1, 7, 3\)"
    ):
        HandPredictor()


def _word(normal: list[float], confidence: float) -> HandPrediction:
    unit = np.array(normal) / np.linalg.norm(normal)
    return HandPrediction(unit, np.array([1.0, 0, 0]), np.full((21, 3), confidence), confidence)


def test_pooling_believes_the_sure_and_doubts_disagreement() -> None:
    one = _word([0, 0, 1], 0.8)
    assert pooled([one]) is one
    same = pooled([one, one, one])
    assert same.confidence == pytest.approx(0.8)
    np.testing.assert_allclose(same.normal, one.normal)
    other = pooled([one, _word([0, 1, 0], 0.2)])
    assert other.normal @ one.normal > 0.95 and other.confidence < 0.7
    np.testing.assert_array_equal(other.landmarks, one.landmarks)
    opposite = pooled([one, _word([0, 0, -1], 0.8)])
    assert np.isfinite(opposite.normal).all() and opposite.confidence < 0.5


def test_wrists_that_the_hands_know_better_replace_the_skeletons() -> None:
    joints = skeleton(7)
    before = replace(person(joints), sigma_m=np.full(N_JOINTS, 0.06), confidence=np.full(N_JOINTS, 0.5))
    there = Wrist(np.array([0.1, 0.2, 2.0]), 0.03, 0.99)
    after = before.with_wrists({"left": there, "right": Wrist(np.zeros(3), 0.07, 0.9)})
    row = JOINT["left_wrist"]
    rest = np.arange(N_JOINTS) != row
    np.testing.assert_array_equal(after.keypoints[row], there.position)
    assert after.sigma_m[row] == 0.03 and after.confidence[row] == 0.99
    for name in ("keypoints", "sigma_m", "confidence"):
        np.testing.assert_array_equal(getattr(after, name)[rest], getattr(before, name)[rest])
    hidden = replace(before, source=("inferred",) * N_JOINTS)
    assert hidden.with_wrists({"left": there}) is hidden


def test_within_10_cm_is_the_share_of_normal_errors() -> None:
    errors = np.random.default_rng(0).normal(0, 0.05, (200_000, 3))
    lengths = np.linalg.norm(errors, axis=1)
    sigma = float(np.quantile(lengths, 0.68))
    assert within_10_cm(sigma) == pytest.approx(float((lengths < 0.1).mean()), abs=0.01)
    sure, unsure = (wrist_of(_word([0, 0, 1], c)) for c in (0.95, 0.3))
    assert 0.02 < sure.sigma_m < 0.05 < unsure.sigma_m < 0.11
    assert 0.95 < sure.confidence <= 1 and unsure.confidence == within_10_cm(unsure.sigma_m)


@pytest.mark.parametrize(
    ("sigma", "sure", "looks"), [(0.02, 0.5, 1), (0.15, 0.5, 2), (np.nan, 0.5, 2), (0.15, 0.95, 1)]
)
def test_unsure_wrists_are_looked_at_again_where_they_were_found(sigma: float, sure: float, looks: int) -> None:
    joints = skeleton(7) - [0.2, 0, 0]
    row = JOINT["left_wrist"]
    joints[row] = [0.1, 0.05, 2.4]
    found = joints[row] + [0.06, 0.02, -0.05]
    asked: list[list[HandView]] = []

    def says(views: list[HandView], *crops: object) -> list[HandPrediction]:
        asked.append(list(views))
        word = _word([0, 0, 1] if len(asked) == 1 else [0, 1, 1], sure)
        return [replace(word, landmarks=np.tile(found, (21, 1)))] * len(views)

    camera = Camera(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
    depth = RegisteredDepth(np.full((48, 64), 2.4, np.float32), camera)
    frame = RegisteredFrame(np.zeros((48, 64, 3), np.uint8), camera, depth)
    estimator = HandNormalEstimator(color=False)
    estimator.predictor = says  # type: ignore[assignment]
    who = replace(person(joints), sigma_m=np.full(N_JOINTS, sigma))
    who.keypoints[JOINT["right_wrist"]] = np.nan
    hands = estimator.estimate(frame, who)
    wrists = [[view.to_cam(view.context)[0] for view in views] for views in asked]
    assert len(asked) == looks and all(len(w) == 1 for w in wrists)
    np.testing.assert_allclose(wrists[0][0], joints[row])
    np.testing.assert_allclose(wrists[-1][0], found if looks == 2 else joints[row])
    assert hands.left is not None and hands.right is None
    pooled_normal = [0, 0, 1] if looks == 1 else [0, np.sin(np.pi / 8), np.cos(np.pi / 8)]
    np.testing.assert_allclose(hands.left.normal, pooled_normal, atol=1e-9)


@pytest.mark.parametrize(
    ("left", "right", "wrists", "asked"),
    [
        (0.98, 0.96, ("observed", "observed"), []),  # the network is sure of both
        (0.98, 0.5, ("observed", "observed"), [["right"]]),
        (0.4, 0.5, ("observed", "observed"), [["left", "right"]]),
        (0.4, 0.5, ("observed", "inferred"), [["left"]]),  # the right hand is hidden
    ],
)
def test_colour_networks_are_asked_where_the_first_look_is_unsure(
    left: float, right: float, wrists: tuple[str, str], asked: list[list[str]]
) -> None:
    words: list[np.ndarray] = []
    sought: list[list[str]] = []

    def says(views: list[HandView], depth: object, color: np.ndarray, image: object) -> list[HandPrediction]:
        words.append(color[:, -1])
        return [_word([0, 0, 1], sure) for sure in ((left, right) if len(words) == 1 else [0.99] * len(views))]

    class Palms:
        def estimate(self, frame: object, person: Person, sides: list[str]) -> dict[str, ColorPalm]:
            sought.append(list(sides))
            x, z, nothing = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.zeros((21, 3))
            return {side: ColorPalm(z, x, 0.1, 0.9, nothing, nothing, 1.0, 0.8, 40.0) for side in sides}

    estimator = HandNormalEstimator(color=False)
    estimator.predictor, estimator.color_path = says, Palms()  # type: ignore[assignment]
    joints = skeleton(7) - [0.2, 0, 0]
    joints[[JOINT["left_wrist"], JOINT["right_wrist"]]] = [[0.1, 0.05, 2.4], [-0.1, 0.05, 2.4]]
    source = ["observed"] * N_JOINTS
    source[JOINT["left_wrist"]], source[JOINT["right_wrist"]] = wrists
    hands = estimator.estimate(frame_of(), replace(person(joints), source=tuple(source)))
    assert sought == asked and not words[0].any()
    assert len(words) == 1 + len(asked) and all(w.tolist() == [1.0] * len(asked[0]) for w in words[1:])
    for side, first in (("left", left), ("right", right)):
        again = any(side in sides for sides in asked)
        palm = hands[side]
        assert palm is not None and (palm.confidence > first + 0.05) == again


# -- what it reaches -----------------------------------------------------------------------------------------------


def test_bundled_recording(models: None) -> None:
    """Palms of people who were estimated from end to end."""
    from understudy.metrics import evaluate
    from understudy.people_file import FramePeople

    recording = recordings.open("sample")
    estimator = Estimator()
    found = [FramePeople(index, tuple(estimator.estimate(recording[i]))) for i, index in enumerate(recording.indices)]
    palms = evaluate(found, recording.truth).palms
    assert palms.n_truth > 30
    assert palms.coverage >= 0.9
    assert np.degrees(palms.mean_rad) <= 20 and np.degrees(palms.median_rad) <= 12
    assert palms.flipped <= 0.03


@pytest.fixture(scope="module")
def sure_hand(models: None) -> tuple[RegisteredFrame, Person, str]:
    """A hand of the bundled recording that is seen well."""
    recording = recordings.open("sample")
    estimator, hands = Estimator(hands="off"), HandNormalEstimator(color=False)
    every = []
    for index in recording.indices[:4]:
        frame = estimator.register(recording[index])
        for person in estimator.estimate(frame):
            every += [(p.confidence, frame, person, side) for side, p in hands.estimate(frame, person).items() if p]
    confidence, *hand = max(every, key=lambda each: each[0])
    assert confidence > 0.9
    return tuple(hand)


@pytest.mark.parametrize("before", [None, 0.08, 0.6])
def test_covered_hands_are_doubted(sure_hand, before: float | None) -> None:
    """A hole in the depth, or a board before the hand (metres, nearer or farther than the crop reaches): what is left
    is a guess from the posture, which knows that it is one.
    """
    frame, person, side = sure_hand
    wrist = person.keypoints[JOINT[f"{side}_wrist"]]
    camera = frame.depth.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    near = np.linalg.norm(np.stack([u, v], -1) - camera.project(wrist[None])[0], axis=-1) < 0.3 * camera.fx / wrist[2]
    z = np.where(near, 0.0 if before is None else wrist[2] - before, frame.depth.z).astype(np.float32)
    covered = replace(frame, depth=replace(frame.depth, z=z))
    estimator = HandNormalEstimator(color=False, least_confidence=0)
    seen, guess = (estimator.estimate(f, person)[side] for f in (frame, covered))
    assert guess.confidence < 0.6 < 0.9 < seen.confidence
    assert np.linalg.norm(guess.normal) == pytest.approx(1)
    assert np.isnan(guess.keypoints).all(axis=1).sum() > np.isnan(seen.keypoints).all(axis=1).sum()


def test_real_frame(freiburg: object, models: None) -> None:
    """The man in front holds a sheet of paper in his right hand, seen well: its palm faces the image's right."""
    recording = recordings.open(freiburg)
    people = Estimator().estimate(recording[0])
    near = min(people, key=lambda p: p.keypoints[JOINT["neck"], 2])
    sheet = near.hands["right"]
    assert sheet is not None and sheet.confidence > 0.9 and sheet.normal[0] > 0.8
    for p in people:
        for palm in p.hands.values():
            assert palm is None or np.linalg.norm(palm.normal) == pytest.approx(1)
