"""Palm normals beside the truth: one row per true hand in view; scores, and kinds of hands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float, Int

from understudy.metrics.angles import PALM_NEAR_RAD, angles_or_nan
from understudy.metrics.joints import mean, median, share

if TYPE_CHECKING:
    pass

BOTH: Final = "colour and depth"
ALL_GIVEN: Final = "colour and depth, all given"
DEPTH: Final = "depth"
POSTURE: Final = "posture alone"
CHECKED: Final = "colour, with checks"
LIFTED: Final = "colour landmarks on the depth"
PAPER: Final = "colour network alone (the paper's way)"
WORD: Final = "simulated colour word alone"
MAIN: Final = (BOTH, ALL_GIVEN, DEPTH)
"""Methods of the tables by kind of hand."""

HAND_M: Final = 0.19
"""metres: an adult's hand, for sizes in pixels"""
N_BINS: Final = 10
"""of the confidence"""
UNKNOWN: Final = "unknown"
"""Group of the hands for which a quantity is not known."""
_ROUNDING = 1e-9


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
    ms: Mapping[str, tuple[float, float]]
    """method -> milliseconds for both hands of one person, median and 90 %; where it was measured"""

    def errors(self, method: str) -> Float[np.ndarray, " n"]:
        """Radians; NaN where not given."""
        return angles_or_nan(self.said[method].normal, self.hands.normal)


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
        shares = ("more than 0.5 seen", "0.2 to 0.5 seen", "less than 0.2 seen")
        out["visibility"] = _known(h.visible, (h.visible <= 0.5) + 1 * (h.visible < 0.2), shares)
    else:
        out["visibility"] = _known(h.visible, 1 * (h.visible < 0.5), ("wrist seen", "wrist occluded"))
    out["distance"] = _between(h.distance_m, (2, 3, 4), ("less than 2 m", "2 to 3 m", "3 to 4 m", "4 m and more"))
    sizes = ("less than 20 px", "20 to 30 px", "30 to 40 px", "40 px and more")
    out["size"] = _between(h.pixels, (20, 30, 40), sizes)
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
