"""The viewer: a real server on this computer, asked over HTTP; its scene and its panel; bad input."""

import json
import socket
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from understudy.camera import Camera, RGBDCamera
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.floor import find_floor
from understudy.overlay import person_color
from understudy.people_file import FramePeople, PeopleFile
from understudy.recordings import FolderWriter
from understudy.types import Frame, Keypoints2D, Palm, Person, RegisteredDepth, RegisteredFrame
from understudy.viewer.app import Viewer, free_port, is_local, view
from understudy.viewer.cloud import make_cloud, near_people
from understudy.viewer.panel import describe_joints, people_html
from understudy.viewer.results import Cache, Moment, Results
from understudy.viewer.scene import shade, view_point

CAMERA = Camera.from_fov(96, 64, np.deg2rad(70))
BROKEN = 4


def person(id=0, z=2.5, missing=(), **changes) -> Person:
    """Eighteen joints in a rough column; all are detected in 2D."""
    joints = np.column_stack([np.linspace(-0.2, 0.2, 18), np.linspace(-0.6, 0.9, 18), np.full(18, z)])
    uv = CAMERA.project(joints)
    lost = np.isin(np.arange(18), missing)
    source = tuple("missing" if lost[i] else "inferred" if i % 5 == 0 else "observed" for i in range(18))
    joints[lost] = np.nan
    return Person(
        Keypoints2D.where(uv, np.full(18, 0.8)), joints, np.full(18, 0.9), np.full(18, 0.02), source, id, **changes
    )


def frames() -> tuple[FramePeople, ...]:
    palm = Palm(np.array([0.0, 0.0, -1.0]), 0.9)
    two = (person(0), person(7, 3.5, missing=(0, 3), hands={"left": palm, "right": None}))
    failed = Person.failure(person().keypoints_2d, "no depth <b>here</b>").with_id(3)
    return (
        FramePeople(0, (), 0.0),
        FramePeople(1, two, 0.1),
        FramePeople(2, (person(0), failed), 0.2),
        FramePeople(3, (), 0.3, skipped="depth/000003.png: cut short"),
        FramePeople(BROKEN, (person(0),), 0.4),
        FramePeople(9, (person(0),), 0.9),
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A recording of five frames, the last one broken, and results for it."""
    recording, results = (tmp_path_factory.mktemp("viewer") / name for name in ("recording", "results"))
    rng = np.random.default_rng(0)
    with FolderWriter(recording, RGBDCamera.aligned(CAMERA), fps=10.0, color_format="png") as writer:
        for index in range(5):
            depth = np.full((64, 96), 3.0 + index / 10, np.float32)
            writer.write(
                Frame(rng.integers(0, 256, (64, 96, 3), dtype=np.uint8), depth, RGBDCamera.aligned(CAMERA), index)
            )
    (recording / "color" / f"{BROKEN:06d}.png").write_bytes(b"not an image")
    PeopleFile("naive", "recording", frames()).write(results / "people.json")
    (results / "config.json").write_text(json.dumps({"recording": str(recording)}))
    return recording, results


@pytest.fixture(scope="module")
def viewer(folders):
    pytest.importorskip("viser", reason="the viewer's tests need viser (the extra 'viewer')")
    with view(folders[1], port=0, block=False) as running:
        yield running


def nodes(viewer: Viewer) -> set[str]:
    return set(viewer.scene.nodes)


# --- the page ---


def test_the_page_is_served_on_this_computer(viewer):
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    with urllib.request.urlopen(viewer.url, timeout=10) as answer:
        assert answer.status == 200 and answer.headers["Content-Type"].startswith("text/html")
        assert b"<html" in answer.read()[:2000].lower()


def test_other_computers_cannot_connect(viewer):
    table = Path("/proc/net/tcp")
    if not table.exists():
        pytest.skip("only Linux lists what listens in /proc/net/tcp")
    listening = [line.split()[1] for line in table.read_text().splitlines() if line.split()[3] == "0A"]
    ours = [address for address in listening if address.endswith(f":{viewer.port:04X}")]
    assert ours == [f"0100007F:{viewer.port:04X}"]  # 127.0.0.1 alone


def test_the_page_cannot_be_published(viewer):
    assert viewer.server.request_share_url() is None


# --- the scene ---


def test_people_are_in_the_scene(viewer):
    viewer.show(1)
    assert {"/skeletons/0/bones", "/skeletons/0/joints", "/skeletons/1/joints", "/labels/0", "/labels/1"} <= nodes(
        viewer
    )
    assert "/skeletons/1/left_palm" in nodes(viewer) and "/skeletons/1/right_palm" not in nodes(viewer)
    joints = viewer.scene.nodes["/skeletons/1/joints"]
    assert len(joints.batched_positions) == 16  # two are missing
    second = viewer.moment.frame.people[1]
    np.testing.assert_allclose(joints.batched_positions, second.keypoints[~np.isnan(second.keypoints[:, 0])], atol=1e-6)
    np.testing.assert_allclose(joints.batched_colors[0], shade(person_color(7), False), atol=1)
    assert viewer.scene.nodes["/labels/1"].text.startswith("#7 3.5")
    bones = viewer.scene.nodes["/skeletons/0/bones"].points
    assert bones.shape == (18, 2, 3) and np.isfinite(bones).all()


def test_the_cloud_lies_where_the_depth_is(viewer):
    viewer.show(1)
    clouds = [n.points for name, n in viewer.scene.nodes.items() if name.startswith("/cloud/")]
    points = np.concatenate(clouds)
    assert len(points) == 96 * 64  # a small image: every pixel
    np.testing.assert_allclose(points[:, 2], 3.1, atol=1e-3)


def test_another_frame_replaces_what_is_shown(viewer):
    viewer.show(1)
    first = viewer.panel.image
    viewer.show(2)
    assert viewer.position == 2 and viewer.panel.slider.value == 3
    assert "/skeletons/0/joints" in nodes(viewer) and "/skeletons/1/joints" not in nodes(viewer)  # one has failed
    assert first.shape == viewer.panel.image.shape and (first != viewer.panel.image).any()
    assert "Frame 2" in viewer.panel.status and "0.20 s" in viewer.panel.status and "3 of 6" in viewer.panel.status
    viewer.show(0)
    assert not any(name.startswith(("/skeletons", "/labels")) for name in nodes(viewer))
    assert "Nobody" in viewer.panel.people


@pytest.mark.parametrize(
    "position, words",
    [
        (3, "Frame 3 was skipped: depth/000003.png: cut short"),
        (4, "Frame 4 cannot be read"),
        (5, "Frame 9 is not in the recording"),
    ],
)
def test_frames_without_a_picture_say_why(viewer, position, words):
    viewer.show(position)
    assert words in viewer.panel.status
    assert not any(name.startswith("/cloud") for name in nodes(viewer))
    assert "Nobody" not in viewer.panel.people
    assert ("/skeletons/0/joints" in nodes(viewer)) == (position != 3)


def test_groups_and_points_follow_the_panel(viewer):
    viewer.show(1)
    viewer.set_visible("skeletons", False)
    assert not viewer.scene.groups["skeletons"].visible
    viewer.set_visible("skeletons", True)
    viewer.set_point_size(0.03)
    assert viewer.scene.nodes["/cloud/room"].point_size == pytest.approx(0.03)
    viewer.show(2)
    assert viewer.scene.nodes["/cloud/room"].point_size == pytest.approx(0.03)


def test_steps_wrap_around_and_wishes_are_clamped(viewer):
    viewer.show(0)
    viewer.step(-1)
    wait_until(lambda: viewer.position == len(viewer) - 1)
    viewer.step(1)
    wait_until(lambda: viewer.position == 0)
    viewer.go_to(999)
    wait_until(lambda: viewer.position == len(viewer) - 1)


def test_playing_moves_on_and_stops(viewer):
    viewer.show(0)
    viewer.set_fps(30.0)
    viewer.toggle_playing()
    wait_until(lambda: viewer.position >= 2)
    viewer.toggle_playing()
    viewer.show(1)
    time.sleep(0.2)
    assert viewer.position == 1


def wait_until(condition, seconds=10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.01)


# --- ports and hosts ---


def test_a_taken_port_gives_the_next_free_one_and_says_so(folders, capsys):
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with view(folders[1], port=port, block=False) as running:
            assert running.port > port
            said = capsys.readouterr().out
            assert f"Port {port} is taken; using {running.port}." in said
            assert running.url in said and "WARNING" not in said
        running.close()  # twice is fine
    with socket.socket() as again:  # the port is free once more
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", running.port))


def test_other_hosts_are_warned_about(folders, capsys):
    pytest.importorskip("viser")
    with view(folders[1], host="0.0.0.0", port=0, block=False) as running:
        said = capsys.readouterr().out
        assert "WARNING" in said and "no password" in said
        assert running.url.startswith("http://127.0.0.1:")


@pytest.mark.parametrize(
    "host, local",
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("", False), ("192.168.0.2", False)],
)
def test_which_hosts_are_this_computer_alone(host, local):
    assert is_local(host) is local


def test_bad_ports_and_hosts():
    with pytest.raises(UnderstudyError, match="port must be in 0 ... 65535"):
        free_port("127.0.0.1", 70000)
    with pytest.raises(UnderstudyError, match="no free port at '192.0.2.1'"):
        free_port("192.0.2.1", 8080)
    with pytest.raises(UnderstudyError, match="not an address"):
        free_port("not a host", 8080)


# --- bad input ---


def test_a_folder_without_people(tmp_path):
    with pytest.raises(RecordingError, match=r"no people\.json.*understudy estimate RECORDING --out"):
        Results.open(tmp_path)
    with pytest.raises(RecordingError, match=r"no people\.json"):
        Results.open(tmp_path / "absent")


@pytest.mark.parametrize("config", [None, "{}", '{"recording": 3}', '{"recording": "/moved/away"}'])
def test_a_recording_that_is_not_where_it_was(tmp_path, folders, config):
    recording, results = folders
    (tmp_path / "people.json").write_bytes((results / "people.json").read_bytes())
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    with pytest.raises(RecordingError, match=rf"config\.json.*understudy view {tmp_path} --recording PATH"):
        Results.open(tmp_path)
    opened = Results.open(tmp_path, recording)
    assert len(opened.recording) == 5
    opened.recording.close()


def test_a_recording_that_the_results_are_not_of(tmp_path, folders):
    PeopleFile("naive", "x", (FramePeople(100, ()),)).write(tmp_path / "people.json")
    with pytest.raises(RecordingError, match="none of its frames"):
        Results.open(tmp_path, folders[0])
    PeopleFile("naive", "x", ()).write(tmp_path / "people.json")
    with pytest.raises(RecordingError, match="'frames' is empty"):
        Results.open(tmp_path, folders[0])


def test_without_viser_the_extra_is_named(folders, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"understudy\[viewer\]"):
        view(folders[1], block=False)


# --- parts ---


def test_clouds_are_thinned_evenly_and_coloured_by_their_pixels():
    camera = Camera.from_fov(320, 240, np.deg2rad(60))
    color = np.zeros((240, 320, 3), np.uint8)
    color[:, 160:, 0] = 255  # the right half is red
    frame = RegisteredFrame(color, camera, RegisteredDepth(np.full((480, 640), 2.0, np.float32), camera.scale(2)))
    cloud = make_cloud(frame, max_points=5000)
    assert 1000 < len(cloud) <= 5000
    assert ((cloud.points[:, 0] > 0.01) <= (cloud.colors[:, 0] == 255)).all()
    assert ((cloud.points[:, 0] < -0.01) <= (cloud.colors[:, 0] == 0)).all()
    for empty in (np.zeros((240, 320), np.float32),):
        assert len(make_cloud(RegisteredFrame(color, camera, RegisteredDepth(empty, camera)))) == 0


def test_points_of_people():
    someone = person(z=2.5)
    points = np.concatenate([someone.keypoints, someone.keypoints + (0, 0, 1.0)]).astype(np.float32)
    assert near_people(points, [someone]).tolist() == [True] * 18 + [False] * 18
    assert not near_people(points, []).any()


@pytest.mark.parametrize("tilt", np.deg2rad([0, 20, -15]))
def test_the_floor_is_found_under_a_tilted_camera(tilt):
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(-2, 2, 4000), rng.normal(1.4, 0.005, 4000), rng.uniform(1, 5, 4000)])
    table = np.column_stack([rng.uniform(-1, 1, 5000), rng.normal(0.7, 0.005, 5000), rng.uniform(2, 3, 5000)])
    wall = np.column_stack([rng.uniform(-2, 2, 5000), rng.uniform(-1, 1.4, 5000), rng.normal(5, 0.005, 5000)])
    R = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    found = find_floor((np.concatenate([floor, table, wall]) @ R.T).astype(np.float32), [])
    assert found.up @ (R @ [0, -1, 0]) > np.cos(np.deg2rad(1))
    assert found.height == pytest.approx(-1.4, abs=0.02)
    assert np.linalg.norm(found.wxyz()) == pytest.approx(1)
    assert found.up @ found.below(np.array([0.3, 0.2, 3.0])) == pytest.approx(found.height)


def test_without_a_floor_the_people_stand_level():
    found = find_floor(None, [person()])
    assert found.up.tolist() == [0, -1, 0] and found.height == pytest.approx(-0.98)
    assert find_floor(np.zeros((10, 3), np.float32), []).height == -1.5


def test_the_first_view_holds_everyone():
    points, up = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + (0, 0, 3), np.array([0.0, -1.0, 0.0])
    centre = points.mean(axis=0)
    eye = view_point(points, centre, up)
    forward = (centre - eye) / np.linalg.norm(centre - eye)
    rays = (points - eye) / np.linalg.norm(points - eye, axis=1)[:, None]
    assert (rays @ forward).min() > np.cos(np.deg2rad(32)) and eye[1] < centre[1] and eye[2] < centre[2]


def test_words_about_people_are_escaped():
    failed = frames()[2].people[1]
    assert describe_joints(failed) == "failed: no depth <b>here</b>"
    assert "&lt;b&gt;here" in people_html((failed,)) and "<b>here" not in people_html((failed,))
    assert "12 observed, 4 inferred, 2 missing" in describe_joints(person(missing=(1, 2)))


def test_the_cache_loads_each_frame_once_and_forgets_the_oldest():
    loads, gate = [], threading.Event()

    def load(position: int) -> Moment:
        gate.wait(5)
        loads.append(position)
        return Moment(FramePeople(position, ()))

    cache = Cache(load, size=2)
    first = cache.prefetch(0)
    assert cache.prefetch(0) is first
    gate.set()
    assert cache.get(0).frame.index == 0 and cache.get(1).frame.index == 1
    assert cache.get(2).frame.index == 2 and cache.get(0).frame.index == 0
    assert loads == [0, 1, 2, 0]
    cache.close()
