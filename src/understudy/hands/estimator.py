"""Palm normals of a person's hands: `HandNormalEstimator` names the stages in order."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.camera import Camera
from understudy.errors import ModelFileError, UnderstudyError
from understudy.hands.color_path import SIDES, ColorPalm, ColorPath
from understudy.hands.crop import CELL, HandView
from understudy.hands.nets import HandNets, load_nets
from understudy.hands.predictor import HandPrediction, HandPredictor, color_word
from understudy.skeleton import JOINT
from understudy.types import Frame, Hands, Palm, Person, RegisteredFrame

LEAST_CONFIDENCE: Final = 0.1
"""Palms below are left out."""

_AGREE = np.radians(35)  # the colour path's joints are used where its normal is so near to the result
_NEAR = 1.5  # cells: a measurement beside a keypoint
_BEFORE, _BEHIND = 0.03, 0.05  # metres: a keypoint is supported by a surface from so far before to so far behind it
_PROJECTED_SCORE = 0.5  # of a 2D keypoint that is a projected 3D one, times the confidence


class HandNormalEstimator:
    """Which way the palms of an estimated person face, in the colour camera's frame.

    1. `HandView`: where the body says that a hand is, how large and how turned; left or right is the body's word.
    2. `ColorPath`: palm detection and hand landmarks on several crops of the colour image (optional).
    3. `HandView.depth_crop`: the depth around the hand.
    4. `HandPredictor`: a network that is told the depth, the body's joints and the colour path's word, trained to weigh
       them; where the fingers cannot be seen, what the forearm and the posture make likely is left.
    """

    def __init__(
        self,
        color: bool = True,
        least_confidence: float = LEAST_CONFIDENCE,
        weights: Path | None = None,
        nets: HandNets | None = None,
    ):
        """color: use the colour image, too; where its two networks cannot be had, a warning says so and depth alone is
        used. least_confidence: in [0, 1]; palms that are less sure are left out. weights: an exported network of one's
        own. nets: the colour path's networks, when they are loaded already.
        """
        if not 0 <= least_confidence <= 1:
            raise UnderstudyError(f"least_confidence {least_confidence}: must be in [0, 1]")
        self.least_confidence = least_confidence
        self.predictor = HandPredictor(weights)
        self.color_path: ColorPath | None = None
        if color:
            try:
                self.color_path = ColorPath(nets or load_nets())
            except ModelFileError as e:
                warnings.warn(f"palms are estimated from depth alone: {e}", stacklevel=2)

    def estimate(self, frame: Frame | RegisteredFrame, person: Person) -> Hands:
        """'left', 'right' -> Palm, or None; `Hands.why` then says why."""
        return self.estimate_all(frame, [person])[0]

    def estimate_all(self, frame: Frame | RegisteredFrame, people: Sequence[Person]) -> list[Hands]:
        """The hands of several people of one frame."""
        from understudy.registration import register

        registered = frame if isinstance(frame, RegisteredFrame) else register(frame)
        places = [self._views(registered.camera, person) for person in people]
        words = [self._words(registered, person, views) for person, (views, _) in zip(people, places, strict=True)]
        flat = [(i, side, view) for i, (views, _) in enumerate(places) for side, view in views.items()]
        clouds = [view.points_near(registered.depth) for _, _, view in flat]
        depth = [view.depth_crop(cloud) for (_, _, view), cloud in zip(flat, clouds, strict=True)]
        color = [color_word(view, words[i].get(side)) for i, side, view in flat]
        said = self.predictor([view for *_, view in flat], np.stack(depth), np.stack(color)) if flat else []
        palms: list[dict[str, Palm]] = [{} for _ in people]
        for (i, side, _), cloud, word in zip(flat, clouds, said, strict=True):
            why = places[i][1]
            if word.confidence < self.least_confidence:
                why[side] = f"too unsure: within 30 degrees with a probability of {word.confidence:.2f} only"
            else:
                palms[i][side] = _palm(registered.camera, word, words[i].get(side), cloud)
        return [Hands(p.get("left"), p.get("right"), why) for p, (_, why) in zip(palms, places, strict=True)]

    def _views(self, camera: Camera, person: Person) -> tuple[dict[str, HandView], dict[str, str]]:
        """The view of each hand, or why there is none."""
        views: dict[str, HandView] = {}
        why: dict[str, str] = {}
        for side in SIDES:
            if person.failed is not None:
                why[side] = f"the person has no 3D joints: {person.failed}"
                continue
            view = HandView.of(person.keypoints, side)
            if view is None:
                why[side] = "the wrist or the elbow has no 3D position"
            elif not camera.contains(camera.project(person.keypoints[[JOINT[f"{side}_wrist"]]])).all():
                why[side] = "the wrist is outside the colour image"
            else:
                views[side] = view
        return views, why

    def _words(self, frame: RegisteredFrame, person: Person, views: dict[str, HandView]) -> dict[str, ColorPalm | None]:
        if self.color_path is None or not views:
            return {}
        return self.color_path.estimate(frame, person)


def _palm(camera: Camera, word: HandPrediction, color: ColorPalm | None, cloud: Float[np.ndarray, "n 3"]) -> Palm:
    projected = np.nan_to_num(camera.project(word.landmarks))
    inside = camera.contains(projected)
    keypoints_2d = np.column_stack([projected, np.where(inside, _PROJECTED_SCORE * word.confidence, 0.0)])
    if color is not None and np.arccos(np.clip(color.normal @ word.normal, -1, 1)) < _AGREE:
        keypoints_2d = color.keypoints_2d
    keypoints = np.where(supported(word.landmarks, cloud)[:, None], word.landmarks, np.nan)
    return Palm(word.normal, word.confidence, word.direction, keypoints, keypoints_2d)


def supported(landmarks: Float[np.ndarray, "n 3"], cloud: Float[np.ndarray, "m 3"]) -> np.ndarray:
    """Which keypoints have a measured surface beside them (seen from the camera) at about their depth; bool (n,)."""
    if not len(cloud):
        return np.zeros(len(landmarks), bool)
    apart = np.abs(landmarks[:, None, :2] / landmarks[:, None, 2:] - cloud[:, :2] / cloud[:, 2:]).max(axis=2)
    beside = apart * landmarks[:, 2:] < _NEAR * CELL
    behind = cloud[:, 2] - landmarks[:, None, 2]
    return (beside & (behind > -_BEFORE) & (behind < _BEHIND)).any(axis=1)
