"""Which format a path is; TUM sequences, pairs of images, Azure Kinect files, and the real data shared with us."""

import builtins
import json
import warnings
from contextlib import suppress
from fractions import Fraction

import cv2
import numpy as np
import pytest
from conftest import SHARED
from hypothesis import given
from hypothesis import strategies as st

from understudy import recordings
from understudy.camera import Camera, RGBDCamera
from understudy.errors import CameraError, FrameError, MissingExtraError, RecordingError, UnderstudyError
from understudy.recordings import k4a, k4a_calibration, registry
from understudy.recordings.pairing import pair_nearest
from understudy.registration import register
from understudy.types import Frame


def shared(name):
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"needs {path}: data that is handed to this project and is no part of it")
    return path


def images(folder, width=640, height=480, seed=0):
    """Writes color.png and depth.png; returns their arrays (RGB, raw)."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    depth = rng.integers(0, 9000, (height, width), dtype=np.uint16)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "color.png"), color[..., ::-1])
    cv2.imwrite(str(folder / "depth.png"), depth)
    return color, depth


# --- which format ---


def test_unknown_paths(tmp_path):
    with pytest.raises(RecordingError, match="nowhere: no such file or folder"):
        recordings.open(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"no such file or folder|not a path"):
        recordings.open("a\0b")
    (tmp_path / "notes.txt").write_text("")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(RecordingError, match="not a recording of a known format") as caught:
            recordings.open(path)
        for kind in recordings.FORMATS:
            assert f"{kind.format_name}: {kind.looks_for}" in str(caught.value)


def test_unknown_options_are_named(tmp_path):
    (tmp_path / "rgb.txt").write_text("")
    (tmp_path / "depth.txt").write_text("")
    with pytest.raises(
        RecordingError, match="TUM RGB-D sequence has no option 'k'; its options are K, distortion, unit_m"
    ):
        recordings.open(tmp_path, k=1)


def test_one_more_format_is_one_class_and_one_line(tmp_path, monkeypatch):
    class OneGreyFrame(recordings.Recording):
        format_name, looks_for = "grey frame", "a file named *.grey"

        def __init__(self, path):
            super().__init__(path, RGBDCamera.aligned(Camera.from_fov(4, 3, 1.0)), [5])

        @classmethod
        def recognizes(cls, path):
            return path.suffix == ".grey"

        def _read(self, position):
            return np.full((3, 4, 3), 128, np.uint8), np.ones((3, 4), np.float32)

    monkeypatch.setattr(registry, "FORMATS", (*registry.FORMATS, OneGreyFrame))
    (tmp_path / "a.grey").write_text("")
    (frame,) = recordings.open(tmp_path / "a.grey")
    assert frame.index == 5 and frame.timestamp_s is None


def test_sample_name(tmp_path, monkeypatch):
    path = recordings.sample_path()
    assert path.parts[-3:] == ("understudy", "samples", "room")
    if not (path / "recording.json").exists():
        pytest.skip("the sample is not rendered yet")
    assert len(recordings.open("sample")) > 0


# --- times ---


@given(
    st.lists(st.floats(0, 3), unique=True, max_size=30).map(sorted),
    st.lists(st.floats(0, 3), unique=True, max_size=30).map(sorted),
)
def test_pairs_are_near_and_used_once_and_none_is_left(a, b):
    a, b = np.array(a, dtype=float), np.array(b, dtype=float)
    pairs = pair_nearest(a, b, 0.05)
    i, j = [p[0] for p in pairs], [p[1] for p in pairs]
    assert len(set(i)) == len(i) == len(set(j)) and i == sorted(i)
    assert all(abs(a[p] - b[q]) <= 0.05 + 1e-12 for p, q in pairs)
    left_a, left_b = set(range(len(a))) - set(i), set(range(len(b))) - set(j)
    assert not any(abs(a[p] - b[q]) < 0.05 - 1e-12 for p in left_a for q in left_b)
    taken = {**{("a", p): abs(a[p] - b[q]) for p, q in pairs}, **{("b", q): abs(a[p] - b[q]) for p, q in pairs}}
    for p in range(len(a)):  # stable: no two that would both rather have each other
        for q in range(len(b)):
            if abs(a[p] - b[q]) < 0.05 - 1e-12:
                assert abs(a[p] - b[q]) >= min(taken.get(("a", p), 9), taken.get(("b", q), 9)) - 1e-12


# --- TUM ---


def tum_folder(path, color_s, depth_s, size=(640, 480)):
    images(path, *size)
    lines = [f"{t:.6f} color.png\n" for t in color_s]
    (path / "rgb.txt").write_text("# color images\n# file: 'x.bag'\n# timestamp filename\n" + "".join(lines))
    (path / "depth.txt").write_text("# depth maps\n\n" + "".join(f"{t:.6f} depth.png\n" for t in depth_s))
    return path


def test_tum_pairs_nearest_times_and_counts_the_rest(tmp_path):
    path = tum_folder(
        tmp_path / "rgbd_dataset_freiburg3_walking", [10.00, 10.033, 10.066, 10.2], [9.99, 10.034, 10.045, 10.5]
    )
    with pytest.warns(UserWarning, match="left out for want of a partner within 0.02 s: 2 colour and 2 depth"):
        r = recordings.open(path)
    assert r.timestamps_s == (10.00, 10.033) and (r.unmatched_color, r.unmatched_depth) == (2, 2)
    assert r.indices == (0, 1) and r.fps == pytest.approx(1 / 0.033)


@pytest.mark.parametrize(
    ("name", "fx", "k1"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.3, 0.2624),
        ("freiburg2_xyz", 520.9, 0.2312),
        ("my-fr3-office", 535.4, None),
        ("rgbd_dataset_freiburg3_sitting", 535.4, None),
    ],
)
def test_tum_cameras_by_name(tmp_path, name, fx, k1):
    color, raw = images(tmp_path / name)
    r = recordings.open(tum_folder(tmp_path / name, [1.0], [1.01]))
    assert r.camera.registered and r.camera.color.fx == fx
    assert r.camera.color.distortion[:1] == (() if k1 is None else (k1,))
    np.testing.assert_array_equal(r[0].color, color)
    np.testing.assert_allclose(r[0].depth, raw / 5000, rtol=1e-6)


def test_tum_camera_given_or_guessed(tmp_path):
    path = tum_folder(tmp_path / "office", [1.0], [1.0])
    with pytest.warns(UserWarning, match="name says none of freiburg1, freiburg2, freiburg3"):
        assert recordings.open(path).camera.color.fx == 525
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        r = recordings.open(path, K=[500, 501, 320, 240], distortion=[0.1, 0, 0, 0, 0], unit_m=0.001)
    assert (r.camera.color.fx, r.camera.color.fy, r.camera.color.distortion_model) == (500, 501, "brown_conrady")
    assert r[0].depth.max() > 8
    with pytest.raises(CameraError, match="option K: K must be 4 numbers"):
        recordings.open(path, K=[500, 501])
    with pytest.raises(RecordingError, match="'distortion' goes with option 'K'"):
        recordings.open(path, distortion=[0.1, 0, 0, 0])
    small = tum_folder(tmp_path / "freiburg1_small", [1.0], [1.0], size=(64, 48))
    with pytest.raises(RecordingError, match="images of 64 x 48 need the option K"):
        recordings.open(small)


def test_tum_errors(tmp_path):
    path = tum_folder(tmp_path / "freiburg1", [1.0, 2.0], [5.0])
    with pytest.raises(RecordingError, match=r"freiburg1: no frames: no entry of rgb.txt is within 0.02 s"):
        recordings.open(path)
    (path / "depth.txt").write_text("1.0 depth.png\noops\n")
    with pytest.raises(RecordingError, match=r"depth.txt: line 2: must be 'timestamp filename', got 'oops'"):
        recordings.open(path)
    (path / "depth.txt").write_text("1.0 depth.png\n1.0 b.png\n")
    with pytest.raises(RecordingError, match=r"depth.txt: timestamp 1.0+ is there twice"):
        recordings.open(path)
    (path / "depth.txt").write_text("1.0 gone.png\n2.0 depth.png\n3.0 depth.png\n")
    with pytest.warns(UserWarning, match="0 colour and 1 depth images"):
        r = recordings.open(path)
    with pytest.raises(FrameError, match=r"gone\.png: no such file"):
        r[0]
    assert r[1].timestamp_s == 2.0
    (path / "rgb.txt").write_text("1.0 gone.png\n2.0 gone.png\n3.0 gone.png\n")
    with pytest.raises(RecordingError, match=r"none of the images of rgb\.txt can be read"):
        recordings.open(path)


# --- a pair ---


def test_pair(tmp_path):
    color, raw = images(tmp_path, 40, 30)
    paths = tmp_path / "color.png", tmp_path / "depth.png"
    r = recordings.open_pair(*paths, K=[50, 51, 20, 15])
    (f,) = r
    np.testing.assert_array_equal(f.color, color)
    np.testing.assert_allclose(f.depth, raw * 0.001, rtol=1e-6)
    assert r.camera.registered and r.camera.color.fy == 51 and len(r) == 1 and f.timestamp_s is None

    T = np.eye(4)
    T[0, 3] = -0.05
    r = recordings.open_pair(
        *paths, K=np.diag([50, 50, 1.0]), unit_m=0.0002, distortion=(0.1, 0, 0, 0), registered=False,
        depth_K=(40, 40, 20, 15), depth_distortion=[0.0] * 8, T_color_depth=T.tolist(),
    )  # fmt: skip
    assert not r.camera.registered and r.camera.T_color_depth[0, 3] == -0.05
    assert (r.camera.color.distortion_model, r.camera.depth.distortion_model) == ("brown_conrady", "rational")
    assert r[0].depth.max() < 1.8


def test_pair_of_registered_depth_at_another_size(tmp_path):
    images(tmp_path / "a", 40, 30)
    images(tmp_path / "b", 80, 60)
    r = recordings.open_pair(tmp_path / "a" / "color.png", tmp_path / "b" / "depth.png", K=[50, 50, 19.5, 14.5])
    assert r.camera.depth.fx == 100 and r.camera.depth.cx == 39.5 and r[0].depth.shape == (60, 80)
    images(tmp_path / "c", 80, 30)
    with pytest.raises(CameraError, match="scaled uniformly"):
        recordings.open_pair(tmp_path / "a" / "color.png", tmp_path / "c" / "depth.png", K=[50, 50, 19.5, 14.5])


def test_pair_errors(tmp_path):
    images(tmp_path, 40, 30)
    color, depth = tmp_path / "color.png", tmp_path / "depth.png"
    K = [50, 50, 20, 15]
    good = {"color": color, "depth": depth, "K": K}
    apart = {"registered": False, "depth_K": K}
    for changes, words in (
        ({"depth": tmp_path / "no.png"}, r"no\.png: no such file"),
        ({"color": tmp_path}, "is a folder, not an image"),
        ({"K": [1, 2, 3]}, r"K: K must be 4 numbers \(fx fy cx cy\) or 3x3, got shape"),
        ({"K": [0, 1, 2, 3]}, "K: K: focal lengths must be positive"),
        ({"distortion": [1, 2]}, "K: distortion must have 0"),
        ({"unit_m": 0.0}, "unit_m must be metres per depth value"),
        ({"registered": False}, "needs depth_K and T_color_depth"),
        ({"T_color_depth": np.eye(4)}, "goes with depth that is not registered"),
        ({**apart, "T_color_depth": np.eye(3)}, "T_color_depth must be a 4x4 rigid transform, got shape"),
    ):
        with pytest.raises(UnderstudyError, match=words):
            recordings.open_pair(**(good | changes))
    r = recordings.open_pair(depth, color, K=K)  # the wrong way round is seen when the frame is read
    with pytest.raises(FrameError, match=r"depth\.png: colour must be three channels of 8 bits"):
        r[0]


# --- Azure Kinect ---


def calibration(**changes):
    """A calibration with round numbers; depth and colour camera alike, colour 32 mm to the right."""

    def one(place, width, height, translation):
        parameters = [0.5, 0.51, 0.49, 0.49 * width / height, 0.3, -0.2, 0.1, 0.25, -0.15, 0.05, 0, 0, 2e-4, 1e-4]
        return {
            "Intrinsics": {"ModelType": "CALIBRATION_LensDistortionModelBrownConrady", "ModelParameters": parameters},
            "Location": f"CALIBRATION_CameraLocation{place}",
            "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": translation},
        } | changes

    cameras = [one("D0", 1024, 1024, [0, 0, 0]), one("PV0", 4096, 3072, [-0.032, 0, 0])]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode()


def kinect_file(path, color_us, depth_us, attach=None, depth_size=(320, 288)):
    """A Kinect-like .mkv: MJPG colour whose red is the image's number, big-endian depth with its number in it."""
    av = pytest.importorskip("av", reason="Azure Kinect files need the extra 'kinect'")
    with av.open(str(path), "w", format="matroska", options={"allow_raw_vfw": "1"}) as out:
        tracks = {}
        for name, codec, size, layout in (
            ("COLOR", "mjpeg", (1280, 720), "yuvj422p"),
            ("DEPTH", "rawvideo", depth_size, "gray16be"),
        ):
            stream = out.add_stream(codec, rate=30)
            stream.width, stream.height = size
            stream.pix_fmt = layout
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1_000_000)
            stream.metadata["title"] = name
            tracks[name] = stream
        out.add_attachment("calibration.json", "application/octet-stream", attach or calibration())
        out.start_encoding()
        events = [(t, "COLOR", i) for i, t in enumerate(color_us)] + [(t, "DEPTH", i) for i, t in enumerate(depth_us)]
        for t, name, i in sorted(events):
            if name == "COLOR":
                image = np.full((720, 1280, 3), 30, np.uint8)
                image[..., 2] = 10 * i  # BGR
                data = cv2.imencode(".jpg", image)[1].tobytes()
            else:
                raw = np.arange(depth_size[0] * depth_size[1], dtype=np.uint16).reshape(depth_size[1], depth_size[0])
                raw[0, 0] = i
                data = raw.astype(">u2").tobytes()
            packet = av.Packet(data)
            packet.stream, packet.time_base = tracks[name], Fraction(1, 1_000_000)
            packet.pts = packet.dts = t
            packet.is_keyframe = True
            out.mux(packet)
    return path


def kinect_frame_numbers(frame):
    """(number of the colour image, number of the depth image) as `kinect_file` wrote them."""
    return round(frame.color[..., 0].mean() / 10), round(float(frame.depth[0, 0]) * 1000)


@pytest.fixture(scope="module")
def kinect(tmp_path_factory):
    """14 colour images; the depth images 2 and 5 are missing, the others come 0.3 ms after colour."""
    color_us = [40_000 + 33_333 * i for i in range(14)]
    depth_us = [t + 300 for i, t in enumerate(color_us) if i not in (2, 5)]
    path = tmp_path_factory.mktemp("kinect") / "recording.mkv"
    return kinect_file(path, color_us, depth_us)


def test_kinect_frames_in_any_order(kinect):
    with recordings.open(kinect) as r:
        assert isinstance(r, k4a.KinectRecording) and len(r) == 12
        assert (r.unmatched_color, r.unmatched_depth) == (2, 0)
        assert r.fps == 30
        colors = [i for i in range(14) if i not in (2, 5)]
        np.testing.assert_allclose(r.timestamps_s, [0.04 + 0.033333 * i for i in colors], atol=1e-3)
        expected = list(zip(colors, range(12), strict=True))
        assert [kinect_frame_numbers(f) for f in r] == expected
        for i in (11, 0, 5, 4, 6, 7, 7, 1, 11):
            assert kinect_frame_numbers(r[i]) == expected[i]
        assert [kinect_frame_numbers(f) for f in r] == expected
        depth = r[3].depth.ravel()
        np.testing.assert_array_equal(depth[1:], (np.arange(1, depth.size, dtype=np.uint16) * np.float32(0.001)))
        assert r[0].color.shape == (720, 1280, 3) and r[0].depth.shape == (288, 320)


def test_kinect_calibration_of_every_mode():
    """The modes' cameras see the same rays: binning and scaling as `resize`, cutting as `crop` of the full sensor."""
    full = k4a_calibration.camera_from_calibration(calibration(), (4096, 3072), (1024, 1024), "here")
    assert full.depth.cx == 0.5 * 1024 - 0.5 and full.depth.fx == pytest.approx(0.49 * 1024)
    assert full.color.fx == pytest.approx(0.49 * 4096) == pytest.approx(full.color.fy)
    assert full.color.distortion == (0.3, -0.2, 1e-4, 2e-4, 0.1, 0.25, -0.15, 0.05)
    np.testing.assert_allclose(full.T_color_depth[:3, 3], [-0.032, 0, 0])
    for name, mode in k4a_calibration.DEPTH_MODES.items():
        got = k4a_calibration.camera_from_calibration(calibration(), (4096, 3072), mode.size, "here").depth
        expected = full.depth if name.startswith("WFOV") else full.depth.crop(192, 180, 640, 576)
        np.testing.assert_allclose(got.K, expected.resize(*mode.size).K, rtol=1e-12, err_msg=name)
    for name, mode in k4a_calibration.COLOR_MODES.items():
        got = k4a_calibration.camera_from_calibration(calibration(), mode.size, (1024, 1024), "here").color
        wide = mode.size[0] / mode.size[1] > 1.5
        expected = full.color.crop(0, 384, 4096, 2304) if wide else full.color
        np.testing.assert_allclose(got.K, expected.resize(*mode.size).K, rtol=1e-12, err_msg=name)


def test_kinect_calibration_errors():
    def load(content, color=(1280, 720), depth=(640, 576)):
        return k4a_calibration.camera_from_calibration(content, color, depth, "a.mkv")

    with pytest.raises(RecordingError, match=r"a.mkv: colour images of 640 x 480 .* '720P \(1280 x 720\)'"):
        load(calibration(), (640, 480))
    with pytest.raises(RecordingError, match=r"a\.mkv: depth images of 1 x 1"):
        load(calibration(), depth=(1, 1))
    bad_lens = calibration(Intrinsics={"ModelType": "Theta", "ModelParameters": [0.0] * 14})
    with pytest.raises(RecordingError, match="lens model 'Theta' is not supported"):
        load(bad_lens)
    for content in (b"", b"{", b"{}", b"[]", calibration(Rt={"Rotation": [2] * 9, "Translation": [0, 0, 0]})):
        with pytest.raises(RecordingError, match=r"a\.mkv: the calibration in the file cannot be read"):
            load(content)


def test_kinect_files_that_are_broken(kinect, tmp_path, capfd):
    whole = kinect.read_bytes()
    path = tmp_path / "cut.mkv"
    for n in (0, 3, 100, 1000):
        path.write_bytes(whole[:n])
        with pytest.raises(RecordingError, match=r"cut\.mkv"):
            recordings.open(path)
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with recordings.open(path) as r:
        errors = []
        good = list(r.frames(on_error=lambda i, e: errors.append(e)))
        assert 6 <= len(good) < 12 and len(errors) <= 1
    rng = np.random.default_rng(0)
    for _ in range(15):
        damaged = bytearray(whole)
        for at in rng.integers(0, min(len(whole), 200_000), 20):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        with suppress(UnderstudyError), recordings.open(path) as r:
            list(r.frames(on_error=lambda *_: None))


def test_kinect_without_partners_or_tracks(tmp_path):
    path = kinect_file(tmp_path / "apart.mkv", [0, 33_000, 66_000], [500_000])
    with pytest.raises(RecordingError, match=r"apart.mkv: no frames: 3 colour and 1 depth images"):
        recordings.open(path)
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "film.mkv"), "w") as out:
        stream = out.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        out.mux(stream.encode(av.VideoFrame(64, 48, "yuvj420p")))
    with pytest.raises(RecordingError, match=r"film.mkv: has no track COLOR"):
        recordings.open(tmp_path / "film.mkv")


def test_kinect_needs_its_extra(tmp_path, monkeypatch):
    real = builtins.__import__

    def without_av(name, *rest):
        if name == "av":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_av)
    (tmp_path / "a.mkv").write_bytes(b"")
    with pytest.raises(MissingExtraError, match=r"Azure Kinect .mkv files: .* pip install 'understudy\[kinect\]'"):
        recordings.open(tmp_path / "a.mkv")


# --- real data ---


def test_real_kinect_recording():
    """The mug's handle is thin: near depth lands on it only if the whole calibration is read right."""
    pytest.importorskip("av", reason="Azure Kinect files need the extra 'kinect'")
    with recordings.open(shared("k4a_recording") / "recording.mkv") as r:
        assert r.indices == (0,) and r.timestamps_s == pytest.approx((0.463945,))
        (f,) = r
    np.testing.assert_allclose(
        r.camera.depth.K[:2, 2], [0.51296979 * 1024 - 192.5, 0.51692355 * 1024 - 180.5], atol=1e-4
    )
    assert np.degrees(np.arccos((np.trace(r.camera.T_color_depth[:3, :3]) - 1) / 2)) == pytest.approx(4.94, abs=0.02)
    np.testing.assert_allclose(f.depth * 1000, np.rint(f.depth * 1000), atol=1e-3)
    z = register(f).depth.z

    def near(u, v):
        patch = z[v - 4 : v + 5, u - 4 : u + 5]
        return np.median(patch[patch > 0])

    for u, v in (
        (572, 460),
        (572, 490),
        (520, 565),
        (470, 560),
        (300, 640),
    ):  # handle (thrice), mug (twice), in the colour image
        assert near(u, v) < 0.35, (u, v)
    for u, v in ((850, 250), (585, 420), (420, 340)):  # window, sign behind the handle, wall above the mug
        assert near(u, v) > 0.6, (u, v)


def test_real_freiburg_frame():
    """Registered depth of twice the colour image's size; the people stand where the data's notes say."""
    r = recordings.open(shared("freiburg_frame"))
    f = r[0]
    assert r.camera.registered and r.timestamps_s is None and r.fps is None
    assert f.color.shape == (540, 960, 3) and f.depth.shape == (1080, 1920)
    registered = register(f)
    assert registered.depth.z is f.depth and registered.depth.scale_to(r.camera.color) == 2
    z = f.depth[f.depth > 0]
    assert 0.08 < z.size / f.depth.size < 0.12
    for person_z in (3.68, 3.61, 4.29, 2.59):
        assert (np.abs(z - person_z) < 0.15).sum() > 1000
    assert isinstance(f, Frame)
