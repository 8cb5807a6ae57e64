"""PAGE ONE: a frame in, people out. Every stage by name, in order."""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Final

from understudy import detectors, methods
from understudy.detectors.base import Detector
from understudy.errors import UnderstudyError, one_of
from understudy.hands.estimator import HandNormalEstimator
from understudy.methods import METHODS, NAIVE
from understudy.registration import register
from understudy.types import Frame, Keypoints2D, Person, RegisteredFrame

__all__ = ["HANDS", "METHODS", "Estimator"]

HANDS: Final = ("full", "depth", "off")


class Estimator:
    """Every person of an RGB-D frame: COCO-18 joints in metres, in the colour camera's frame.

    1. `register`: depth into the colour camera's frame and pixels.
    2. `detect`: 2D keypoints of everybody in the colour image.
    3. `lift`: keypoints + depth -> 3D joints, by the chosen method. `voxelposenet` has stages of its own
       (`voxel_lifting`: root, view, network, assembly); `naive` is the baseline.
    4. `find_hands`: which way the palms face, and where exactly the wrists are that are seen (`understudy.hands`).

    Stateless: frames may come in any order, and from several threads at once. Identities over time are the business of
    `tracking`.
    """

    def __init__(
        self,
        method: str = methods.DEFAULT,
        detector: Detector | str = "blazepose",
        min_score: float = 0.2,
        weights: Path | None = None,
        hands: str = "full",
    ):
        """method: one of METHODS. detector: an object, or a name that `detectors.create` knows.

        min_score: 2D keypoints with a lower score are not used, in [0, 1]. weights: an exported network of one's own.
        hands: one of HANDS; `full` looks at colour and depth, `depth` at depth alone (no further
        model files, up to three times as fast), `off` at nothing.
        """
        if not 0 <= min_score <= 1:
            raise UnderstudyError(f"min_score {min_score}: must be in [0, 1]")
        if hands not in HANDS:
            raise UnderstudyError(f"hands {hands!r}: must be {one_of(HANDS)}")
        self.method = method
        self.min_score = min_score
        self.detector = detectors.create(detector) if isinstance(detector, str) else detector
        self._lifter = methods.create(method, min_score, weights)
        self._hands = None if hands == "off" else HandNormalEstimator(color=hands == "full")

    def with_detector(self, detector: Detector | str) -> Estimator:
        """The same with another detector; the other networks are shared, not loaded again."""
        other = copy(self)
        other.detector = detectors.create(detector) if isinstance(detector, str) else detector
        return other

    def estimate(self, frame: Frame | RegisteredFrame) -> list[Person]:
        """People of one frame, as many as the detector finds; who cannot be lifted is listed with `failed`."""
        registered = self.register(frame)
        keypoints = self.detect(registered)
        people = self.lift(registered, keypoints)
        return self.find_hands(registered, people)

    def register(self, frame: Frame | RegisteredFrame) -> RegisteredFrame:
        """Stage 1. A frame that is registered passes through."""
        return frame if isinstance(frame, RegisteredFrame) else register(frame)

    def detect(self, frame: RegisteredFrame) -> list[Keypoints2D]:
        """Stage 2. People in the colour image."""
        return self.detector.detect(frame.color, frame.depth, frame.index)

    def lift(self, frame: RegisteredFrame, keypoints: list[Keypoints2D]) -> list[Person]:
        """Stage 3. One Person for each entry of `keypoints`, numbered in that order."""
        return [person.with_id(i) for i, person in enumerate(self._lifter.lift(frame, keypoints))]

    def find_hands(self, frame: RegisteredFrame, people: list[Person]) -> list[Person]:
        """Stage 4. The same people with their palms, and (but for naive lifting) with the wrists that the look at the
        hands knows better.
        """
        if self._hands is None:
            return people
        hands = self._hands.estimate_all(frame, people)
        found = [person.with_hands(h) for person, h in zip(people, hands, strict=True)]
        if self.method == NAIVE:  # a baseline of lifted keypoints stays one
            return found
        return [person.with_wrists(h.wrists) for person, h in zip(found, hands, strict=True)]
