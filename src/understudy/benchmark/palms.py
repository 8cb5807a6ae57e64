"""Palm normals beside the truth: one row per true hand in view, from recordings and from simulated hands in detail."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import count
from time import perf_counter
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.special import expit

from understudy import detectors
from understudy.camera import Camera
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.hands.color_path import SIDES, ColorPath, _turn_to, hand_place, palm_normal
from understudy.hands.crop import EMPTY
from understudy.hands.estimator import LEAST_CONFIDENCE, HandNormalEstimator
from understudy.hands.nets import HAND_SIZE, INDEX, PINKY, WRIST, HandNets
from understudy.metrics.angles import PALM_NEAR_RAD, angles_or_nan
from understudy.metrics.joints import mean, median, share
from understudy.metrics.matching import DEFAULT_RULE, match_people
from understudy.recordings.base import Recording
from understudy.recordings.truth import TruthPerson
from understudy.registration import register
from understudy.skeleton import JOINT, N_JOINTS
from understudy.types import Palm, Person, RegisteredDepth, RegisteredFrame

if TYPE_CHECKING:
    import torch

BOTH: Final = "colour and depth"
ALL_GIVEN: Final = "colour and depth, all given"
DEPTH: Final = "depth"
POSTURE: Final = "posture alone"
CHECKED: Final = "colour, with checks"
PAPER: Final = "colour network alone (the paper's way)"
WORD: Final = "simulated colour word alone"
MAIN: Final = (ALL_GIVEN, DEPTH)
"""Methods of the tables by kind of hand."""

HAND_M: Final = 0.19
"""metres: an adult's hand, for sizes in pixels"""
N_BINS: Final = 10
"""of the confidence"""
UNKNOWN: Final = "unknown"
"""Group of the hands for which a quantity is not known."""

BODIES, HANDS, BANK_SEED, SEED = 60, 40, 2001, 4242
"""The simulated hands: different bodies and hands, the seed of both banks, and that of everything else. Training has
the seeds 1 and 0, its validation 1001 and 900."""

_BATCH = 64  # simulated hands at a time
_ASKED = 512  # hands that the network is asked at a time
_PAPER_CROP = 0.32  # metres: side of the one crop of the paper's way, of an adult
_ROUNDING = 1e-9

HandMethod = Callable[[RegisteredFrame, Person], Mapping[str, Palm | None]]
"""Both palms of an estimated person; None where there is none. A confidence of NaN: the method has none."""
People = Callable[[RegisteredFrame], Sequence[Person]]
"""The people of a frame."""


@dataclass(frozen=True, eq=False)
class TrueHands:
    """n true hands in view."""

    recording: Int[np.ndarray, " n"]
    """number of the recording in `Source.names`; 0 for simulated hands"""
    normal: Float[np.ndarray, "n 3"]
    """unit, out of the palm; colour camera's frame (recordings) or that of the crop view (simulated)"""
    distance_m: Float[np.ndarray, " n"]
    """from the colour camera to the wrist"""
    pixels: Float[np.ndarray, " n"]
    """size of a hand of HAND_M at this place, in pixels of the colour (recordings) or the depth camera (simulated)"""
    facing: Float[np.ndarray, " n"]
    """cosine between the normal and the ray to the wrist; -1: the palm faces the camera"""
    visible: Float[np.ndarray, " n"]
    """share of the hand's near surface that is seen (simulated); 0 where the wrist is occluded, else 1 (recordings)"""
    grip: Int[np.ndarray, " n"]
    """0 free, 1 grips a bar, 2 holds a flat thing; -1 where not known"""

    @classmethod
    def pooled(cls, parts: Sequence[TrueHands]) -> TrueHands:
        """One after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass(frozen=True, eq=False)
class Said:
    """What a method says of the n hands."""

    normal: Float[np.ndarray, "n 3"]
    """NaN where not given"""
    confidence: Float[np.ndarray, " n"]
    """NaN where not given, or where the method has none"""

    @classmethod
    def pooled(cls, parts: Sequence[Said]) -> Said:
        """One after the other."""
        return cls(np.concatenate([p.normal for p in parts]), np.concatenate([p.confidence for p in parts]))


@dataclass(frozen=True, eq=False)
class Source:
    """True hands and what every method says of them."""

    title: str
    slug: str
    """begins the names of its plots"""
    names: tuple[str, ...]
    """of the recordings"""
    simulated: bool
    hands: TrueHands
    said: Mapping[str, Said]
    about: str
    """where the hands come from, a sentence or two"""
    ms: Mapping[str, float]
    """method -> milliseconds for both hands of one person (median); where it was measured"""

    def errors(self, method: str) -> Float[np.ndarray, " n"]:
        """Radians; NaN where not given."""
        return angles_or_nan(self.said[method].normal, self.hands.normal)


# --- scores ---


@dataclass(frozen=True, eq=False)
class PalmCalibration:
    """Confidence against the share within 30 degrees, of the hands with a confidence."""

    error: float
    """mean over the bins, weighted by hands, of |mean confidence - share within 30 degrees|; NaN of nothing"""
    bin_confidence: Float[np.ndarray, "10"]
    """mean confidence in each of 10 equally wide bins; NaN in an empty one"""
    bin_share: Float[np.ndarray, "10"]
    """share within 30 degrees; NaN in an empty one"""
    bin_count: Int[np.ndarray, "10"]
    """hands"""

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"]) -> PalmCalibration:
        """From errors (radians; NaN where not given) and confidences (NaN where there is none)."""
        known = ~(np.isnan(errors) | np.isnan(confidence))
        sure, right = confidence[known], within_30(errors[known])
        bin_of = np.minimum((sure * N_BINS).astype(int), N_BINS - 1)
        counted = np.bincount(bin_of, minlength=N_BINS)
        some = np.where(counted > 0, counted, np.nan)
        claimed, found = (np.bincount(bin_of, of.astype(float), N_BINS) / some for of in (sure, right))
        gaps = np.nan_to_num(np.abs(claimed - found))
        error = float(gaps @ counted / counted.sum()) if counted.any() else float("nan")
        return cls(error, claimed, found, counted)


@dataclass(frozen=True, eq=False)
class PalmScore:
    """One method on a set of hands; NaN of nothing."""

    n: int
    """true hands in view"""
    coverage: float
    """share of them for which there is a normal"""
    mean_rad: float
    """of the given normals, as all below"""
    median_rad: float
    within_30_deg: float
    flipped: float
    """share more than 90 degrees off"""
    calibration: PalmCalibration

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"]) -> PalmScore:
        """From errors (radians; NaN where not given) and confidences (NaN where there is none)."""
        given = errors[~np.isnan(errors)]
        return cls(
            n=len(errors),
            coverage=share(~np.isnan(errors)),
            mean_rad=mean(given),
            median_rad=median(given),
            within_30_deg=share(within_30(given)),
            flipped=share(given > np.pi / 2 + _ROUNDING),
            calibration=PalmCalibration.of(errors, confidence),
        )


def within_30(errors: Float[np.ndarray, " n"]) -> np.ndarray:
    """Which errors (radians) are at most 30 degrees; bool (n,)."""
    return np.asarray(errors <= PALM_NEAR_RAD + _ROUNDING)


def score(source: Source, method: str, rows: np.ndarray | None = None) -> PalmScore:
    """Of a method; rows: bool (n,), the hands that count (default: all)."""
    chosen = np.ones(len(source.hands.normal), bool) if rows is None else rows
    return PalmScore.of(source.errors(method)[chosen], source.said[method].confidence[chosen])


# --- kinds of hands ---


@dataclass(frozen=True, eq=False)
class Groups:
    """Every hand is in exactly one group."""

    labels: tuple[str, ...]
    of: Int[np.ndarray, " n"]
    """number of each hand's group in `labels`"""


def groups(source: Source) -> dict[str, Groups]:
    """What the hands are grouped by -> groups."""
    h = source.hands
    out = {"recording": Groups(source.names, h.recording)} if len(source.names) > 1 else {}
    if source.simulated:
        labels = ("more than 0.5 seen", "0.2 to 0.5 seen", "less than 0.2 seen")
        out["visibility"] = _known(h.visible, (h.visible <= 0.5) + 1 * (h.visible < 0.2), labels)
    else:
        out["visibility"] = _known(h.visible, 1 * (h.visible < 0.5), ("wrist seen", "wrist occluded"))
    out["distance"] = _between(h.distance_m, (2, 3, 4), ("less than 2 m", "2 to 3 m", "3 to 4 m", "4 m and more"))
    labels = ("less than 20 px", "20 to 30 px", "30 to 40 px", "40 px and more")
    out["size"] = _between(h.pixels, (20, 30, 40), labels)
    out["view"] = _between(h.facing, (-0.5, 0.5), ("palm", "side", "back"))
    if source.simulated:
        out["grip"] = _known(np.where(h.grip < 0, np.nan, 0), h.grip, ("free", "bar", "flat"))
    return out


def _between(values: Float[np.ndarray, " n"], edges: Sequence[float], labels: tuple[str, ...]) -> Groups:
    """Groups between edges; a value at an edge is in the group above."""
    return _known(values, np.digitize(values, edges), labels)


def _known(values: Float[np.ndarray, " n"], of: Int[np.ndarray, " n"], labels: tuple[str, ...]) -> Groups:
    """The groups `of`, but UNKNOWN where the value is NaN."""
    return Groups((*labels, UNKNOWN), np.where(np.isnan(values), len(labels), of))


# --- recordings ---


def recording_methods(nets: HandNets) -> dict[str, HandMethod]:
    """Methods for recordings, by name."""
    every = HandNormalEstimator(color=False, least_confidence=0)
    return {
        BOTH: HandNormalEstimator(nets=nets).estimate,
        ALL_GIVEN: HandNormalEstimator(least_confidence=0, nets=nets).estimate,
        DEPTH: HandNormalEstimator(color=False).estimate,
        POSTURE: lambda frame, person: every.estimate(without_depth(frame), person),
        CHECKED: _color_alone(nets),
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
            normal = palm_normal(look.world @ _turn_to(ray).T, side)
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
        ms={m: median(np.array([t for p in parts for t in p.ms[m]])) for m in methods},
    )


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


# --- simulated hands ---


@dataclass(frozen=True, eq=False)
class SimulatedHands:
    """n simulated hands in view: truth, and the network's inputs."""

    hands: TrueHands
    depth: Float32[np.ndarray, "n 2 48 48"]
    context: Float32[np.ndarray, "n 7 3"]
    distance: Float32[np.ndarray, "n 1"]
    color: Float32[np.ndarray, "n 9"]
    """simulated words of the colour path"""


def simulate(n: int, progress: bool = True) -> SimulatedHands:
    """The first n hands in view of people and scenes that neither training nor validation has. Needs torch and anny."""
    from tqdm import tqdm

    try:
        import torch

        from understudy.hands.training import colored
        from understudy.synthetic.bodies import load_bank
        from understudy.synthetic.draw import Draw
        from understudy.synthetic.hand_bank import load_hands
        from understudy.synthetic.hand_samples import HandBatch, HandSamples

        samples = HandSamples(load_bank("anny", BODIES, BANK_SEED), load_hands(HANDS, BANK_SEED), seed=SEED)
    except ImportError as e:
        if (e.name or "").partition(".")[0] == "understudy":
            raise
        raise MissingExtraError("simulated hands (--hands 0 goes without)", "train") from e
    parts: list[HandBatch] = []
    words: list[torch.Tensor] = []
    made = 0
    with tqdm(total=n, unit="hand", desc="simulated hands", disable=not progress) as bar:
        for number in count():
            if made >= n:
                break
            batch = samples.batch(number, _BATCH)
            color = colored(Draw(SEED * 31 + number), batch)
            parts.append(HandBatch(*(t[batch.in_view] for t in batch)))
            words.append(color[batch.in_view])
            made += len(words[-1])
            bar.update(min(made, n) - bar.n)
    arrays = {name: torch.cat([getattr(p, name) for p in parts])[:n].numpy() for name in HandBatch._fields}
    wrist = arrays["landmarks"][:, WRIST].astype(np.float64)
    wrist[:, 2] += arrays["distance"][:, 0]
    return SimulatedHands(
        _simulated_truth(wrist, arrays),
        arrays["depth"],
        arrays["context"],
        arrays["distance"],
        torch.cat(words)[:n].numpy(),
    )


def _simulated_truth(wrist: Float[np.ndarray, "n 3"], arrays: Mapping[str, np.ndarray]) -> TrueHands:
    """wrist: metres, in the crop view seen from the camera."""
    normal = arrays["normal"].astype(np.float64)
    distance = np.linalg.norm(wrist, axis=1)
    return TrueHands(
        recording=np.zeros(len(wrist), np.int64),
        normal=normal,
        distance_m=distance,
        pixels=arrays["pixels"].astype(np.float64),
        facing=np.einsum("ni,ni->n", normal, wrist) / distance,
        visible=arrays["visible"].astype(np.float64),
        grip=arrays["grip"].astype(np.int64),
    )


HandNetwork = Callable[..., Sequence[np.ndarray]]
"""Called as `HandPredictor.network` is."""


def from_simulation(simulated: SimulatedHands, network: HandNetwork) -> Source:
    """What the exported network says of simulated hands."""
    n = len(simulated.depth)
    if not n:
        raise UnderstudyError("simulated hands: there are none; at least 1 is needed")
    blind = np.zeros_like(simulated.depth)
    blind[:, 0] = EMPTY
    mute = np.zeros_like(simulated.color)
    every = _ask(network, simulated, simulated.depth, simulated.color)
    word, given = simulated.color.astype(np.float64), simulated.color[:, 8] > 0
    said = {
        BOTH: least_sure(every),
        ALL_GIVEN: every,
        DEPTH: least_sure(_ask(network, simulated, simulated.depth, mute)),
        POSTURE: _ask(network, simulated, blind, mute),
        WORD: Said(np.where(given[:, None], word[:, :3], np.nan), np.where(given, word[:, 7], np.nan)),
    }
    about = (
        f"{n} hands in view of simulated people, hands and scenes that neither training nor validation has seen "
        f"({BODIES} bodies, {HANDS} different hands), as they are put to the exported network: depth crops with a "
        "sensor's errors, joints with an estimate's errors, and words of the colour path with its measured errors."
    )
    return Source("Simulated hands in detail", "simulated", (), True, simulated.hands, said, about, {})


def _ask(
    network: HandNetwork,
    hands: SimulatedHands,
    depth: Float32[np.ndarray, "n 2 48 48"],
    color: Float32[np.ndarray, "n 9"],
) -> Said:
    parts = []
    for start in range(0, len(depth), _ASKED):
        rows = slice(start, start + _ASKED)
        normal, _, _, _, sure = network(
            depth=depth[rows], context=hands.context[rows], distance=hands.distance[rows], color=color[rows]
        )
        parts.append(Said(normal.astype(np.float64), expit(sure.astype(np.float64))))
    return Said.pooled(parts)


def least_sure(said: Said, least: float = LEAST_CONFIDENCE) -> Said:
    """Without the palms of a confidence below `least`."""
    given = said.confidence >= least
    return Said(np.where(given[:, None], said.normal, np.nan), np.where(given, said.confidence, np.nan))
