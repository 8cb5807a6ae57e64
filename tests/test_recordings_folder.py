"""The recording folder: written and read back, every error named, nothing read before it is asked for."""

import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from understudy import recordings
from understudy.camera import Camera, RGBDCamera
from understudy.errors import FrameError, RecordingError, UnderstudyError
from understudy.geometry import rigid
from understudy.recordings import FolderRecording, FolderWriter, Truth, TruthPerson, write_recording
from understudy.types import Frame, Keypoints2D

LENSES = {
    "none": (),
    "brown_conrady": (0.1, -0.2, 0.001, -0.002, 0.05),
    "rational": (0.33, -2.49, -1e-4, -2e-4, 1.45, 0.21, -2.3, 1.38),
}
slow_ok = settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])


def camera(width=24, height=18, depth=(20, 14), lens="none"):
    def one(w, h):
        K = np.array([[w * 0.9, 0, (w - 1) / 2], [0, w * 0.91, (h - 1) / 2], [0, 0, 1.0]])
        return Camera(w, h, K, lens, LENSES[lens])

    R = cv2.Rodrigues(np.array([0.02, -0.01, 0.03]))[0]
    return RGBDCamera(one(width, height), one(*depth), rigid(R, np.array([-0.03, 0.002, 0.004])))


def frame(cam, index=0, timestamp_s=None, seed=0):
    rng = np.random.default_rng((seed, index))
    color = rng.integers(0, 256, (cam.color.height, cam.color.width, 3), dtype=np.uint8)
    depth = rng.uniform(0.3, 6.0, (cam.depth.height, cam.depth.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    return Frame(color, depth, cam, index, timestamp_s)


@pytest.fixture
def folder(tmp_path):
    """Three frames, numbers 0, 1, 4, with times."""
    cam = camera()
    frames = [frame(cam, i, t) for i, t in ((0, 0.0), (1, 0.1), (4, 0.4))]
    return write_recording(tmp_path / "rec", frames, fps=10.0, color_format="png")


def edit(folder, change):
    path = folder / "recording.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


# --- written and read back ---


@slow_ok
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 30)),
    depth_size=st.tuples(st.integers(1, 40), st.integers(1, 30)),
    lens=st.sampled_from(sorted(LENSES)),
    unit_m=st.sampled_from([0.001, 0.0002, 0.00025, 0.01]),
    indices=st.sets(st.integers(0, 2000), min_size=1, max_size=4),
    timed=st.booleans(),
    fps=st.sampled_from([None, 10.0, 29.97]),
    color_format=st.sampled_from(["png", "jpg"]),
)
def test_round_trip(tmp_path, size, depth_size, lens, unit_m, indices, timed, fps, color_format):
    shutil.rmtree(tmp_path / "rec", ignore_errors=True)
    cam = camera(*size, depth_size, lens)
    written = [frame(cam, i, 1000.0 + i / 7 if timed else None) for i in sorted(indices)]
    path = write_recording(tmp_path / "rec", written, fps=fps, unit_m=unit_m, color_format=color_format)
    read = recordings.open(path)

    assert isinstance(read, FolderRecording) and read.name == "rec"
    assert read.indices == tuple(sorted(indices)) and read.fps == fps and len(read) == len(indices)
    for name in ("color", "depth"):
        a, b = getattr(read.camera, name), getattr(cam, name)
        assert a.to_json() == b.to_json()
    np.testing.assert_array_equal(read.camera.T_color_depth, cam.T_color_depth)
    assert (read.timestamps_s is None) == (not timed and fps is None)
    for before, after in zip(written, read, strict=True):
        assert after.index == before.index
        if color_format == "png":
            np.testing.assert_array_equal(after.color, before.color)
        assert np.abs(after.depth.astype(np.float64) - before.depth).max() <= unit_m / 2 + 1e-6
        np.testing.assert_array_equal(after.depth == 0, before.depth < unit_m / 2)
        if timed:
            assert after.timestamp_s == before.timestamp_s
        else:
            assert after.timestamp_s == (None if fps is None else after.index / fps)
    assert read.truth is None and read.keypoints2d is None


def test_jpeg_colour_is_rgb_and_close(tmp_path):
    cam = RGBDCamera.aligned(Camera.from_fov(64, 48, 1.0))
    color = np.zeros((48, 64, 3), np.uint8)
    color[..., 0], color[..., 2] = 200, np.linspace(0, 90, 64).astype(np.uint8)
    path = write_recording(tmp_path / "rec", [Frame(color, np.ones((48, 64), np.float32), cam)])
    back = recordings.open(path)[0]
    assert (path / "color" / "000000.jpg").exists()
    assert np.abs(back.color.astype(int) - color).max() <= 6
    assert back.camera.registered


def test_depth_that_does_not_fit_is_refused_and_all_zero_is_fine(tmp_path):
    cam = camera()
    far = Frame(frame(cam).color, np.full((14, 20), 70.0, np.float32), cam)
    with pytest.raises(RecordingError, match=r"70.000 m does not fit 16 bits at unit_m = 0.001 \(largest: 65.535 m\)"):
        write_recording(tmp_path / "far", [far])
    empty = Frame(frame(cam).color, np.zeros((14, 20), np.float32), cam)
    assert not recordings.open(write_recording(tmp_path / "empty", [empty]))[0].depth.any()


def test_interrupted_writing_never_looks_complete(tmp_path):
    cam = camera()

    def frames():
        yield frame(cam)
        raise RuntimeError("power cut")

    with FolderWriter(tmp_path / "other", cam) as writer:
        writer.write(frame(cam))
        assert not (tmp_path / "other" / "recording.json").exists()
    assert (tmp_path / "other" / "recording.json").exists()
    with pytest.raises(RuntimeError, match="power cut"):
        write_recording(tmp_path / "rec", frames())
    assert (tmp_path / "rec" / "depth" / "000000.png").exists()
    assert not (tmp_path / "rec" / "recording.json").exists()
    with pytest.raises(RecordingError, match=r"recording.json: no such file .*interrupted"):
        recordings.open(tmp_path / "rec")


def test_a_folder_that_is_not_empty_is_kept_unless_told(folder):
    cam = camera()
    with pytest.raises(RecordingError, match="rec: the folder is not empty"):
        FolderWriter(folder, cam)
    assert len(recordings.open(folder)) == 3
    (folder / "notes.txt").write_text("mine")
    write_recording(folder, [frame(cam, 9)], overwrite=True)
    assert recordings.open(folder).indices == (9,)
    assert (folder / "notes.txt").read_text() == "mine"
    (folder.parent / "file").write_text("")
    with pytest.raises(RecordingError, match="file: is a file, not a folder"):
        FolderWriter(folder.parent / "file", cam)


def test_writer_refuses_what_does_not_fit(tmp_path):
    cam = camera()
    writer = FolderWriter(tmp_path / "a", cam)
    with pytest.raises(RecordingError, match="at least one frame"):
        writer.close()
    writer.write(frame(cam, 3, 1.0))
    with pytest.raises(RecordingError, match="frame number 3 is negative or was written before"):
        writer.write(frame(cam, 3, 2.0))
    with pytest.raises(RecordingError, match="frame 4: either all frames have a timestamp or none"):
        writer.write(frame(cam, 4))
    with pytest.raises(RecordingError, match="frame 4 has another camera"):
        writer.write(frame(camera(10, 10), 4, 2.0))
    writer.write(frame(cam, 2, 2.0))
    with pytest.raises(RecordingError, match="timestamp_s must ascend"):
        writer.close()
    with pytest.raises(RecordingError, match="color_format 'bmp': must be one of 'jpg', 'png'"):
        FolderWriter(tmp_path / "b", cam, color_format="bmp")
    with pytest.raises(RecordingError, match="unit_m"):
        FolderWriter(tmp_path / "b", cam, unit_m=0.0)
    with pytest.raises(RecordingError, match="at least one frame"):
        write_recording(tmp_path / "b", [])


# --- as a sequence ---


def test_sequence_protocol(folder):
    with recordings.open(folder) as r:
        assert [f.index for f in r] == [0, 1, 4] == [f.index for f in r.frames()]
        assert r[-1].index == 4 and r[np.int64(1)].index == 1 and r.frame(4).index == 4
        assert r.timestamps_s == (0.0, 0.1, 0.4) and r.frame(4).timestamp_s == 0.4
        for beyond in (3, -4):
            with pytest.raises(IndexError, match="3 frames"):
                r[beyond]
        with pytest.raises(RecordingError, match=r"there is no frame 2; the frames are 0 \.\.\. 4"):
            r.frame(2)
        assert "3 frames" in repr(r)


def test_opening_reads_no_image(folder, monkeypatch):
    opened = []
    read_bytes = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: opened.append(self.name) or read_bytes(self))
    r = recordings.open(folder)
    frames = iter(r)
    assert opened == ["recording.json"]
    next(frames)
    assert opened == ["recording.json", "000000.png", "000000.png"]


def test_broken_frames_are_reported_and_left_out(folder):
    (folder / "depth" / "000001.png").unlink()
    r = recordings.open(folder)
    assert r.indices == (0, 1, 4)
    errors = []
    assert [f.index for f in r.frames(on_error=lambda i, e: errors.append((i, str(e))))] == [0, 4]
    assert errors[0][0] == 1 and "depth: frame 1 has no image here" in errors[0][1] and len(errors) == 1
    with pytest.raises(FrameError):
        list(r)


# --- errors of the whole ---


def drop(*keys):
    def change(data):
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]

    return change


def put(value, *keys):
    def change(data):
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


WHOLE = {
    "format missing": (drop("format"), "field 'format' must be 'rgbd-recording/1', got None"),
    "format wrong": (put("rgbd-recording/2", "format"), "field 'format' must be .* got 'rgbd-recording/2'"),
    "color missing": (drop("color"), "field 'color' is missing"),
    "depth missing": (drop("depth"), "field 'depth' is missing"),
    "K missing": (drop("color", "K"), "color: field 'K' is missing"),
    "K of depth missing": (drop("depth", "K"), "depth: field 'K' is missing"),
    "zero focal length": (put(0, "color", "K", 0, 0), "color: K: focal lengths must be positive, got fx = 0"),
    "K ragged": (put([[1, 2], [3]], "depth", "K"), "depth: "),
    "width a float": (put(2.5, "color", "width"), "color: width must be a whole number"),
    "lens unknown": (put("fisheye", "color", "distortion_model"), "color: distortion_model 'fisheye': must be one of"),
    "coefficients": (put([0.1], "color", "distortion"), "color: distortion: none needs 0 finite coefficients"),
    "unit missing": (drop("depth", "unit_m"), "depth: 'unit_m' must be metres .* got None"),
    "unit zero": (put(0, "depth", "unit_m"), "depth: 'unit_m' must be .* got 0"),
    "unit negative": (put(-0.001, "depth", "unit_m"), "depth: 'unit_m' must be .* got -0.001"),
    "registered a word": (put("yes", "depth", "registered"), "depth: 'registered' must be true or false"),
    "registered but not": (put(True, "depth", "registered"), "depth.registered is true, so depth's K must be color's"),
    "T missing": (drop("T_color_depth"), "field 'T_color_depth' is missing"),
    "T not rigid": (put(2, "T_color_depth", 0, 0), "T_color_depth must be a 4x4 rigid transform"),
    "T 3x4": (lambda d: d["T_color_depth"].pop(), "T_color_depth must be a 4x4"),
    "T ragged": (lambda d: d["T_color_depth"][0].pop(), "T_color_depth"),
    "T words": (put("a", "T_color_depth", 0, 0), "T_color_depth"),
    "times too few": (put([0, 1], "timestamps_s"), "field 'timestamps_s' must have one number per frame: 2 numbers, 3"),
    "times descend": (
        put([0, 2, 1], "timestamps_s"),
        r"'timestamps_s' must ascend: entry 2 \(1\) is not after entry 1",
    ),
    "times equal": (put([0, 1, 1], "timestamps_s"), "'timestamps_s' must ascend"),
    "times words": (put([0, 1, "2"], "timestamps_s"), "'timestamps_s' must be a list of numbers"),
    "times a number": (put(5, "timestamps_s"), "'timestamps_s' must be a list of numbers"),
    "fps zero": (put(0, "fps"), "field 'fps' must be a number above 0, got 0"),
    "fps a word": (put("30", "fps"), "field 'fps' must be a number above 0, got '30'"),
}


@pytest.mark.parametrize("case", WHOLE)
def test_errors_name_file_and_field(folder, case):
    change, words = WHOLE[case]
    edit(folder, change)
    with pytest.raises(UnderstudyError, match=rf"recording\.json: .*{words}|recording\.json: {words}"):
        recordings.open(folder)


def test_json_that_is_none(folder):
    info = folder / "recording.json"
    for content, words in (
        ("{", "not readable as JSON"),
        ("[]", "must hold a JSON object"),
        ('{"format": NaN}', "NaN is not JSON"),
        ("[" * 100_000, "not readable as JSON"),
        ('{"fps": ' + "9" * 5000 + "}", "5000 digits"),
    ):
        info.write_text(content)
        with pytest.raises(RecordingError, match=rf"recording\.json: .*{words}"):
            recordings.open(folder)


def test_missing_times_and_fps(folder):
    edit(folder, drop("timestamps_s"))
    r = recordings.open(folder)
    assert r.timestamps_s == (0.0, 0.1, 0.4) and r.fps == 10.0
    edit(folder, drop("fps"))
    r = recordings.open(folder)
    assert r.timestamps_s is None and r.fps is None and r[0].timestamp_s is None


def test_folders_without_images(folder):
    for name in ("color", "depth"):
        shutil.rmtree(folder / name)
        with pytest.raises(RecordingError, match=f"{name}: no such folder"):
            recordings.open(folder)
        (folder / name).mkdir()
    (folder / "color" / "picture.bmp").write_text("")
    with pytest.raises(RecordingError, match=r"rec: no frames: .* named like 000000.jpg"):
        recordings.open(folder)


# --- errors of one frame ---


def png(array):
    return cv2.imencode(".png", array)[1].tobytes()


def chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def flip(data, at):
    return data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]


def noise(*shape, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, 255, shape).astype(dtype)


COLOR_PNG, DEPTH_PNG = png(noise(18, 24, 3)), png(noise(14, 20, dtype=np.uint16))
COLOR_JPG = cv2.imencode(".jpg", noise(18, 24, 3))[1].tobytes()
SHORT_PNG = COLOR_PNG[:33] + chunk(b"IDAT", zlib.compress(b"\0" * 10)) + chunk(b"IEND", b"")

FRAME = {
    "depth truncated": ("depth/000001.png", DEPTH_PNG[:-20], "000001.png: truncated PNG"),
    "depth cut in half": ("depth/000001.png", DEPTH_PNG[: len(DEPTH_PNG) // 2], "truncated PNG"),
    "depth header only": ("depth/000001.png", DEPTH_PNG[:20], "truncated PNG"),
    "depth empty file": ("depth/000001.png", b"", "000001.png: the file is empty"),
    "depth damaged": ("depth/000001.png", flip(DEPTH_PNG, 200), "damaged PNG .checksum of chunk 'IDAT'"),
    "depth 8 bits": (
        "depth/000001.png",
        png(noise(14, 20)),
        "one channel of 16 bits, this image is .* 1 channel.s. of 8",
    ),
    "depth 3 channels": (
        "depth/000001.png",
        png(noise(14, 20, 3, dtype=np.uint16)),
        "must be one channel .* 3 channel",
    ),
    "depth size": (
        "depth/000001.png",
        png(noise(18, 24, dtype=np.uint16)),
        "24 x 18 pixels, but recording.json: depth",
    ),
    "depth a jpeg": ("depth/000001.png", COLOR_JPG, "depth must be one channel of 16 bits"),
    "color 16 bits": ("color/000001.png", png(noise(18, 24, 3, dtype=np.uint16)), "three channels of 8 bits"),
    "color grey": (
        "color/000001.png",
        png(noise(18, 24)),
        "colour must be three channels of 8 bits, this image is .* 1 ch",
    ),
    "color size": ("color/000001.png", png(noise(17, 24, 3)), "24 x 17 pixels, but recording.json: color says 24 x 18"),
    "color not an image": ("color/000001.png", b"hello", "neither a PNG nor a JPEG"),
    "color jpeg cut": ("color/000001.png", COLOR_JPG[:-30], "truncated JPEG"),
    "color jpeg damaged": ("color/000001.png", COLOR_JPG[:-90] + b"\xff\xd8" + COLOR_JPG[-88:], "damaged JPEG"),
    "color jpeg headers": ("color/000001.png", COLOR_JPG[:60], "truncated JPEG"),
    "color pixels missing": ("color/000001.png", SHORT_PNG, "color/000001.png: the image cannot be decoded"),
}


@pytest.mark.parametrize("case", FRAME)
def test_errors_of_one_frame_name_its_file(folder, case, capfd):
    name, content, words = FRAME[case]
    if case == "color pixels missing" and cv2.imdecode(np.frombuffer(content, np.uint8), -1) is not None:
        pytest.skip("this OpenCV fills the missing pixels; the file's checksums are right, so nothing tells")
    (folder / name).write_bytes(content)
    r = recordings.open(folder)
    with pytest.raises(FrameError, match=words) as caught:
        r.frame(1)
    assert str(folder / name) in str(caught.value)
    assert [f.index for f in r.frames(on_error=lambda *_: None)] == [0, 4]


def test_a_frame_without_one_of_its_images_or_with_two(folder):
    (folder / "color" / "000000.png").unlink()
    (folder / "color" / "000004.jpg").write_bytes(COLOR_JPG)
    r = recordings.open(folder)
    with pytest.raises(FrameError, match=r"color: frame 0 has no image here \(000000.png is missing\)"):
        r.frame(0)
    with pytest.raises(FrameError, match=r"frame 4 is there more than once: 000004.jpg and 000004\.png"):
        r.frame(4)


def test_colour_variants_that_are_fine(folder):
    rgba = noise(18, 24, 4)
    (folder / "color" / "000001.png").write_bytes(png(rgba))
    np.testing.assert_array_equal(recordings.open(folder).frame(1).color, rgba[..., [2, 1, 0]])
    (folder / "color" / "000001.png").unlink()
    (folder / "color" / "000001.jpg").write_bytes(COLOR_JPG)
    assert recordings.open(folder).frame(1).color.shape == (18, 24, 3)


def test_exif_orientation_is_ignored(folder):
    exif = (
        b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: turn by 90 degrees
    )
    turned = COLOR_JPG[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + COLOR_JPG[2:]
    (folder / "color" / "000001.png").write_bytes(turned)
    assert recordings.open(folder).frame(1).color.shape == (18, 24, 3)


# --- bytes at random ---


@settings(slow_ok, max_examples=150)
@given(data=st.data())
def test_random_damage_raises_nothing_but_ours(tmp_path, data):
    path = tmp_path / "rec"
    if not path.exists():
        cam = camera()
        person = TruthPerson(0, np.zeros((18, 3)), np.ones(18, bool), np.zeros(18, bool))
        write_recording(
            path,
            [frame(cam, 0, 0.0), frame(cam, 1, 0.1)],
            fps=10.0,
            truth=Truth({0: (person,)}),
            keypoints2d={0: [Keypoints2D.from_rows(np.ones((18, 3)))]},
        )
    names = ["recording.json", "truth.json", "keypoints2d.json", "depth/000000.png", "color/000000.jpg"]
    name = data.draw(st.sampled_from(names))
    whole = (path / name).read_bytes()
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))] if data.draw(st.booleans()) else whole)
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        (path / name).write_bytes(damaged)
        try:
            r = recordings.open(path)
            list(r.frames(on_error=lambda *_: None))
            _ = r.truth, r.keypoints2d
            if name == "depth/000000.png" and bytes(damaged) != whole:
                with pytest.raises(FrameError):
                    r[0]
        except UnderstudyError as error:
            message = str(error)
            assert name.split("/")[-1] in message
    finally:
        (path / name).write_bytes(whole)


# --- truth and keypoints ---


def truth_data():
    keypoints = [[0.1 * i, 0.2, 2.0] for i in range(18)]
    keypoints[3] = None
    return {
        "frames": [
            {"index": 0, "people": [{"id": 7, "keypoints": keypoints}, {"keypoints": keypoints, "hands": None}]},
            {"index": 4, "people": []},
        ],
        "joints_note": "hips inside",
    }


def test_truth_defaults_and_round_trip(folder):
    data = truth_data()
    data["frames"][0]["people"][0] |= {
        "in_view": [True] * 17 + [False],
        "occluded": [True] + [False] * 17,
        "hands": {"left": {"normal": [0.6, 0, -0.8], "in_view": False}, "right": None},
    }
    (folder / "truth.json").write_text(json.dumps(data))
    truth = recordings.open(folder).truth
    first, second = truth.frames[0]
    assert (first.id, second.id) == (7, 1) and truth.frames[4] == () and truth.joints_note == "hips inside"
    assert np.isnan(first.keypoints[3]).all() and first.keypoints[17, 0] == pytest.approx(1.7)
    assert not first.in_view[17] and first.occluded[0] and first.occluded.sum() == 1
    assert second.in_view.all() and not second.occluded.any()
    np.testing.assert_allclose(first.palms["left"], [0.6, 0, -0.8])
    assert first.palms["right"] is None and first.hands_in_view == {"left": False, "right": False}
    assert second.palms == {"left": None, "right": None}

    again = write_recording(folder.parent / "again", iter(recordings.open(folder)), truth=truth)
    assert json.loads((again / "truth.json").read_text()) == truth.to_json()
    assert recordings.open(again).truth.to_json() == truth.to_json()


TRUTH = {
    "no frames": (drop("frames"), r"field 'frames' must be a list"),
    "frame a number": (put(3, "frames", 0), r"frames\[0\]: must be an object"),
    "no index": (drop("frames", 0, "index"), r"frames\[0\]\.index: must be a frame number"),
    "index twice": (put(0, "frames", 1, "index"), r"frames\[1\]\.index: frame 0 is there twice"),
    "no people": (drop("frames", 0, "people"), r"frames\[0\]\.people: must be a list"),
    "17 joints": (
        lambda d: d["frames"][0]["people"][1]["keypoints"].pop(),
        r"people\[0\]\.keypoints: must be a list of 18",
    ),
    "two numbers": (
        put([1, 2], "frames", 0, "people", 0, "keypoints", 5),
        r"people\[0\]\.keypoints: each row must be 3",
    ),
    "flags": (put([True] * 17, "frames", 0, "people", 0, "in_view"), r"people\[0\]\.in_view: must be 18 times"),
    "flag a number": (put([0] * 18, "frames", 0, "people", 0, "occluded"), r"people\[0\]\.occluded: must be 18 times"),
    "not a unit vector": (
        put({"left": {"normal": [1, 1, 0]}}, "frames", 0, "people", 0, "hands"),
        r"hands\.left\.normal: must be a unit vector",
    ),
    "normal a word": (
        put({"right": {"normal": "up"}}, "frames", 0, "people", 0, "hands"),
        r"hands\.right\.normal: must be 3 numbers",
    ),
}


@pytest.mark.parametrize("case", TRUTH)
def test_errors_in_truth_name_the_place(folder, case):
    change, words = TRUTH[case]
    data = truth_data()
    change(data)
    (folder / "truth.json").write_text(json.dumps(data))
    r = recordings.open(folder)  # truth is read when asked for
    with pytest.raises(RecordingError, match=rf"truth\.json: .*{words}|truth\.json: {words}"):
        _ = r.truth


def test_keypoints2d_round_trip_and_errors(folder):
    rows = np.column_stack([np.arange(18.0), np.arange(18.0) / 2, np.linspace(0, 1, 18)])
    people = {0: [Keypoints2D.from_rows(rows)], 4: []}
    path = write_recording(folder.parent / "again", iter(recordings.open(folder)), keypoints2d=people)
    back = recordings.open(path).keypoints2d
    assert back[4] == [] and not back[0][0].found[0]
    np.testing.assert_array_equal(back[0][0].rows(), people[0][0].rows())
    for bad, words in ((1.5, r"scores must lie in \[0, 1\]"), (-0.1, "scores"), ("x", "each row must be 3 numbers")):
        data = {"frames": [{"index": 0, "people": [{"keypoints": [[1, 2, bad]] * 18}]}]}
        (path / "keypoints2d.json").write_text(json.dumps(data))
        with pytest.raises(RecordingError, match=rf"keypoints2d\.json: frames\[0\]\.people\[0\]\.keypoints: .*{words}"):
            _ = recordings.open(path).keypoints2d


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_file_is_named(folder):
    path = folder / "depth" / "000001.png"
    path.chmod(0)
    with pytest.raises(FrameError, match=r"000001\.png: cannot be read"):
        recordings.open(folder).frame(1)
