"""From the people of a recording's frames to a demonstration. `build` names the stages in order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, overload

import numpy as np
from jaxtyping import Float

import understudy
from understudy.demonstration import clock
from understudy.demonstration.actor import Candidate, reaching_hands
from understudy.demonstration.body_tracks import hand_track, hold, torso_track
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.scene_map import View, occupancy, static_scene
from understudy.demonstration.segments import find_segments
from understudy.errors import UnderstudyError, one_of
from understudy.floor import Floor, find_floor, world_from_camera
from understudy.geometry import transform_points
from understudy.objects.articulation import FIXED, REVOLUTE, Articulation
from understudy.objects.moving_part import HandHint, MovingPart, find_moving_part
from understudy.people_file import FramePeople
from understudy.recordings.base import Recording
from understudy.registration import register
from understudy.tracking import PersonTrack, frame_times, smooth
from understudy.trajectories import PoseTrack
from understudy.types import Palm, Person, RegisteredFrame
from understudy.voxels import cloud

SOURCES: Final = ("rgbd", "markers")
"""Where poses come from: `rgbd`: from depth and colour alone; `markers`: from fiducial markers."""

_VIEWS = 14  # frames that the static scene is made of
_FLOOR_VIEWS, _FLOOR_POINTS = 5, 20_000
_CACHED = 24  # decoded frames kept in memory
_ALIKE = 0.6  # a hand that reaches at least so much as the first is tried, too


@dataclass(frozen=True)
class DemonstrationConfig:
    """How a demonstration is made; saved with it."""

    task: str = "unknown"
    """what is shown: one of TASKS, or any other name"""
    object: str = "rgbd"
    """one of SOURCES: how the object is followed"""
    teacher: str = "rgbd"
    """one of SOURCES: how hand and torso are followed"""
    markers: str | None = None
    """JSON file that says which marker is on what (docs/objects.md)"""
    rate_hz: float | None = None
    """of the demonstration's clock; the recording's rate, at least 10, if not given"""
    fps: float | None = None
    """of a recording that has no timestamps"""

    def __post_init__(self) -> None:
        for name in ("object", "teacher"):
            if getattr(self, name) not in SOURCES:
                raise UnderstudyError(f"{name} {getattr(self, name)!r}: must be {one_of(SOURCES)}")
        if "markers" in (self.object, self.teacher) and self.markers is None:
            raise UnderstudyError(
                "poses from markers need a file that says which marker is on what: markers (--markers)"
            )


def build(
    recording: Recording, people: Sequence[FramePeople], config: DemonstrationConfig | None = None
) -> Demonstration:
    """The demonstration that a recording shows.

    people: of its frames, as `pipeline.estimate_recording` gives them; frames that were skipped say so themselves.
    Raises UnderstudyError where the recording shows no demonstration: nobody, nothing that moves, no clock.
    """
    config = config or DemonstrationConfig()
    times = frame_times(people, config.fps or recording.fps)
    frames = Frames(recording, [f.index for f in people if f.skipped is None])
    floor = _floor(frames, people)
    T_world_cam = world_from_camera(floor)
    tracks = smooth(times, [f.people for f in people])
    even = clock.even_times(times, config.rate_hz)
    part, actor = _object(frames, people, times, tracks, T_world_cam, config)
    on_clock = clock.resample_poses(part.track, times[frames.rows(people)], even)
    way = _way(part.articulation, on_clock)
    hand = clock.resample_poses(_hand(actor, people, times, T_world_cam), actor.track.times_s, even)
    apart = np.where(hand.observed, np.linalg.norm(hand.positions - on_clock.positions, axis=1), np.nan)
    segments = find_segments(even, way, apart)
    hand = hold(hand, on_clock, even, segments.slices(len(even))["manipulate"])
    torso = clock.resample_planar(torso_track(actor.track, T_world_cam), actor.track.times_s, even)
    views = _views(frames, people)
    scene = static_scene(views, T_world_cam, _swept(part))
    return Demonstration(
        task=config.task,
        times_s=even,
        acting=actor.side,
        hand=hand,
        torso=torso,
        object=on_clock,
        articulation=part.articulation,
        handle=part.handle,
        segments=segments,
        map=occupancy(scene, views, T_world_cam, torso.xy_yaw[torso.observed, :2]),
        scene=scene,
        T_world_cam=T_world_cam,
        joints=clock.resample_points(transform_points(T_world_cam, actor.track.keypoints), actor.track.times_s, even),
        part=part.part_points.astype(np.float32),
        source=_source(recording, people, floor, actor, config),
    )


class Frames(Sequence[RegisteredFrame]):
    """The readable frames of a recording, registered; decoded when they are asked for, the last ones kept."""

    def __init__(self, recording: Recording, indices: Sequence[int]):
        self.recording, self.indices = recording, tuple(indices)
        self._kept: OrderedDict[int, RegisteredFrame] = OrderedDict()

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, position: int) -> RegisteredFrame: ...
    @overload
    def __getitem__(self, position: slice) -> list[RegisteredFrame]: ...
    def __getitem__(self, position: int | slice) -> RegisteredFrame | list[RegisteredFrame]:
        if isinstance(position, slice):
            return [self[i] for i in range(*position.indices(len(self)))]
        index = self.indices[position]
        if index not in self._kept:
            self._kept[index] = register(self.recording.frame(index))
            while len(self._kept) > _CACHED:
                self._kept.popitem(last=False)
        self._kept.move_to_end(index)
        return self._kept[index]

    def rows(self, people: Sequence[FramePeople]) -> np.ndarray:
        """Positions of these frames in the list of all."""
        where = {f.index: i for i, f in enumerate(people)}
        return np.array([where[i] for i in self.indices], dtype=int)


def _floor(frames: Frames, people: Sequence[FramePeople]) -> Floor:
    """From several frames at once: a person who stands before the camera hides the floor in some of them."""
    if not len(frames):
        raise UnderstudyError(f"{frames.recording.path}: no frame can be read")
    some = sorted({round(i) for i in np.linspace(0, len(frames) - 1, _FLOOR_VIEWS)})
    points = np.concatenate([cloud(frames[i].depth, _FLOOR_POINTS) for i in some])
    return find_floor(points, [p for f in people for p in f.people if p.failed is None])


def _object(
    frames: Frames,
    people: Sequence[FramePeople],
    times: Float[np.ndarray, " n"],
    tracks: Sequence[PersonTrack],
    T_world_cam: Float[np.ndarray, "4 4"],
    config: DemonstrationConfig,
) -> tuple[MovingPart, Candidate]:
    """The moving part, and whose hand moves it: of the hands that reach, the one with which a part is found best."""
    hands = reaching_hands(tracks, T_world_cam)
    hands = [h for h in hands if h.reaching_s >= _ALIKE * hands[0].reaching_s][:2]
    rows = frames.rows(people)
    seen = [people[i].people for i in rows]
    found: list[tuple[MovingPart, Candidate]] = []
    complaint: UnderstudyError | None = None
    for hand in hands:
        track = clock.resample_poses(_hand(hand, people, times, T_world_cam), hand.track.times_s, times[rows])
        sigma = np.sqrt(np.trace(track.covariance[:, :3, :3], axis1=1, axis2=2))
        hint = HandHint(times[rows], track.positions, sigma)
        try:
            found.append((find_moving_part(frames, seen, T_world_cam, hint), hand))
        except UnderstudyError as e:
            complaint = complaint or e
    if not found:
        assert complaint is not None
        raise UnderstudyError(f"{frames.recording.path}: {complaint}") from complaint
    return max(found, key=lambda pair: pair[0].quality)


def _hand(
    actor: Candidate, people: Sequence[FramePeople], times: Float[np.ndarray, " n"], T_world_cam: np.ndarray
) -> PoseTrack:
    """The hand at the times of its person's track."""
    own: dict[float, Palm | None] = {}
    for time, frame in zip(times.tolist(), people, strict=True):
        person = next((p for p in frame.people if p.id == actor.track.id), None)
        own[time] = None if person is None or person.failed is not None else person.hands.get(actor.side)
    palms = [own.get(time) for time in actor.track.times_s.tolist()]
    return hand_track(actor.track, palms, actor.side, T_world_cam)


def _way(articulation: Articulation, object: PoseTrack) -> Float[np.ndarray, " t"]:
    """How far the handle has gone along its way, metres; NaN where the object is not known."""
    way = np.full(len(object), np.nan)
    q = articulation.position(object.T_world_x[object.known])
    way[object.known] = q * articulation.radius_m if articulation.kind == REVOLUTE else q
    if articulation.kind == FIXED:
        way[object.known] = 0.0
    return way


def _views(frames: Frames, people: Sequence[FramePeople]) -> list[View]:
    some = sorted({round(i) for i in np.linspace(0, len(frames) - 1, _VIEWS)})
    rows = frames.rows(people)
    return [View(frames[i].depth, _joints(people[rows[i]].people)) for i in some]


def _joints(people: Sequence[Person]) -> Float[np.ndarray, "k 18 3"]:
    return np.array([p.keypoints for p in people]).reshape(-1, 18, 3)


def _swept(part: MovingPart) -> list[np.ndarray]:
    """The moving part in poses from closed to open, world."""
    low, high = part.articulation.range
    poses = part.articulation.pose(np.linspace(low, high, 8))
    return [transform_points(T, part.part_points.astype(np.float64)) for T in poses]


def _source(
    recording: Recording, people: Sequence[FramePeople], floor: Floor, actor: Candidate, config: DemonstrationConfig
) -> dict[str, Any]:
    return {
        "recording": str(Path(recording.path).resolve()),
        "frames": len(people),
        "frames_skipped": sum(f.skipped is not None for f in people),
        "person": int(actor.track.id),
        "floor": "seen" if floor.seen else "not seen: below the people's feet, level with the camera",
        "config": {k: v for k, v in vars(config).items() if v is not None},
        "version": understudy.__version__,
    }
