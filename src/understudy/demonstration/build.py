"""From the people of a recording's frames to a demonstration. `build` names the stages in order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float

import understudy
from understudy.demonstration import clock
from understudy.demonstration.actor import Candidate, in_question, reaching_hands
from understudy.demonstration.body_tracks import hand_track, hold, on_the_floor, torso_track
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.known_motion import part_points
from understudy.demonstration.object_track import ObjectTrack, by_depth, by_markers, untouched
from understudy.demonstration.scene_map import Sweep, View, occupancy, static_scene
from understudy.demonstration.segments import MOVING, find_segments, measure_motion
from understudy.errors import UnderstudyError, one_of
from understudy.floor import Floor, find_floor, world_from_camera
from understudy.geometry import inverse, transform_points
from understudy.objects.articulation import FIXED, REVOLUTE, Articulation
from understudy.objects.marker_setup import MarkerSetup, track_markers
from understudy.objects.moving_part import HandHint
from understudy.people_file import FramePeople
from understudy.recordings.base import Recording
from understudy.registration import register
from understudy.tracking import PersonTrack, frame_times, smooth
from understudy.trajectories import PoseTrack
from understudy.types import Palm, Person, RegisteredFrame
from understudy.voxels import cloud

RGBD, MARKERS = SOURCES = ("rgbd", "markers")
"""Where poses come from: `rgbd`: from depth and colour alone; `markers`: from fiducial markers."""

_VIEWS = 14  # frames that the static scene is made of
_FLOOR_VIEWS, _FLOOR_POINTS = 5, 20_000
_ENOUGH = 0.5  # share of the motion for which a hand must be known to be judged by its distance
_POSES = 24  # of the moving part, between closed and open
_BAR = 9  # points along the handle
_CACHED = 24  # decoded frames kept in memory
_SURE_M = 0.075  # sigma of a hand that may say that it has left: one that the body hides is often far off


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

    @property
    def all_markers(self) -> bool:
        """Whether nothing is taken from the depth and colour of hands and object."""
        return self.object == self.teacher == MARKERS


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
    carried = track_markers(frames, MarkerSetup.read(Path(config.markers)), T_world_cam) if config.markers else {}
    body = _Body(people, times, tracks, T_world_cam, carried)
    thing, actor = _object(frames, people, body, config)
    even, frame_times_s = clock.even_times(times, config.rate_hz), times[frames.rows(people)]
    object = clock.resample_poses(thing.track, frame_times_s, even)
    if config.teacher == MARKERS:
        hand = clock.resample_poses(_carried(body, "hand"), frame_times_s, even)
        torso = clock.resample_planar(on_the_floor(_carried(body, "torso")), frame_times_s, even)
    else:
        hand = clock.resample_poses(body.hand(actor), actor.track.times_s, even)
        torso = clock.resample_planar(torso_track(actor.track, T_world_cam), actor.track.times_s, even)
    object = untouched(object, hand)
    sure = hand.observed & (np.sqrt(np.trace(hand.covariance[:, :3, :3], axis1=1, axis2=2)) < _SURE_M)
    apart = np.where(sure, np.linalg.norm(hand.positions - object.positions, axis=1), np.nan)
    segments = find_segments(even, _way(thing.articulation, object), apart)
    if config.teacher == RGBD:
        hand = hold(hand, object, even, segments.slices(len(even))["manipulate"])
    chosen = _chosen(frames)
    views = _views(frames, people, chosen)
    if config.object == MARKERS:
        thing = replace(thing, part=part_points(views, T_world_cam, thing.track.T_world_x[chosen]))
    scene = static_scene(views, T_world_cam, _swept(thing))
    return Demonstration(
        task=config.task,
        times_s=even,
        acting=actor.side,
        hand=hand,
        torso=torso,
        object=object,
        articulation=thing.articulation,
        handle=thing.handle,
        segments=segments,
        map=occupancy(scene, views, T_world_cam, torso.xy_yaw[torso.observed, :2]),
        scene=scene,
        T_world_cam=T_world_cam,
        joints=clock.resample_points(transform_points(T_world_cam, actor.track.keypoints), actor.track.times_s, even),
        part=thing.part.astype(np.float32),
        source=_source(recording, people, floor, actor, config),
    )


@dataclass(frozen=True, eq=False)
class _Body:
    """What is known of people and markers before the object is."""

    people: Sequence[FramePeople]
    times: Float[np.ndarray, " n"]
    """of the frames, seconds; those that could not be read, too"""
    tracks: Sequence[PersonTrack]
    T_world_cam: Float[np.ndarray, "4 4"]
    carried: Mapping[str, PoseTrack]
    """by what they are on, at the times of the frames that could be read"""

    def hand(self, actor: Candidate) -> PoseTrack:
        """A hand at the times of its person's track, as the skeleton and the palms tell."""
        palms: dict[float, Palm | None] = {}
        for time, frame in zip(self.times.tolist(), self.people, strict=True):
            person = next((p for p in frame.people if p.id == actor.track.id and p.failed is None), None)
            palms[time] = None if person is None else person.hands.get(actor.side)
        own = [palms.get(time) for time in actor.track.times_s.tolist()]
        return hand_track(actor.track, own, actor.side, self.T_world_cam)


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
    frames: Frames, people: Sequence[FramePeople], body: _Body, config: DemonstrationConfig
) -> tuple[ObjectTrack, Candidate]:
    """The object, and whose hand moves it."""
    hands = reaching_hands(body.tracks, body.T_world_cam)
    try:
        if config.object == MARKERS:
            thing = by_markers(_carried(body, "object"))
        else:
            thing = _found(frames, [people[i].people for i in frames.rows(people)], body, hands)
        return thing, _who_moves(thing, body.times[frames.rows(people)], body, hands)
    except UnderstudyError as e:
        raise UnderstudyError(f"{frames.recording.path}: {e}") from e


def _found(frames: Frames, seen: Sequence[Sequence[Person]], body: _Body, hands: Sequence[Candidate]) -> ObjectTrack:
    """The object that is found best with one of the hands that may be the one that acts."""
    times = body.times[frames.rows(body.people)]
    found: list[ObjectTrack] = []
    complaints: list[UnderstudyError] = []
    for hand in in_question(hands):
        track = clock.resample_poses(body.hand(hand), hand.track.times_s, times)
        sigma = np.sqrt(np.trace(track.covariance[:, :3, :3], axis1=1, axis2=2))
        try:
            found.append(by_depth(frames, seen, body.T_world_cam, HandHint(times, track.positions, sigma)))
        except UnderstudyError as e:
            complaints.append(e)
    if not found:
        raise complaints[0]
    return max(found, key=lambda thing: thing.evidence)


def _who_moves(
    thing: ObjectTrack, times: Float[np.ndarray, " n"], body: _Body, hands: Sequence[Candidate]
) -> Candidate:
    """The hand that is at the handle while the object moves; the one that reaches most if none is seen there."""
    way = _way(thing.articulation, thing.track)
    moving = np.abs(measure_motion(times, way).speed) > MOVING
    apart = []
    for hand in hands:
        positions = clock.resample_poses(body.hand(hand), hand.track.times_s, times).positions
        away = np.linalg.norm(positions - thing.track.positions, axis=1)[moving]
        away = away[np.isfinite(away)]
        apart.append(float(np.median(away)) if len(away) >= _ENOUGH * moving.sum() and len(away) else np.inf)
    return hands[int(np.argmin(apart))]


def _carried(body: _Body, on: str) -> PoseTrack:
    """The track of what carries a marker, at the frames' times."""
    if on not in body.carried:
        raise UnderstudyError(f"there is no marker on the {on} in the file of markers")
    return body.carried[on]


def _way(articulation: Articulation, object: PoseTrack) -> Float[np.ndarray, " t"]:
    """How far the handle has gone along its way, metres; NaN where the object is not known."""
    way = np.full(len(object), np.nan)
    q = articulation.position(object.T_world_x[object.known])
    way[object.known] = q * articulation.radius_m if articulation.kind == REVOLUTE else q
    if articulation.kind == FIXED:
        way[object.known] = 0.0
    return way


def _chosen(frames: Frames) -> list[int]:
    """The frames that the static scene is made of."""
    return sorted({round(i) for i in np.linspace(0, len(frames) - 1, _VIEWS)})


def _views(frames: Frames, people: Sequence[FramePeople], chosen: Sequence[int]) -> list[View]:
    rows = frames.rows(people)
    return [View(frames[i].depth, _joints(people[rows[i]].people)) for i in chosen]


def _joints(people: Sequence[Person]) -> Float[np.ndarray, "k 18 3"]:
    return np.array([p.keypoints for p in people]).reshape(-1, 18, 3)


def _swept(thing: ObjectTrack) -> Sweep | None:
    """The moving part with its handle, from closed to open; None if nothing is known of its shape.

    A hinged part reaches to its axis, also where the person hid that.
    """
    if not len(thing.part):
        return None
    corners = np.percentile(thing.part, [1, 99], axis=0)
    if thing.articulation.kind == REVOLUTE:
        axis = transform_points(inverse(thing.articulation.T_rest), thing.articulation.point)
        corners = np.concatenate(
            [corners, np.where(np.abs(thing.articulation.in_part().direction) > 0.7, 0, axis)[None]]
        )
    low, high = thing.articulation.range
    bar = np.linspace(-0.5, 0.5, _BAR)[:, None] * [0, 0, thing.handle.length_m]
    poses = thing.articulation.pose(np.linspace(low, high, _POSES))
    return Sweep(poses, corners.min(axis=0), corners.max(axis=0), np.concatenate([thing.part, bar]))


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
