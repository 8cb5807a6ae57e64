"""The stage: exact pictures, recordings that hold the truth. Its furniture: test_stage_furniture.py."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from understudy import recordings
from understudy.camera import Camera
from understudy.demonstration.demonstration import Segments
from understudy.demonstration.tasks import TASKS
from understudy.errors import RecordingError, UnderstudyError
from understudy.geometry import inverse, rigid, transform_points
from understudy.objects.marker_setup import MarkerSetup
from understudy.objects.markers import MarkerTracker
from understudy.skeleton import JOINT
from understudy.stage.furniture import Furniture, sample_furniture
from understudy.types import RegisteredDepth, RegisteredFrame

mujoco = pytest.importorskip("mujoco", reason="the extra 'stage' is not installed")
pytest.importorskip("torch", reason="the extra 'train' is not installed")

from understudy.cli import stage as command  # noqa: E402
from understudy.recordings.truth import Truth  # noqa: E402
from understudy.stage import record as stage_record  # noqa: E402
from understudy.stage import viewpoint  # noqa: E402
from understudy.stage.markers import PLATE, marker_setup, object_markers  # noqa: E402
from understudy.stage.record import MARKERS  # noqa: E402
from understudy.stage.render import Renderer, open_gl  # noqa: E402
from understudy.stage.scene import Scene  # noqa: E402
from understudy.stage.truth import FACTS, TRAJECTORIES, furniture_to_json, read_stage_truth  # noqa: E402
from understudy.stage.viewpoint import choose_viewpoint, look_at  # noqa: E402

# --- pictures ---


@pytest.fixture(autouse=True)
def few_viewpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewpoint, "CANDIDATES", 30)  # a fourth of them, for speed


@pytest.fixture(scope="module")
def gl() -> None:
    try:
        open_gl(64, 64).free()
    except UnderstudyError as e:
        pytest.skip(str(e))


def ball(middle: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    theta, phi = np.meshgrid(np.linspace(1e-3, np.pi - 1e-3, 24), np.linspace(0, 2 * np.pi, 48), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i = np.arange(24 * 48).reshape(24, 48)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return (middle + radius * points).astype(np.float32), np.concatenate(
        [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    )


@dataclass(frozen=True, eq=False)
class Ball:
    name: str
    faces: np.ndarray
    color: tuple[float, float, float]
    texture: None = None
    uv: None = None


CAMERA = Camera(512, 424, np.array([[371.0, 0, 250.5], [0, 365.0, 215.0], [0, 0, 1]]))


def test_depth_is_that_of_rays(gl: None) -> None:
    """Against MuJoCo's ray casting at pixel centres, and against the floor's equation."""
    scene = Scene(sample_furniture("drawer", 1), 1)
    scene.pose(0.3)
    T = look_at(np.array([-2.4, 1.3, 1.7]), np.array([0.0, 0, 0.7]), 0.03)
    with Renderer(scene) as renderer:
        renderer.update()
        depth = renderer.surfaces(CAMERA, T).depth
        photo = renderer.color(CAMERA, T)
    assert photo.std() > 10 and not np.array_equal(photo[:, ::-1], photo)
    rng = np.random.default_rng(0)
    uv = np.stack([rng.integers(0, 512, 1500), rng.integers(0, 424, 1500)], 1)
    rays = CAMERA.unproject(uv.astype(float), 1.0) @ T[:3, :3].T
    far, which = np.empty(len(uv)), np.empty(len(uv), np.int32)
    eye = T[:3, 3].copy()
    mujoco.mj_multiRay(scene.model, scene.data, eye, rays.ravel(), None, 1, -1, which, far, None, len(uv), 1e3)
    error = np.abs(depth[uv[:, 1], uv[:, 0]] - far)[far > 0]  # rays have z = 1, so their length factor is z
    assert np.quantile(error, 0.97) < 1e-4  # edges may fall on either side
    floor = which == scene.model.geom("floor").id
    assert floor.sum() > 100
    height = eye[2] + depth[uv[:, 1], uv[:, 0]][floor] * rays[floor, 2]
    assert np.quantile(np.abs(height), 0.97) < 1e-4


def test_a_person_s_surface_is_where_its_vertices_are_put(gl: None) -> None:
    points, faces = ball(np.zeros(3), 0.2)
    balls = [Ball("shirt", faces, (0.8, 0.1, 0.1)), Ball("hair", faces, (0.05, 0.05, 0.05))]
    scene = Scene(sample_furniture("swivel_door", 0), 0, balls, [points, points])
    T = look_at(np.array([-3.0, 0.4, 1.5]), np.array([0.0, 0, 1.2]))
    with Renderer(scene) as renderer:
        for x in (-0.9, -0.6):
            middles = np.array([[x, 0.3, 1.0], [x, -0.3, 1.5]])
            scene.pose(0.0, [points + m.astype(np.float32) for m in middles])
            renderer.update()
            seen = renderer.surfaces(CAMERA, T)
            photo = renderer.color(CAMERA, T)
            in_cam = transform_points(inverse(T), middles)
            u, v = np.rint(CAMERA.project(in_cam)).astype(int).T
            assert seen.person[v, u].all() and seen.dark[v, u].tolist() == [False, True]
            np.testing.assert_allclose(
                seen.depth[v, u], in_cam[:, 2] - 0.2 * in_cam[:, 2] / np.linalg.norm(in_cam, axis=1), atol=3e-3
            )
            red = photo[v[0], u[0]].astype(int)
            assert red[0] > 60 + red[1:].max()
            area = np.pi * (0.2 * CAMERA.fx / in_cam[:, 2]) ** 2
            assert abs(seen.person.sum() / area.sum() - 1) < 0.1
    with pytest.raises(ValueError, match="piece 0"):
        scene.pose(0.0, [points[:-1], points])


@pytest.mark.parametrize("task", TASKS)
def test_marker_is_seen_where_it_is(gl: None, task: str) -> None:
    f = sample_furniture(task, 2)
    markers = object_markers(f)
    scene = Scene(f, 2, markers=markers)
    q = 0.15 * f.open_to
    scene.pose(q)
    camera = Camera(960, 540, np.array([[540.0, 0, 475], [0, 544.0, 271], [0, 0, 1]]))
    with Renderer(scene) as renderer:
        renderer.update()
        for marker in markers[:2]:
            T_world_marker = f.articulation.pose(np.array([q]))[0] @ inverse(marker.T_marker_frame)
            T = look_at(T_world_marker[:3, 3] + 0.5 * T_world_marker[:3, 2] + (-0.5, 0, 0.1), T_world_marker[:3, 3])
            photo = np.ascontiguousarray(renderer.color(camera, T))
            nothing = RegisteredDepth(np.zeros((540, 960), np.float32), camera)
            tracker = MarkerTracker({marker.id: marker.size_m}, depth=False)
            seen = tracker.detect(RegisteredFrame(photo, camera, nothing))
            square = marker.size_m / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
            true = camera.project(transform_points(inverse(T) @ T_world_marker, square))
            # orientation, size and place; a shadow's edge on a tag costs most
            assert np.abs(seen[marker.id].corners_2d - true).max() < 0.4


@pytest.mark.parametrize("task", TASKS)
def test_brackets_fit_on_the_front(task: str) -> None:
    """Clear of the handle and of what the hand needs there; not beyond the hinge's edge; before the front."""
    for seed in range(20):
        f = sample_furniture(task, seed)
        for marker in object_markers(f):
            plate = marker.size_m * PLATE / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
            corners = transform_points(inverse(f.panel.T_frame_box) @ inverse(marker.T_marker_frame), plate)
            assert (corners[:, 0] < -f.panel.half_m[0]).all()
            handle = inverse(f.panel.T_frame_box)[1:3, 3]
            beside = np.abs(corners[:, 1:] - handle).min(axis=0)
            assert (beside > (0.1, 0.0)).all() or beside[1] > 0.1 or f.pushed
            if task != "drawer":
                assert (np.abs(corners[:, 1]) < f.panel.half_m[1]).all()
            assert marker.size_m >= 0.09


# --- recordings ---


@dataclass(frozen=True, eq=False)
class Puppet:
    """Two balls for a person; enough to record."""

    furniture: Furniture
    times_s: np.ndarray = field(default_factory=lambda: np.arange(3) / 10)
    acting: str = "right"
    segments: Segments = field(default_factory=lambda: Segments(1, 2))

    def __len__(self) -> int:
        return 3

    @property
    def q(self) -> np.ndarray:
        return np.array([0, 0.5, 1.0]) * self.furniture.open_to

    @property
    def pieces(self) -> list[Ball]:
        faces = ball(np.zeros(3), 1)[1]
        return [Ball("shirt", faces, (0.7, 0.2, 0.2)), Ball("hair", faces, (0.05, 0.05, 0.05))]

    @property
    def base(self) -> np.ndarray:
        grip = self.furniture.articulation.pose(self.q)[:, :3, 3]
        return np.column_stack([grip[:, 0] - 0.6, grip[:, 1], [0, 0, 0]])

    def vertices(self, i: int) -> list[np.ndarray]:
        return [ball(self.base[i] + (0, 0, 1.2), 0.2)[0], ball(self.base[i] + (0, 0, 1.6), 0.12)[0]]

    @property
    def joints(self) -> np.ndarray:
        place = np.tile([0.0, 0, 1.2], (18, 1))
        for name, z in (("nose", 1.6), ("left_ankle", 0.1), ("right_ankle", 0.1)):
            place[JOINT[name], 2] = z
        return self.base[:, None] + place

    @property
    def T_world_hand(self) -> dict[str, np.ndarray]:
        grip = self.furniture.articulation.pose(self.q) @ rigid(np.eye(3), np.array([0.05, 0, 0]))
        return {"left": grip, "right": grip}

    @property
    def torso_xy_yaw(self) -> np.ndarray:
        return self.base

    def carriers(self, i: int) -> dict[str, np.ndarray]:
        return {"hand": self.T_world_hand["right"][i], "torso": rigid(np.eye(3), self.base[i] + (0, 0, 1))}


def made(folder: Path, **options: object) -> Path:
    f = sample_furniture("drawer", 5)
    return stage_record.record_performance(folder, f, Puppet(f), 5, **options)


def test_recording_and_truth_read_back(gl: None, tmp_path: Path) -> None:
    folder = made(tmp_path / "a", markers=True, settings={"fps": 10.0})
    frames = list(recordings.open(folder))
    assert [f.index for f in frames] == [0, 1, 2] and frames[0].depth.shape == (424, 512)
    truth, puppet = read_stage_truth(folder), Puppet(sample_furniture("drawer", 5))
    assert furniture_to_json(truth.furniture) == furniture_to_json(puppet.furniture)
    assert (truth.task, truth.acting, truth.segments, truth.settings) == (
        "drawer",
        "right",
        Segments(1, 2),
        {"fps": 10},
    )
    np.testing.assert_allclose(truth.T_world_object, puppet.furniture.articulation.pose(puppet.q))
    np.testing.assert_allclose(truth.T_world_hand["left"], puppet.T_world_hand["left"])
    assert truth.markers is not None
    markers = truth.markers.markers
    assert [m.on for m in markers] == ["object"] * 4 + ["hand"] * 6 + ["torso"] * 3
    assert len({m.id for m in markers}) == len(markers)
    assert MarkerSetup.read(folder / MARKERS).to_json() == truth.markers.to_json()
    people = Truth.read(folder / "truth.json")
    T_cam_world = inverse(truth.T_world_cam)
    for i, frame in enumerate(frames):
        (person,) = people.frames[i]
        np.testing.assert_allclose(person.keypoints, transform_points(T_cam_world, puppet.joints[i]))
        np.testing.assert_allclose(person.palms["right"], T_cam_world[:3, :3] @ truth.T_world_hand["right"][i][:3, 2])
        # the depth camera sees the chest's ball before its middle
        T_depth_world = inverse(frame.camera.T_color_depth) @ T_cam_world
        chest = transform_points(T_depth_world, puppet.joints[i][None, JOINT["neck"]])[0]
        u, v = np.rint(frame.camera.depth.project(chest)).astype(int)
        around = frame.depth[v - 4 : v + 5, u - 4 : u + 5]
        near = np.median(around[around > 0])
        assert abs(near - chest[2] * (1 - 0.2 / np.linalg.norm(chest))) < 0.02


def test_recording_is_deterministic_and_resumes(gl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_record, "perform", lambda furniture, seed, fps: Puppet(furniture))
    first, second = (stage_record.record(tmp_path / n, "drawer", 1, 7, progress=False)[0] for n in "ab")
    names = sorted(p.relative_to(first) for p in first.rglob("*.*"))
    assert len(names) == 3 + 3 + 4
    assert all((first / n).read_bytes() == (second / n).read_bytes() for n in names if n.suffix != ".npz")
    (second / "recording.json").unlink()  # interrupted: it is made anew
    (second / "color" / "000001.jpg").write_bytes(b"half a picture")
    before = (first / "truth.json").stat().st_mtime_ns
    for parent in "ab":
        stage_record.record(tmp_path / parent, "drawer", 1, 7, progress=False)
    assert (second / "color" / "000001.jpg").read_bytes() == (first / "color" / "000001.jpg").read_bytes()
    assert (first / "truth.json").stat().st_mtime_ns == before, "a finished recording is kept"
    with pytest.raises(UnderstudyError, match="another markers, seed"):
        stage_record.record(tmp_path / "a", "drawer", 1, 8, markers=True, progress=False)
    (first / FACTS).unlink()
    with pytest.raises(UnderstudyError, match="drawer_00: holds another recording"):
        stage_record.record(tmp_path / "a", "drawer", 1, 7, progress=False)


def test_bad_input_is_named(tmp_path: Path) -> None:
    for options, words in (({"task": "fridge"}, "fridge"), ({"demos": 0}, "demos"), ({"fps": -1.0}, "fps")):
        with pytest.raises(UnderstudyError, match=words):
            stage_record.record(**({"out": tmp_path, "task": "drawer", "demos": 1, "fps": 10.0} | options))
    with pytest.raises(UnderstudyError, match="'webcam'.*'kinect2'"):
        made(tmp_path / "x", sensor="webcam")
    with pytest.raises(RecordingError, match=FACTS):
        read_stage_truth(tmp_path)
    (tmp_path / FACTS).write_text('{"format": "stage-truth/1"}')
    with pytest.raises(RecordingError, match=TRAJECTORIES):
        read_stage_truth(tmp_path)


def test_command_records_every_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def fake(out: Path, task: str, *rest: object) -> list[Path]:
        calls.append((task, *rest))
        return [out / task]

    monkeypatch.setattr(stage_record, "record", fake)
    parser = argparse.ArgumentParser()
    command.add(parser.add_subparsers())
    line = ["stage", "record", "--task", "all", "--demos", "2", "--seed", "9", "--markers", "--out", str(tmp_path)]
    arguments = parser.parse_args(line)
    arguments.run(arguments)
    assert calls == [(task, 2, 9, 10.0, "kinect2", True) for task in TASKS]
    assert f"understudy estimate {tmp_path / 'sliding_door'}" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        parser.parse_args(["stage", "record", "--task", "fridge", "--out", "x"])


def test_camera_sees_hand_and_handle() -> None:
    for task in TASKS:
        f = sample_furniture(task, 1)
        puppet, camera = Puppet(f), stage_record.Sensor("kinect2", 0).camera
        view = choose_viewpoint(Scene(f, 1), puppet, puppet.T_world_hand["right"], camera, 1)
        assert 0.6 < view.score <= 1
        grip = f.articulation.pose(puppet.q)[:, :3, 3]
        seen = camera.color.contains(camera.color.project(transform_points(inverse(view.T_world_cam), grip)))
        eye = view.T_world_cam[:3, 3]
        assert seen.all() and eye[0] < -0.4 and 1.3 <= eye[2] <= 2.2
        assert 1.9 < np.linalg.norm(eye - grip[0]) < 3.6


def test_markers_change_the_place_of_the_camera_and_nothing_else() -> None:
    """Without markers it is where it was before there were brackets (recordings stay the same); with them it shows
    markers of all three things.
    """
    f = sample_furniture("drawer", 1)
    puppet, camera = Puppet(f), stage_record.Sensor("kinect2", 0).camera
    plain = choose_viewpoint(Scene(f, 1), puppet, puppet.T_world_hand["right"], camera, 1)
    np.testing.assert_allclose(plain.T_world_cam[:3, 3], [-2.161365334, -0.831178714, 1.634516587], atol=1e-6)
    scene = Scene(f, 1, markers=marker_setup(f, puppet.acting).markers)
    fine = stage_record.Sensor("kinect2", 0, fine_color=True).camera
    view = choose_viewpoint(scene, puppet, puppet.T_world_hand["right"], fine, 1)
    assert view.score > 0.6
    for i, T_object in enumerate(f.articulation.pose(puppet.q)):
        carriers = {"object": T_object, **puppet.carriers(i)}
        eye = view.T_world_cam[:3, 3]
        poses = [carriers[m.on] @ inverse(m.T_marker_frame) for m in scene.markers]
        facing = {m.on for m, T in zip(scene.markers, poses, strict=True) if (eye - T[:3, 3]) @ T[:3, 2] > 0}
        assert facing == {"object", "hand", "torso"}


def test_large_pictures_are_drawn_whole(gl: None) -> None:
    """Twice the usual size (as with markers) shows what half of it shows; what is too large is refused."""
    f = sample_furniture("drawer", 4)
    T_world_cam = look_at(np.array([-2.2, -1.2, 1.5]), np.array([0.0, 0.0, 0.8]))
    small = Camera(640, 360, np.array([[360.0, 0, 319.5], [0, 360.0, 179.5], [0, 0, 1]]))
    with Renderer(Scene(f, 4)) as renderer:
        renderer.update()
        large = renderer.color(small.scale(3.0), T_world_cam).reshape(360, 3, 640, 3, 3).mean(axis=(1, 3))
        apart = np.abs(large - renderer.color(small, T_world_cam))
        assert np.median(apart) < 4 and apart.mean() < 8
        with pytest.raises(UnderstudyError, match="larger than the stage can draw"):
            renderer.color(small.scale(5.0), T_world_cam)
