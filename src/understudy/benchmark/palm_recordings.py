"""Palm normals of people in recordings with truth, by several methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from understudy import detectors
from understudy.camera import Camera
from understudy.errors import RecordingError
from understudy.hands.color_path import SIDES, ColorPath, hand_place, palm_normal
from understudy.hands.estimator import HandNormalEstimator
from understudy.hands.nets import HAND_SIZE, INDEX, PINKY, WRIST, HandNets
from understudy.metrics.joints import median
from understudy.metrics.matching import DEFAULT_RULE, match_people
from understudy.recordings.base import Recording
from understudy.recordings.truth import TruthPerson
from understudy.registration import register
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Palm, Person, RegisteredDepth, RegisteredFrame
from understudy.voxels import rotation_to

if TYPE_CHECKING:
    pass

from understudy.benchmark.palms import (
    ALL_GIVEN,
    BOTH,
    CHECKED,
    DEPTH,
    HAND_M,
    LIFTED,
    PAPER,
    POSTURE,
    Said,
    Source,
    TrueHands,
)

_PAPER_CROP = 0.32  # metres: side of the one crop of the paper's way, of an adult
_PALM = [0, 1, 5, 9, 13, 17]  # landmarks of the palm: wrist, thumb's root, knuckles
_BESIDE = 1  # depth pixels to each side of a landmark that are looked at

HandMethod = Callable[[RegisteredFrame, Person], Mapping[str, Palm | None]]
"""Both palms of an estimated person; None where there is none. A confidence of NaN: the method has none."""
People = Callable[[RegisteredFrame], Sequence[Person]]
"""The people of a frame."""


def recording_methods(nets: HandNets) -> dict[str, HandMethod]:
    """Methods for recordings, by name."""
    every = HandNormalEstimator(color=False, least_confidence=0)
    return {
        BOTH: HandNormalEstimator(nets=nets).estimate,
        ALL_GIVEN: HandNormalEstimator(least_confidence=0, nets=nets).estimate,
        DEPTH: HandNormalEstimator(color=False).estimate,
        POSTURE: lambda frame, person: every.estimate(without_depth(frame), person),
        CHECKED: _color_alone(nets),
        LIFTED: landmarks_on_depth(nets),
        PAPER: papers_way(nets),
    }


def without_depth(frame: RegisteredFrame) -> RegisteredFrame:
    """The same frame with nothing measured."""
    return replace(frame, depth=RegisteredDepth(np.zeros_like(frame.depth.z), frame.depth.camera))


def _color_alone(nets: HandNets) -> HandMethod:
    path = ColorPath(nets)

    def estimate(frame: RegisteredFrame, person: Person) -> dict[str, Palm | None]:
        palms = path.estimate(frame, person)
        return {side: None if p is None else Palm(p.normal, p.quality, p.direction) for side, p in palms.items()}

    return estimate


def landmarks_on_depth(nets: HandNets) -> HandMethod:
    """The colour path's wrist and knuckles, each at the median depth under it: the plane through them that the depths
    fit best, wrong ones left out. Where fewer than four have depth, nothing.
    """
    path = ColorPath(nets)

    def estimate(frame: RegisteredFrame, person: Person) -> dict[str, Palm | None]:
        out: dict[str, Palm | None] = dict.fromkeys(SIDES)
        for side, palm in path.estimate(frame, person).items():
            if palm is not None:
                points = _under(frame, palm.keypoints_2d[_PALM, :2])
                points = points[np.isfinite(points).all(axis=1)]
                if len(points) >= 4:
                    normal = _plane(points)
                    out[side] = Palm(normal * np.sign(normal @ palm.normal), float("nan"))
        return out

    return estimate


def _under(frame: RegisteredFrame, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Points at the median depth around image points; NaN rows where there is none."""
    depth = frame.depth
    at = np.rint((uv + 0.5) * depth.scale_to(frame.camera) - 0.5).astype(int)
    steps = np.arange(-_BESIDE, _BESIDE + 1)
    v = np.clip(at[:, 1, None, None] + steps[:, None], 0, depth.camera.height - 1)
    u = np.clip(at[:, 0, None, None] + steps[None], 0, depth.camera.width - 1)
    z = depth.z[v, u].reshape(len(uv), -1).astype(np.float64)
    filled = np.where(z > 0, z, np.nan)
    known = np.isfinite(filled).any(axis=1)
    out = np.full((len(uv), 3), np.nan)
    if known.any():
        out[known] = frame.camera.unproject(uv[known], np.nanmedian(filled[known], axis=1))
    return out


def _plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Unit normal of the plane through points, reweighted by Cauchy's function (1.5 cm)."""
    weight = np.ones(len(points))
    normal = np.zeros(3)
    for _ in range(10):
        center = np.average(points, axis=0, weights=weight)
        normal = np.linalg.svd((points - center) * np.sqrt(weight)[:, None], full_matrices=False)[2][2]
        weight = 1 / (1 + ((points - center) @ normal / 0.015) ** 2)
    return normal


def papers_way(nets: HandNets) -> HandMethod:
    """One crop where the body says that the hand is, nothing detected, nothing checked: the normal of the network's own
    3D hand.
    """

    def estimate(frame: RegisteredFrame, person: Person) -> dict[str, Palm | None]:
        out: dict[str, Palm | None] = dict.fromkeys(SIDES)
        for side in SIDES:
            place = hand_place(frame.camera, person, side)
            if place is None:
                continue
            region = replace(place.window, size=_PAPER_CROP * place.scale * place.metre)
            (look,) = nets.landmarks([region.crop(frame.color, HAND_SIZE)], [region])
            ray = frame.camera.unproject(look.uv[[WRIST, INDEX, PINKY]].mean(0), 1.0)
            normal = palm_normal(look.world @ rotation_to(ray / np.linalg.norm(ray)), side)
            if np.isfinite(normal).all():
                out[side] = Palm(normal, float("nan"))
        return out

    return estimate


def with_palms(opened: Sequence[Recording]) -> list[Recording]:
    """The same recordings. Raises RecordingError where one has no truth, or no true palm in view."""
    for recording in opened:
        path = recording.path / "truth.json"
        truth = recording.truth
        if truth is None:
            raise RecordingError(f"{path}: no such file; the benchmark of palms needs the truth (as 'sample' has it)")
        if not any(_in_view(p, side) for people in truth.frames.values() for p in people for side in SIDES):
            raise RecordingError(
                f"{path}: no palm in view; 'hands' of its people must be such as "
                "{'left': {'normal': [0, 0, -1], 'in_view': true}, 'right': null}"
            )
    return list(opened)


def from_recordings(
    opened: Sequence[Recording],
    methods: Mapping[str, HandMethod],
    people_of: Callable[[Recording], People],
    detector: str,
    progress: bool = True,
) -> Source:
    """All true hands in view of recordings with true palms; those of people whom the detector misses, too.

    people_of: see `estimators`. detector: what the report calls it. Frames that cannot be read count as frames without
    people found.
    """
    every = with_palms(opened)
    parts = [
        _from_recording(i, recording, methods, people_of(recording), progress) for i, recording in enumerate(every)
    ]
    notes = [
        f"{recording.name} ({part.people} people in {part.frames} frames, {part.missed} of them missed)"
        for recording, part in zip(every, parts, strict=True)
    ]
    notes += [note for part in parts for note in part.notes]
    return Source(
        title="Recordings with truth",
        slug="recordings",
        names=tuple(r.name for r in every),
        simulated=False,
        hands=TrueHands.pooled([p.hands for p in parts]),
        said={m: Said.pooled([p.said[m] for p in parts]) for m in methods},
        about=f"{'; '.join(notes)}. 2D keypoints: {detector}.",
        ms={m: _median_and_most(np.array([t for p in parts for t in p.ms[m]])) for m in methods},
    )


def _median_and_most(times: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Median and 90 %; NaN of none."""
    return median(times), float(np.quantile(times, 0.9)) if len(times) else float("nan")


def estimators(detector: str) -> Callable[[Recording], People]:
    """What estimates the people of a recording, without hands. detector: a name that `detectors.create` knows."""
    from understudy.estimator import Estimator

    if detector == "recording":
        return lambda recording: Estimator(detector=detectors.create(detector, recording), hands="off").estimate
    one = Estimator(detector=detector, hands="off")
    return lambda recording: one.estimate


@dataclass(frozen=True, eq=False)
class _Part:
    """One recording."""

    hands: TrueHands
    said: dict[str, Said]
    ms: dict[str, list[float]]
    frames: int
    people: int
    missed: int
    notes: list[str]


def _from_recording(
    number: int, recording: Recording, methods: Mapping[str, HandMethod], people_of: People, progress: bool
) -> _Part:
    from tqdm import tqdm

    truth = recording.truth
    assert truth is not None
    rows: list[tuple[object, ...]] = []
    said: dict[str, list[Palm | None]] = {m: [] for m in methods}
    ms: dict[str, list[float]] = {m: [] for m in methods}
    notes: list[str] = []
    counted = missed = 0
    for index in tqdm(sorted(truth.frames), unit="frame", desc=recording.name, disable=not progress):
        people, frame = truth.frames[index], None
        found: list[Person | None] = [None] * len(people)
        try:
            frame = register(recording.frame(index))
        except RecordingError as e:
            notes.append(f"not read: {e}")
        else:
            found = _matched(people_of(frame), people)
        for person, estimate in zip(people, found, strict=True):
            if not _counts(person):
                continue
            counted, missed = counted + 1, missed + (estimate is None)
            sides = [side for side in SIDES if _in_view(person, side)]
            rows += [_true_hand(number, recording.camera.color, person, side) for side in sides]
            for method, palms in _palms(methods, frame, estimate, ms).items():
                said[method] += [palms.get(side) for side in sides]
    return _Part(
        _true_hands(rows), {m: _said(p) for m, p in said.items()}, ms, len(truth.frames), counted, missed, notes
    )


def _counts(person: TruthPerson) -> bool:
    """Whether a true person counts (`MatchRule`)."""
    known = int(np.isfinite(person.keypoints).all(1).sum())
    return known >= DEFAULT_RULE.min_near and int(person.in_view.sum()) >= DEFAULT_RULE.min_in_view


def _in_view(person: TruthPerson, side: str) -> bool:
    return person.palms.get(side) is not None and person.hands_in_view.get(side, False)


def _matched(estimated: Sequence[Person], people: Sequence[TruthPerson]) -> list[Person | None]:
    """The estimated person of each true one, by the benchmark's rule for joints."""
    lifted = [p for p in estimated if p.failed is None]
    predicted = np.array([p.keypoints for p in lifted]).reshape(-1, N_JOINTS, 3)
    true = np.array([p.keypoints for p in people]).reshape(-1, N_JOINTS, 3)
    person_of = {int(t): lifted[p] for p, t in match_people(predicted, true)}
    return [person_of.get(i) for i in range(len(people))]


def _palms(
    methods: Mapping[str, HandMethod], frame: RegisteredFrame | None, person: Person | None, ms: dict[str, list[float]]
) -> dict[str, Mapping[str, Palm | None]]:
    """What each method says of a person; its milliseconds go to `ms` if both hands can be looked at.

    The first person is looked at once before, so that the networks are warm.
    """
    if frame is None or person is None:
        return {method: {} for method in methods}
    out, took = {}, {}
    for method, estimate in methods.items():
        if not ms[method]:
            estimate(frame, person)
        start = perf_counter()
        out[method] = estimate(frame, person)
        took[method] = 1000 * (perf_counter() - start)
    if all(any(palms.get(side) is not None for palms in out.values()) for side in SIDES):
        for method, value in took.items():
            ms[method].append(value)
    return out


def _true_hand(number: int, camera: Camera, person: TruthPerson, side: str) -> tuple[object, ...]:
    """A row of `TrueHands`."""
    joint = JOINT[f"{side}_wrist"]
    wrist, normal = person.keypoints[joint], person.palms[side]
    assert normal is not None
    distance = float(np.linalg.norm(wrist))
    facing = float(normal @ wrist) / distance
    seen = 0.0 if person.occluded[joint] else 1.0
    return number, normal, distance, HAND_M * camera.fx / float(wrist[2]), facing, seen, -1


def _true_hands(rows: Sequence[tuple[object, ...]]) -> TrueHands:
    kinds = (np.int64, np.float64, np.float64, np.float64, np.float64, np.float64, np.int64)
    number, normal, *rest = (np.array([row[i] for row in rows], kind) for i, kind in enumerate(kinds))
    return TrueHands(number, normal.reshape(-1, 3), *rest)


def _said(palms: Sequence[Palm | None]) -> Said:
    nothing = np.full(3, np.nan)
    normal = np.array([nothing if p is None else p.normal for p in palms], np.float64).reshape(-1, 3)
    return Said(normal, np.array([np.nan if p is None else p.confidence for p in palms], np.float64))
