"""HandNormalNet in use: crops, joints and the colour path's words in; palms with their uncertainty out. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.special import expit

from understudy import runtime
from understudy.errors import ModelFileError
from understudy.hands.color_path import ColorPalm
from understudy.hands.crop import CONTEXT, GREY, PIXELS, HandView

WEIGHTS: Final = "handnormalnet.onnx"
_OUTPUTS = ("normal", "direction", "landmarks", "sure")
_LEAST_SPREAD = 0.01  # radians
_DISAGREE = 0.8  # radians: predictions that differ by so much are hardly evidence for each other


@dataclass(frozen=True, eq=False)
class HandPrediction:
    """What the network says of one hand; colour camera's frame."""

    normal: Float[np.ndarray, "3"]
    """unit, out of the palm"""
    direction: Float[np.ndarray, "3"]
    """unit, from the wrist to the middle knuckle"""
    landmarks: Float[np.ndarray, "21 3"]
    """metres"""
    confidence: float
    """probability that the normal is within 30 degrees"""


def weights_path() -> Path:
    """The network that comes with the package."""
    return Path(str(resources.files("understudy.hands") / WEIGHTS))


class HandPredictor:
    """The exported network. Stateless; may be called from several threads."""

    def __init__(self, weights: Path | None = None):
        """weights: an exported network of one's own. Raises ModelFileError when it is not such a network."""
        path = weights or weights_path()
        self.network = runtime.load_rows(path, outputs=_OUTPUTS, same_bits=True)
        told = self.network.shapes.get("context")
        if told != (1, len(CONTEXT), 3):
            raise ModelFileError(
                f"{path}: a network of another version: its input 'context' has the shape {told}, not "
                f"{(1, len(CONTEXT), 3)}; train it anew (understudy train --preset hands)"
            )

    def __call__(
        self,
        views: Sequence[HandView],
        depth: Float32[np.ndarray, "n 2 48 48"],
        color: Float32[np.ndarray, "n 9"],
        image: UInt8[np.ndarray, "n 72 72 3"] | None = None,
    ) -> list[HandPrediction]:
        """depth: `HandView.depth_crop` of each view. color: `color_word` of each. image:
        `HandView.color_crop` of each; None without a colour image.
        """
        if not views:
            return []
        context = np.stack([view.context for view in views]).astype(np.float32)
        distance = np.array([[view.distance] for view in views], np.float32)
        sigma = np.stack([view.sigma for view in views]).astype(np.float32)
        if image is None:
            image = np.full((len(views), PIXELS, PIXELS, 3), GREY, np.uint8)
        picture = np.ascontiguousarray(image.transpose(0, 3, 1, 2), np.float32)
        given = {
            "depth": depth, "context": context, "distance": distance, "color": color, "sigma": sigma, "image": picture
        }  # fmt: skip
        normal, direction, landmarks, sure = (part.astype(np.float64) for part in self.network(**given))
        normal, direction = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, direction))
        return [
            HandPrediction(
                view.directions_to_cam(normal[i]),
                view.directions_to_cam(direction[i]),
                view.to_cam(landmarks[i]),
                float(expit(sure[i])),
            )
            for i, view in enumerate(views)
        ]


def pooled(words: Sequence[HandPrediction]) -> HandPrediction:
    """One prediction from those of several places where a hand may be: each counts as much as it is sure, and where
    they disagree the result is less sure. The landmarks are those of the prediction that fits the result best.
    """
    if len(words) == 1:
        return words[0]
    sure = np.array([word.confidence for word in words])
    weight = np.maximum(sure, 1e-6) / np.maximum(sure, 1e-6).sum()
    normals = np.stack([word.normal for word in words])
    normal, direction = (_mean_direction(v, weight) for v in (normals, np.stack([w.direction for w in words])))
    agreement = np.exp(-((np.arccos(np.clip(normals @ normal, -1, 1)) / _DISAGREE) ** 2))
    best = words[int(np.argmax(sure * agreement))]
    return replace(best, normal=normal, direction=direction, confidence=float(weight @ (sure * agreement)))


def _mean_direction(vectors: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    mean = weight @ vectors
    length = np.linalg.norm(mean)
    unit: np.ndarray = mean / length if length > 1e-6 else vectors[int(np.argmax(weight))]
    return unit


def color_word(view: HandView, palm: ColorPalm | None) -> Float32[np.ndarray, "9"]:
    """What the colour path says, as the network is told: normal and direction in the view, log of the spread (radians),
    its quality, and 1; zeros where it says nothing.
    """
    if palm is None:
        return np.zeros(9, np.float32)
    normal, direction = view.directions_from_cam(np.stack([palm.normal, palm.direction]))
    spread = np.log(max(palm.spread, _LEAST_SPREAD))
    return np.array([*normal, *direction, spread, palm.quality, 1.0], np.float32)
