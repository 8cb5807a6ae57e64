"""The benchmark of palm normals: numbers by hand, groups, recordings with stand-ins for networks, page and plots."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from understudy.benchmark.palm_recordings import (
    from_recordings,
    papers_way,
    recording_methods,
    with_palms,
    without_depth,
)
from understudy.benchmark.palm_report import LEAST, PLOTS, group_table, in_bins, main_table, within, write_report
from understudy.benchmark.palm_simulation import SimulatedHands, from_simulation, least_sure
from understudy.benchmark.palms import (
    ALL_GIVEN,
    BOTH,
    DEPTH,
    LIFTED,
    PAPER,
    POSTURE,
    UNKNOWN,
    WORD,
    PalmCalibration,
    PalmScore,
    Said,
    Source,
    TrueHands,
    groups,
    score,
)
from understudy.camera import Camera, RGBDCamera
from understudy.detectors.blazepose_nets import Region
from understudy.errors import RecordingError, UnderstudyError
from understudy.hands.crop import CELLS, CONTEXT, EMPTY, GREY, PIXELS
from understudy.hands.nets import INDEX, PINKY, HandLandmarks, HandNets, load_nets
from understudy.recordings import FolderRecording, write_recording
from understudy.recordings import open as open_recording
from understudy.recordings.truth import Truth, TruthPerson
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import OBSERVED, Frame, Keypoints2D, Palm, Person, RegisteredDepth, RegisteredFrame

PNG = b"\x89PNG\r\n\x1a\n"
CAMERA = Camera.from_fov(320, 240, np.deg2rad(60))
NAN = float("nan")


def turned(degrees) -> np.ndarray:
    """Unit vectors so far from (0, 0, 1); NaN for NaN."""
    a = np.radians(np.asarray(degrees, float))
    return np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], -1)


def hands(n: int = 40, **columns) -> TrueHands:
    """Random hands with normals (0, 0, 1)."""
    rng = np.random.default_rng(0)
    made = TrueHands(
        recording=np.arange(n) % 2,
        normal=turned(np.zeros(n)),
        distance_m=rng.uniform(1, 6, n),
        pixels=rng.uniform(10, 60, n),
        facing=rng.uniform(-1, 1, n),
        visible=rng.uniform(0, 1, n),
        grip=np.arange(n) % 3,
    )
    return replace(made, **{k: np.asarray(v, float) for k, v in columns.items()})


def source(said: dict[str, Said] | None = None, of: TrueHands | None = None, simulated: bool = True, **more) -> Source:
    of = of or hands()
    rng = np.random.default_rng(1)
    n = len(of.normal)
    made = {m: Said(turned(rng.uniform(0, 180, n)), rng.uniform(0, 1, n)) for m in (BOTH, ALL_GIVEN, DEPTH, POSTURE)}
    names = () if simulated else ("first", "second")
    ms = {BOTH: (12.34, 45.67), DEPTH: (5.0, 6.0)}
    return Source("Made-up hands", "made-up", names, simulated, of, said or made, "Made up.", ms, **more)


# --- scores ---


def test_score_by_hand():
    errors = np.radians([10, 30, 50, 110, NAN])
    s = PalmScore.of(errors, np.full(5, NAN))
    assert (s.n, s.coverage, s.within_30_deg, s.flipped) == (5, 0.8, 0.5, 0.25)
    assert np.degrees(s.mean_rad) == pytest.approx(50)
    assert np.degrees(s.median_rad) == pytest.approx(40)
    assert math.isnan(s.calibration.error)


def test_nothing_given_has_no_numbers():
    s = PalmScore.of(np.full(3, NAN), np.full(3, NAN))
    assert (s.n, s.coverage) == (3, 0)
    assert all(math.isnan(x) for x in (s.mean_rad, s.median_rad, s.within_30_deg, s.flipped, s.calibration.error))


def test_calibration_by_hand():
    """Two hands at 0.9, one of them right; four at 0.25, one right; one without a normal counts nowhere."""
    errors = np.radians([5, 80, 5, 80, 80, 80, NAN])
    c = PalmCalibration.of(errors, np.array([0.9, 0.9, 0.25, 0.25, 0.25, 0.25, 0.5]))
    assert c.bin_count.tolist() == [0, 0, 4, 0, 0, 0, 0, 0, 0, 2]
    assert (c.bin_confidence[9], c.bin_share[9], c.bin_confidence[2], c.bin_share[2]) == (0.9, 0.5, 0.25, 0.25)
    assert c.error == pytest.approx((2 * 0.4 + 4 * 0) / 6)
    assert np.isnan(c.bin_share[5])


def test_confidence_of_one_is_in_the_last_bin():
    c = PalmCalibration.of(np.zeros(1), np.ones(1))
    assert c.bin_count[-1] == 1 and c.error == 0


def test_source_measures_the_angle_to_the_truth():
    made = source({DEPTH: Said(turned([0, 90, NAN]), np.array([0.5, 0.5, NAN]))}, hands(3))
    np.testing.assert_allclose(np.degrees(made.errors(DEPTH)), [0, 90, NAN], atol=1e-9)
    assert score(made, DEPTH, np.array([True, False, True])).coverage == 0.5


def test_least_sure():
    left = least_sure(Said(turned([0, 0]), np.array([0.4, 0.6])), 0.5)
    assert np.isnan(left.normal[0]).all() and np.isnan(left.confidence[0])
    assert left.confidence[1] == 0.6


# --- groups ---


@pytest.mark.parametrize("simulated", [True, False])
def test_every_hand_is_in_one_group_of_each_kind(simulated):
    unknown = np.where(np.arange(40) % 7 == 0, NAN, 2.5)
    made = source(of=hands(distance_m=unknown, facing=unknown / 5), simulated=simulated)
    kinds = groups(made)
    assert ("grip" in kinds) == simulated and ("recording" in kinds) != simulated
    for found in kinds.values():
        rows = np.stack([found.of == i for i in range(len(found.labels))])
        np.testing.assert_array_equal(rows.sum(0), 1)
    labels = np.array(kinds["distance"].labels)[kinds["distance"].of]
    np.testing.assert_array_equal(labels, np.where(np.isnan(unknown), UNKNOWN, "2 to 3 m"))


def test_limits_of_groups():
    of = hands(
        5, distance_m=[1.9, 2, 3.5, 4, 9], pixels=[19.9, 20, 30, 40, 99], facing=[-1, -0.5, 0, 0.49, 0.5],
        visible=[0.51, 0.5, 0.3, 0.2, 0.19],
    )  # fmt: skip
    kinds = groups(source(of=of))
    assert kinds["distance"].of.tolist() == [0, 1, 2, 3, 3]
    assert kinds["size"].of.tolist() == [0, 1, 2, 3, 3]
    assert kinds["view"].of.tolist() == [0, 1, 1, 1, 2]
    assert kinds["visibility"].of.tolist() == [0, 1, 1, 1, 2]
    assert [kinds["grip"].labels[i] for i in kinds["grip"].of] == ["free", "bar", "flat", "free", "bar"]
    seen = groups(source(of=hands(2, visible=[1, 0]), simulated=False))["visibility"]
    assert [seen.labels[i] for i in seen.of] == ["wrist seen", "wrist occluded"]


# --- recordings ---


def upright(x: float = 0.0, z: float = 2.5) -> np.ndarray:
    """Joints of a person, metres; small enough to be in view as a whole."""
    out = np.zeros((N_JOINTS, 3))
    out[:, 1] = np.linspace(-0.5, 0.5, N_JOINTS)
    for side, sign in (("left", 1), ("right", -1)):
        for name, y in (("shoulder", -0.4), ("elbow", -0.2), ("wrist", 0.0)):
            out[JOINT[f"{side}_{name}"]] = sign * 0.2, y, 0
    return out + (x, 0, z)


def true_person(x: float, number: int, **palms) -> TruthPerson:
    yes, occluded = np.ones(N_JOINTS, bool), np.zeros(N_JOINTS, bool)
    occluded[JOINT["left_wrist"]] = True
    in_view = {side: side in palms for side in ("left", "right")}
    return TruthPerson(number, upright(x), yes, occluded, {s: palms.get(s) for s in in_view}, in_view)


def estimated(x: float) -> Person:
    joints = upright(x) + 0.01
    keypoints = Keypoints2D.where(CAMERA.project(joints), np.full(N_JOINTS, 0.9))
    return Person(keypoints, joints, np.full(N_JOINTS, 0.9), np.full(N_JOINTS, 0.02), (OBSERVED,) * N_JOINTS)


TOWARDS = np.array([0.0, 0.0, -1.0])


def recorded(folder: Path, truth: Truth | None, n: int = 2) -> FolderRecording:
    depth = np.full((240, 320), 2.5, np.float32)
    color = np.full((240, 320, 3), 90, np.uint8)
    write_recording(folder, [Frame(color, depth, RGBDCamera.aligned(CAMERA), i) for i in range(n)], truth=truth)
    return open_recording(folder)


@pytest.fixture
def recording(tmp_path) -> FolderRecording:
    """Two frames: two people, of whom one will be missed; then one person with one palm."""
    first = (true_person(-0.6, 0, left=TOWARDS, right=TOWARDS), true_person(0.6, 1, right=TOWARDS))
    return recorded(tmp_path / "two", Truth({0: first, 1: (true_person(-0.6, 0, left=TOWARDS),)}))


def says(normal, confidence=0.8, sides=("left", "right")):
    return lambda frame, person: {s: Palm(np.asarray(normal, float), confidence) for s in sides}


METHODS = {ALL_GIVEN: says((0, 0, -1)), DEPTH: says((0, 0, 1), 0.3, ("right",)), PAPER: says((1, 0, 0), NAN)}


def test_from_recordings(recording):
    found = from_recordings([recording], METHODS, lambda _: lambda frame: [estimated(-0.6)], "made up", False)
    assert "3 people in 2 frames, 1 of them missed" in found.about and "made up" in found.about
    # the rows: left and right of the first person, right of the missed one, left of the second frame
    np.testing.assert_allclose(np.degrees(found.errors(ALL_GIVEN)), [0, 0, NAN, 0], atol=1e-6)
    np.testing.assert_allclose(np.degrees(found.errors(DEPTH)), [NAN, 180, NAN, NAN], atol=1e-6)
    np.testing.assert_allclose(np.degrees(found.errors(PAPER)), [90, 90, NAN, 90], atol=1e-6)
    np.testing.assert_array_equal(found.said[DEPTH].confidence, [NAN, 0.3, NAN, NAN])
    assert np.isnan(found.said[PAPER].confidence).all()
    np.testing.assert_array_equal(found.hands.visible, [0, 1, 1, 0])
    wrist = upright(-0.6)[JOINT["left_wrist"]]
    assert found.hands.distance_m[0] == pytest.approx(np.linalg.norm(wrist))
    assert found.hands.facing[0] == pytest.approx(-2.5 / np.linalg.norm(wrist))
    assert found.hands.pixels[0] == pytest.approx(0.19 * CAMERA.fx / 2.5)
    assert set(found.ms) == set(METHODS) and all(0 <= half <= most for half, most in found.ms.values())


def test_everybody_missed_has_rows_and_no_times(recording):
    found = from_recordings([recording], METHODS, lambda _: lambda frame: [], "made up", False)
    assert score(found, ALL_GIVEN).n == 4 and score(found, ALL_GIVEN).coverage == 0
    assert all(math.isnan(half) and math.isnan(most) for half, most in found.ms.values())


def test_broken_frame_counts_as_missed_and_is_named(recording):
    broken = next(p for p in recording.sources(0) if "depth" in str(p))
    broken.write_bytes(b"not an image")
    found = from_recordings([recording], METHODS, lambda _: lambda frame: [estimated(-0.6)], "made up", False)
    np.testing.assert_array_equal(np.isnan(found.errors(ALL_GIVEN)), [True, True, True, False])
    assert broken.name in found.about


def test_recording_without_truth(tmp_path):
    with pytest.raises(RecordingError, match=r"bare.truth\.json: no such file.*'sample'"):
        with_palms([recorded(tmp_path / "bare", None)])


def test_recording_without_palms(tmp_path):
    truth = Truth({0: (true_person(0, 0),)})
    with pytest.raises(RecordingError, match=r"truth\.json: no palm in view; .*'normal'.*'in_view'"):
        with_palms([recorded(tmp_path / "handless", truth)])


def test_without_depth():
    z = np.full((240, 320), 2.0, np.float32)
    frame = RegisteredFrame(np.zeros((240, 320, 3), np.uint8), CAMERA, RegisteredDepth(z, CAMERA))
    assert not without_depth(frame).depth.z.any() and frame.depth.z.all()


class OneHand(HandNets):
    """Stands for the colour path's networks: a right hand's back or a left palm, wherever it looks."""

    def __init__(self):
        self.regions: list[Region] = []

    def landmarks(self, crops, regions, mirrored=False):
        self.regions += regions
        world = np.zeros((21, 3))
        world[INDEX], world[PINKY] = (-0.03, -0.09, 0), (0.03, -0.09, 0)
        uv = np.tile(regions[0].center, (21, 1)).astype(float)
        return [HandLandmarks(uv, np.zeros(21), world, 0.0, 0.5)]


def test_the_papers_way_takes_one_crop_and_the_bodys_side():
    nets = OneHand()
    frame = RegisteredFrame(
        np.zeros((240, 320, 3), np.uint8), CAMERA, RegisteredDepth(np.zeros((240, 320), np.float32), CAMERA)
    )
    someone = estimated(0.0)
    palms_of = papers_way(nets)(frame, someone)
    assert len(nets.regions) == 2
    for region, (side, facing) in zip(nets.regions, (("left", -1), ("right", 1)), strict=True):
        ray = CAMERA.unproject(np.array(region.center), 1.0)
        assert float(palms_of[side].normal @ ray / np.linalg.norm(ray)) == pytest.approx(facing), side
        assert math.isnan(palms_of[side].confidence)


# --- simulated hands ---


def simulated_hands(n: int = 6) -> SimulatedHands:
    rng = np.random.default_rng(0)
    color = rng.normal(size=(n, 9)).astype(np.float32)
    color[:, :3], color[:, 7], color[:, 8] = turned(np.full(n, 20)), 0.7, np.arange(n) % 2
    color[color[:, 8] == 0] = 0
    depth = np.zeros((n, 2, CELLS, CELLS), np.float32)
    depth[:, 1] = 1
    context, distance = np.zeros((n, len(CONTEXT), 3), np.float32), np.full((n, 1), 2, np.float32)
    image = rng.integers(0, 256, (n, 3, PIXELS, PIXELS)).astype(np.uint8)
    return SimulatedHands(hands(n), depth, context, distance, np.full((n, 2), 0.05, np.float32), image, color)


def network(depth, context, distance, color, sigma, image):
    """Right with depth, 60 degrees off without; a confidence that colour raises."""
    n, seen = len(depth), depth[:, 1].any((1, 2))
    assert np.all(depth[~seen, 0] == EMPTY) and sigma.shape == (n, 2) and image.dtype == np.float32
    assert (image[color[:, 8] == 0] == GREY).all() or seen.all()  # posture alone has no image
    normal = np.where(seen[:, None], turned(np.zeros(n)), turned(np.full(n, 60)))
    sure = np.where(color[:, 8] > 0, 2.0, -4.0)
    return normal, normal, np.zeros((n, 21, 3)), sure


def test_from_simulation():
    found = from_simulation(simulated_hands(), network)
    cm = {m: score(found, m) for m in found.said}
    assert [cm[m].coverage for m in (BOTH, ALL_GIVEN, DEPTH, POSTURE, WORD)] == [0.5, 1, 0, 1, 0.5]
    assert np.degrees(cm[POSTURE].mean_rad) == pytest.approx(60, abs=1e-3)
    assert np.degrees(cm[WORD].mean_rad) == pytest.approx(20, abs=1e-3)
    assert np.nanmax(found.said[WORD].confidence) == pytest.approx(0.7)


def test_simulation_of_nothing():
    with pytest.raises(UnderstudyError, match="at least 1"):
        from_simulation(simulated_hands(0), network)


# --- page and plots ---


def test_within_counts_hands_without_a_normal():
    curve = within(np.radians([10.0, 90.0, NAN, 180.0]))
    assert curve[[0, 9, 10, 90, 179, 180]].tolist() == [0, 0, 0.25, 0.5, 0.5, 0.75]


def test_in_bins_wants_enough_hands():
    distance = np.r_[np.full(LEAST, 1.5), np.full(LEAST, 2.5), 0.5, 99.0]
    errors = np.r_[np.full(LEAST, 0.3), np.full(LEAST - 1, 0.6), NAN, 1.0, 1.0]
    found = in_bins(distance, errors, np.arange(4.0), lambda e: float(e.mean()))
    np.testing.assert_allclose(found, [NAN, 0.3, NAN])


def test_tables():
    made = source({DEPTH: Said(turned([10, 100, NAN, 10]), np.array([0.9, 0.9, NAN, 0.9]))}, hands(4))
    assert main_table(made).splitlines()[-1] == "| depth | 4 | 75.0 | 40.0 | 10.0 | 66.7 | 33.3 | 23.3 |"
    lines = group_table(made, DEPTH).splitlines()
    assert lines[2].startswith("| all | 4 |")
    assert any(line.startswith("| grip: bar | 1 | 100.0 | 100.0 | 100.0 | 0.0 | 100.0 |") for line in lines)
    assert UNKNOWN not in "".join(lines)


@pytest.mark.parametrize("simulated", [True, False])
def test_report(tmp_path, simulated):
    pytest.importorskip("matplotlib")
    more = source(simulated=simulated)
    paper = Said(turned(np.full(40, 50)), np.full(40, NAN))
    more = replace(more, said={**more.said, PAPER: paper})
    write_report(tmp_path, [more])
    page = (tmp_path / "README.md").read_text(encoding="utf-8")
    for method in more.said:
        assert f"| {method} |" in page and f"- `{method}`: " in page
    assert "60.3 degrees on 129 samples" in page and "| 12.3 | 45.7 |" in page and "SHA-256" in page
    for name in PLOTS:
        assert (tmp_path / f"made-up-{name}.png").read_bytes().startswith(PNG)
        assert f"(made-up-{name}.png)" in page
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["README.md", *(f"made-up-{n}.png" for n in PLOTS)])


def test_report_where_nothing_is_given(tmp_path):
    pytest.importorskip("matplotlib")
    nothing = Said(np.full((4, 3), NAN), np.full(4, NAN))
    write_report(tmp_path, [source({BOTH: nothing, ALL_GIVEN: nothing}, hands(4), simulated=False)])
    assert f"| {BOTH} | 4 | 0.0 | - | - | - | - | - |" in (tmp_path / "README.md").read_text(encoding="utf-8")


# --- the command ---


@pytest.fixture
def command(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[1] / "benchmarks"), *sys.path])
    import palms as script

    yield script
    sys.modules.pop("palms", None)


def test_command(command, monkeypatch, recording, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(command, "load_nets", lambda: None)
    monkeypatch.setattr(command, "recording_methods", lambda nets: METHODS)
    monkeypatch.setattr(command, "estimators", lambda detector: lambda _: lambda frame: [estimated(-0.6)])
    monkeypatch.setattr(command, "simulate", lambda n: simulated_hands(n))
    monkeypatch.setattr(command, "HandPredictor", lambda: type("Fake", (), {"network": staticmethod(network)}))
    command.main(["--out", str(tmp_path / "out"), "--recordings", str(recording.path), "--hands", "6"])
    printed = capsys.readouterr().out
    assert all(f"| {m} |" in printed for m in (*METHODS, WORD))
    assert len(list((tmp_path / "out").glob("*.png"))) == 2 * len(PLOTS)
    command.main(["--out", str(tmp_path / "less"), "--recordings", str(recording.path), "--hands", "0"])
    assert "imulated" not in capsys.readouterr().out
    assert len(list((tmp_path / "less").glob("*.png"))) == len(PLOTS)


def test_command_refuses(command, tmp_path):
    pytest.importorskip("matplotlib")
    with pytest.raises(UnderstudyError, match="--hands -1"):
        command.main(["--hands", "-1"])
    with pytest.raises(RecordingError, match="nowhere"):
        command.main(["--recordings", str(tmp_path / "nowhere")])
    assert not list(tmp_path.iterdir())


def test_real_methods_on_a_frame(models, tmp_path):
    """One frame of the sample: every method answers for somebody's hands, and those without a confidence say so."""
    recording = open_recording("sample")
    truth = Truth({0: recording.truth.frames[0]})

    write_recording(tmp_path / "one", [recording[0]], truth=truth)
    methods = recording_methods(load_nets())

    def people(frame):
        out = []
        for person in truth.frames[0]:
            keypoints = Keypoints2D.where(frame.camera.project(person.keypoints), np.full(N_JOINTS, 0.9))
            sure = np.full(N_JOINTS, 0.9)
            out.append(Person(keypoints, person.keypoints, sure, sure / 50, (OBSERVED,) * N_JOINTS))
        return out

    found = from_recordings([open_recording(tmp_path / "one")], methods, lambda _: people, "the truth", False)
    for method, said in found.said.items():
        given = np.isfinite(said.normal).all(1)
        assert given.any() and np.isfinite(said.confidence[given]).all() == (method not in (PAPER, LIFTED))
        np.testing.assert_allclose(np.linalg.norm(said.normal[given], axis=1), 1, atol=1e-5)
