"""Palm normals of a person's hands: `HandNormalEstimator` names the stages in order."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Float32
from scipy.stats import chi

from understudy.camera import Camera
from understudy.errors import ModelFileError, UnderstudyError
from understudy.hands.color_path import SIDES, ColorPalm, ColorPath
from understudy.hands.crop import CELL, CELLS, EMPTY, GREY, PIXELS, HandView
from understudy.hands.nets import HandNets, load_nets
from understudy.hands.predictor import HandPrediction, HandPredictor, color_word, pooled
from understudy.registration import register
from understudy.skeleton import JOINT
from understudy.types import OBSERVED, Frame, Hands, Palm, Person, RegisteredFrame, Wrist

DepthCrop = Float32[np.ndarray, "2 48 48"]
"""see `HandView.depth_crop`"""

LEAST_CONFIDENCE: Final = 0.23
"""Palms below are left out."""

CONFIDENT: Final = 0.95
"""Of a palm, from which on one look is enough."""

_WRIST_SIGMA = ([0.15, 0.4, 0.6, 0.8, 0.94, 0.99], [0.10, 0.085, 0.070, 0.052, 0.042, 0.030])
"""confidence of a palm -> radius (metres) that holds 68 % of the wrist's errors: 1.3 times that of simulated hands"""
_BALL = 1.87  # radius that holds 68 % of a normal distribution in space, in sigmas along an axis
_SURE = 0.03 * _BALL  # metres: sigma of a wrist below which it is looked at again in the same place
_AGREE = np.radians(35)  # the colour path's joints are used where its normal is so near to the result
_NEIGHBOURS = np.arange(3)  # cells around a keypoint's, in a crop with a rim
_BEFORE, _BEHIND = 0.03, 0.05  # metres: a keypoint is supported by a surface from so far before to so far behind it
_PROJECTED_SCORE = 0.5  # of a 2D keypoint that is a projected 3D one, times the confidence


class HandNormalEstimator:
    """Which way the palms of an estimated person face, in the colour camera's frame.

    1. `HandView`: where the body says that a hand is, how large and how turned; left or right is the body's word.
    2. `HandView.depth_crop`, `color_crop`: depth and colour around the hand.
    3. `HandPredictor`: a network that is told all this, and the body's joints, trained to weigh it; where the fingers
       cannot be seen, what the forearm and the posture make likely is left.
    4. A hand of which it is not sure is looked at again, and `pooled` joins both looks. If the wrist is seen, the
       network is now told what the `ColorPath` says: palm detection and hand landmarks on larger crops of the colour
       image (optional). If the skeleton's wrist may be elsewhere, the view is now around the one that was found.
    """

    def __init__(
        self,
        color: bool = True,
        least_confidence: float = LEAST_CONFIDENCE,
        weights: Path | None = None,
        nets: HandNets | None = None,
    ):
        """color: use the colour image, too; where the colour path's two networks cannot be had, a warning says so and
        it is left out. least_confidence: in [0, 1]; palms that are less sure are left out. weights: an exported network
        of one's own. nets: the colour path's networks, when they are loaded already.
        """
        if not 0 <= least_confidence <= 1:
            raise UnderstudyError(f"least_confidence {least_confidence}: must be in [0, 1]")
        self.least_confidence = least_confidence
        self.predictor = HandPredictor(weights)
        self.color = color
        self.color_path: ColorPath | None = None
        if color:
            try:
                self.color_path = ColorPath(nets or load_nets())
            except ModelFileError as e:
                warnings.warn(f"palms are estimated without the colour path: {e}", stacklevel=2)

    def estimate(self, frame: Frame | RegisteredFrame, person: Person) -> Hands:
        """'left', 'right' -> Palm, or None; `Hands.why` then says why."""
        return self.estimate_all(frame, [person])[0]

    def estimate_all(self, frame: Frame | RegisteredFrame, people: Sequence[Person]) -> list[Hands]:
        """The hands of several people of one frame."""
        registered = frame if isinstance(frame, RegisteredFrame) else register(frame)
        places = [self._views(registered.camera, person) for person in people]
        hands = [_Hand(i, side, people[i], view) for i, (views, _) in enumerate(places) for side, view in views.items()]
        looks = self._looks(registered, hands)
        hands, words = self._with_second_looks(registered, hands, [word for _, word in looks])
        palms: list[dict[str, Palm]] = [{} for _ in people]
        wrists: list[dict[str, Wrist]] = [{} for _ in people]
        for hand, word, (crop, _) in zip(hands, words, looks, strict=True):
            wrists[hand.number][hand.side] = wrist_of(word)
            if word.confidence < self.least_confidence:
                why = f"too unsure: within 30 degrees with a probability of {word.confidence:.2f} only"
                places[hand.number][1][hand.side] = why
            else:
                palms[hand.number][hand.side] = hand.palm(registered.camera, word, crop)
        return [
            Hands(p.get("left"), p.get("right"), why, w) for p, w, (_, why) in zip(palms, wrists, places, strict=True)
        ]

    def _looks(self, frame: RegisteredFrame, hands: Sequence[_Hand]) -> list[tuple[DepthCrop, HandPrediction]]:
        """Of each hand, its depth crop and what the network says."""
        if not hands:
            return []
        views = [hand.view for hand in hands]
        depth = np.stack([view.depth_crop(view.points_near(frame.depth)) for view in views])
        if self.color:
            image = np.stack([view.color_crop(frame.camera, frame.color) for view in views])
        else:
            image = np.full((len(views), PIXELS, PIXELS, 3), GREY, np.uint8)
        color = np.stack([color_word(hand.view, hand.color) for hand in hands])
        return list(zip(depth, self.predictor(views, depth, color, image), strict=True))

    def _with_second_looks(
        self, frame: RegisteredFrame, hands: Sequence[_Hand], words: Sequence[HandPrediction]
    ) -> tuple[list[_Hand], list[HandPrediction]]:
        """The hands and what is said of them, after those of which the network was not sure were looked at again."""
        hands, out = list(hands), list(words)
        doubtful = [k for k, word in enumerate(words) if word.confidence < CONFIDENT]
        for k, palm in zip(doubtful, self._color_palms(frame, [hands[k] for k in doubtful]), strict=True):
            hands[k] = replace(hands[k], color=palm)
        again = [(k, hand) for k in doubtful if (hand := hands[k].again(words[k])) is not None]
        for (k, _), (_, word) in zip(again, self._looks(frame, [hand for _, hand in again]), strict=True):
            out[k] = pooled([out[k], word])
        return hands, out

    def _color_palms(self, frame: RegisteredFrame, hands: Sequence[_Hand]) -> list[ColorPalm | None]:
        """What the colour path says of hands whose wrists are seen; both hands of a person at once."""
        path = self.color_path
        if path is None:
            return [None] * len(hands)
        sought: dict[int, list[_Hand]] = {}
        for hand in hands:
            if hand.seen:
                sought.setdefault(hand.number, []).append(hand)
        found = {
            number: path.estimate(frame, of_one[0].person, [hand.side for hand in of_one])
            for number, of_one in sought.items()
        }
        return [found.get(hand.number, {}).get(hand.side) for hand in hands]

    def _views(self, camera: Camera, person: Person) -> tuple[dict[str, HandView], dict[str, str]]:
        """The view of each hand, or why there is none."""
        views: dict[str, HandView] = {}
        why: dict[str, str] = {}
        for side in SIDES:
            if person.failed is not None:
                why[side] = f"the person has no 3D joints: {person.failed}"
                continue
            view = HandView.of(person.keypoints, side, person.sigma_m)
            if view is None:
                why[side] = "the wrist or the elbow has no 3D position"
            elif not camera.contains(camera.project(person.keypoints[[JOINT[f"{side}_wrist"]]])).all():
                why[side] = "the wrist is outside the colour image"
            else:
                views[side] = view
        return views, why


def wrist_of(word: HandPrediction) -> Wrist:
    """The wrist among the network's keypoints. It was told the skeleton's and how uncertain that is, so its own is what
    both say; how far it is off goes with how sure it is of the palm.
    """
    sigma = float(np.interp(word.confidence, *_WRIST_SIGMA))
    return Wrist(word.landmarks[0], sigma, within_10_cm(sigma))


def within_10_cm(sigma_m: float) -> float:
    """Probability that a position is within 10 cm of the truth, of errors that are normal in space."""
    return float(chi.cdf(0.1 * _BALL / sigma_m, 3))


@dataclass(frozen=True, eq=False)
class _Hand:
    """One hand that is looked at."""

    number: int
    """of the person in the list"""
    side: str
    person: Person
    view: HandView
    color: ColorPalm | None = None
    """what the colour path says, where it was asked and found the palm"""

    @property
    def seen(self) -> bool:
        """Whether the camera sees the skeleton's wrist."""
        return self.person.source[JOINT[f"{self.side}_wrist"]] == OBSERVED

    @property
    def unsure(self) -> bool:
        """Whether the skeleton's wrist may be elsewhere."""
        return not self.person.sigma_m[JOINT[f"{self.side}_wrist"]] < _SURE  # NaN counts

    def again(self, word: HandPrediction) -> _Hand | None:
        """What to look at after `word`; None where a second look would be the same as the first."""
        moved = self._at(word) if self.unsure else None
        return moved or (None if self.color is None else self)

    def _at(self, word: HandPrediction) -> _Hand | None:
        """The same hand with its wrist where the network found it; None where it cannot be there."""
        joints = self.person.keypoints.copy()
        joints[JOINT[f"{self.side}_wrist"]] = word.landmarks[0]
        view = HandView.of(joints, self.side, self.person.sigma_m)
        return None if view is None else replace(self, view=view)

    def palm(self, camera: Camera, word: HandPrediction, crop: DepthCrop) -> Palm:
        """The result, from the pooled prediction. crop: of the first look."""
        projected = np.nan_to_num(camera.project(word.landmarks))
        inside = camera.contains(projected)[:, None]
        keypoints_2d = np.where(inside, np.insert(projected, 2, _PROJECTED_SCORE * word.confidence, axis=1), 0.0)
        if self.color is not None and np.arccos(np.clip(self.color.normal @ word.normal, -1, 1)) < _AGREE:
            keypoints_2d = self.color.keypoints_2d
        there = supported(self.view, crop, word.landmarks)
        keypoints = np.where(there[:, None], word.landmarks, np.nan)
        return Palm(word.normal, word.confidence, word.direction, keypoints, keypoints_2d)


def supported(view: HandView, crop: DepthCrop, landmarks: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Which keypoints (metres, colour camera's frame) have a measured surface in front of them or beside them, at about
    their depth; bool (n,). crop: `view.depth_crop`.
    """
    x, y, z = ((landmarks - view.center) @ view.R.T).T
    scale = view.distance / CELL / np.maximum(z + view.distance, CELL)
    cell = np.floor(np.stack([y, x]) * scale + CELLS / 2).astype(int)
    near = np.pad(crop[0], 1, constant_values=EMPTY)
    row, column = np.clip(cell, 0, CELLS - 1)
    around = near[(row[:, None, None] + _NEIGHBOURS[:, None]), (column[:, None, None] + _NEIGHBOURS)]
    behind = around.reshape(len(landmarks), -1) - z[:, None]
    inside = ((cell >= 0) & (cell < CELLS)).all(axis=0)
    found: np.ndarray = inside & ((behind > -_BEFORE) & (behind < _BEHIND)).any(axis=1)
    return found
