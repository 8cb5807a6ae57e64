"""Recordings from the stage: somebody opens a piece of furniture before an RGB-D camera, and everything is known."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32
from tqdm import tqdm

from understudy.camera import Camera
from understudy.demonstration.demonstration import Segments
from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError, one_of
from understudy.files import write_atomically
from understudy.geometry import inverse, transform_points
from understudy.objects.marker_setup import MarkerSetup
from understudy.recordings.folder import INFO
from understudy.recordings.truth import Truth, TruthPerson
from understudy.recordings.writer import FolderWriter
from understudy.stage.demonstrator import perform
from understudy.stage.furniture import Furniture, sample_furniture
from understudy.stage.markers import marker_setup
from understudy.stage.render import Renderer, Surfaces
from understudy.stage.scene import Piece, Scene
from understudy.stage.sensor import Sensor
from understudy.stage.truth import FACTS, SIDES, StageTruth, read_stage_truth, write_stage_truth
from understudy.stage.viewpoint import choose_viewpoint
from understudy.synthetic.samples import hidden_joints
from understudy.types import Frame

MARKERS: Final = "markers.json"
"""In a recording's folder: which marker is on what, as `demonstrate --markers` reads it."""
_NOTE: Final = "stage; limb joints are centres of rotation, the neck is the midpoint of the shoulders"


@runtime_checkable
class Performance(Protocol):
    """A person who opens a piece of furniture, as `demonstrator.Performance`. World frame, t moments."""

    @property
    def times_s(self) -> Float[np.ndarray, " t"]: ...
    @property
    def q(self) -> Float[np.ndarray, " t"]: ...
    @property
    def pieces(self) -> Sequence[Piece]: ...
    def vertices(self, i: int) -> Sequence[Float32[np.ndarray, "v 3"]]: ...
    @property
    def joints(self) -> Float[np.ndarray, "t 18 3"]: ...
    @property
    def T_world_hand(self) -> Mapping[str, Float[np.ndarray, "t 4 4"]]: ...
    @property
    def torso_xy_yaw(self) -> Float[np.ndarray, "t 3"]: ...
    @property
    def acting(self) -> str: ...
    @property
    def segments(self) -> Segments: ...
    def carriers(self, i: int) -> Mapping[str, Float[np.ndarray, "4 4"]]: ...


def record(
    out: str | Path,
    task: str,
    demos: int,
    seed: int = 0,
    fps: float = 10.0,
    sensor: str = "kinect2",
    markers: bool = False,
    progress: bool = True,
) -> list[Path]:
    """Records demonstrations of a task into `out`/TASK_00, ...: each another person, furniture, room and camera.

    A recording that is there already and was made with the same settings is kept; one whose writing was interrupted is
    made anew. The same arguments make the same recordings. Returns the folders.

    Raises UnderstudyError: unknown task or sensor, bad numbers, or a folder that holds something else.
    """
    if task not in TASKS:
        raise UnderstudyError(f"task {task!r}: must be {one_of(TASKS)}")
    if demos < 1:
        raise UnderstudyError(f"demos must be 1 or more, got {demos}")
    if not 1 <= fps <= 60:
        raise UnderstudyError(f"fps must be 1 to 60, got {fps}")
    folders = []
    for number in range(demos):
        folder = Path(out) / f"{task}_{number:02d}"
        own = demonstration_seed(task, seed, number)
        settings = {"task": task, "seed": seed, "number": number, "fps": fps, "sensor": sensor, "markers": markers}
        if not _is_done(folder, settings):
            furniture = sample_furniture(task, own)
            performance = perform(furniture, own, fps)
            record_performance(
                folder,
                furniture,
                performance,
                own,
                sensor=sensor,
                markers=markers,
                settings=settings,
                progress=progress,
            )
        folders.append(folder)
    return folders


def demonstration_seed(task: str, seed: int, number: int) -> int:
    """The seed of one demonstration: another for every task, seed and number."""
    return zlib.crc32(f"{task} {seed} {number}".encode())


def record_performance(
    folder: str | Path,
    furniture: Furniture,
    performance: Performance,
    seed: int,
    *,
    sensor: str = "kinect2",
    markers: bool = False,
    settings: Mapping[str, Any] | None = None,
    progress: bool = False,
) -> Path:
    """Records one performance; `settings` are noted in its truth. Returns the folder."""
    folder = Path(folder)
    eye = Sensor(sensor, seed, fine_color=markers)
    plates = marker_setup(furniture, performance.acting) if markers else None
    scene = Scene(
        furniture, seed, performance.pieces, performance.vertices(0), () if plates is None else plates.markers
    )
    hand = performance.T_world_hand[performance.acting]
    T_world_cam = choose_viewpoint(scene, performance, hand, eye.camera, seed).T_world_cam
    times = np.asarray(performance.times_s, np.float64)
    fps = float((len(times) - 1) / (times[-1] - times[0]))
    interrupted = (folder / FACTS).exists() and not (folder / INFO).exists()
    writer = FolderWriter(folder, eye.camera, fps=fps, overwrite=interrupted)
    truth = _stage_truth(furniture, performance, seed, settings or {}, T_world_cam, plates)
    write_stage_truth(folder, truth)
    if plates is not None:
        write_atomically(folder / MARKERS, json.dumps(plates.to_json(), indent=1) + "\n")
    people: dict[int, tuple[TruthPerson, ...]] = {}
    small = eye.camera.color.scale(0.5)  # is enough to tell what hides a joint
    with Renderer(scene) as renderer:
        for i in tqdm(range(len(times)), desc=folder.name, unit="frame", disable=not progress):
            scene.pose(float(performance.q[i]), performance.vertices(i), performance.carriers(i) if markers else {})
            renderer.update()
            color = eye.photo(renderer.color(eye.camera.color, T_world_cam), i)
            depth = eye.measure(renderer.surfaces(eye.camera.depth, eye.depth_pose(T_world_cam)), i)
            writer.write(Frame(color, depth, eye.camera, i, float(times[i])))
            seen = renderer.surfaces(small, T_world_cam)
            people[i] = (_person(performance, i, eye.camera.color, small, T_world_cam, seen),)
    writer.close(Truth(people, _NOTE))
    return folder


def _is_done(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Whether this very recording is there, complete."""
    if not (folder / INFO).exists():
        return False
    if not (folder / FACTS).exists():
        raise UnderstudyError(f"{folder}: holds another recording; choose another folder")
    made = read_stage_truth(folder).settings
    if dict(made) != dict(settings):
        different = sorted(name for name in {*made, *settings} if made.get(name) != settings.get(name))
        raise UnderstudyError(f"{folder}: was recorded with another {', '.join(different)}; choose another folder")
    return True


def _stage_truth(
    furniture: Furniture,
    performance: Performance,
    seed: int,
    settings: Mapping[str, Any],
    T_world_cam: Float[np.ndarray, "4 4"],
    plates: MarkerSetup | None,
) -> StageTruth:
    q = np.asarray(performance.q, np.float64)
    return StageTruth(
        furniture,
        seed,
        settings,
        T_world_cam,
        np.asarray(performance.times_s, np.float64),
        q,
        furniture.articulation.pose(q),
        {side: np.asarray(performance.T_world_hand[side], np.float64) for side in SIDES},
        np.asarray(performance.torso_xy_yaw, np.float64),
        np.asarray(performance.joints, np.float64),
        performance.acting,
        performance.segments,
        plates,
    )


def _person(
    performance: Performance,
    i: int,
    camera: Camera,
    small: Camera,
    T_world_cam: Float[np.ndarray, "4 4"],
    seen: Surfaces,
) -> TruthPerson:
    """The person's truth in frame i, as the colour camera sees them. seen: what the same camera, made small, sees."""
    T_cam_world = inverse(T_world_cam)
    points = transform_points(T_cam_world, np.asarray(performance.joints[i], np.float64))
    in_view = camera.contains(camera.project(points))
    u, v = np.rint(np.where(in_view[:, None], small.project(points), 0.0)).astype(int).T
    u, v = u.clip(0, small.width - 1), v.clip(0, small.height - 1)
    surface, person = seen.depth[v, u], np.where(seen.person[v, u], seen.depth[v, u], np.inf)
    hidden, _ = hidden_joints(*(torch.tensor(a[None], dtype=torch.float32) for a in (surface, person, points[:, 2])))
    palms: dict[str, np.ndarray | None] = {}
    hands: dict[str, bool] = {}
    for side in SIDES:
        T = performance.T_world_hand[side][i]
        normal = T_cam_world[:3, :3] @ T[:3, 2]
        palms[side] = normal / np.linalg.norm(normal)
        hands[side] = bool(camera.contains(camera.project(transform_points(T_cam_world, T[None, :3, 3])))[0])
    return TruthPerson(0, points, in_view, hidden[0].numpy() & in_view, palms, hands)
