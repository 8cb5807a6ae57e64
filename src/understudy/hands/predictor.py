"""HandNormalNet in use: crops, joints and the colour path's words in; palms with their uncertainty out. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import expit

from understudy import runtime
from understudy.hands.color_path import ColorPalm
from understudy.hands.crop import HandView

WEIGHTS: Final = "handnormalnet.onnx"
_OUTPUTS = ("normal", "direction", "log_kappa", "landmarks", "sure")
_LEAST_SPREAD = 0.01  # radians


@dataclass(frozen=True, eq=False)
class HandPrediction:
    """What the network says of one hand; colour camera's frame."""

    normal: Float[np.ndarray, "3"]
    """unit, out of the palm"""
    direction: Float[np.ndarray, "3"]
    """unit, from the wrist to the middle knuckle"""
    landmarks: Float[np.ndarray, "21 3"]
    """metres"""
    concentration: Float[np.ndarray, "2"]
    """kappa of the von Mises-Fisher distributions of normal and direction"""
    confidence: float
    """probability that the normal is within 30 degrees"""


def weights_path() -> Path:
    """The network that comes with the package."""
    return Path(str(resources.files("understudy.hands") / WEIGHTS))


class HandPredictor:
    """The exported network. Stateless; may be called from several threads."""

    def __init__(self, weights: Path | None = None, threads: int | None = None):
        self.network = runtime.load(weights or weights_path(), threads=threads, outputs=_OUTPUTS)

    def __call__(
        self,
        views: Sequence[HandView],
        depth: Float32[np.ndarray, "n 2 48 48"],
        color: Float32[np.ndarray, "n 9"],
    ) -> list[HandPrediction]:
        """depth: `HandView.depth_crop` of each view. color: `color_word` of each."""
        if not views:
            return []
        context = np.stack([view.context for view in views]).astype(np.float32)
        distance = np.array([[view.distance] for view in views], np.float32)
        said = self.network(depth=depth, context=context, distance=distance, color=color)
        normal, direction, kappa, landmarks, sure = (part.astype(np.float64) for part in said)
        normal, direction = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (normal, direction))
        return [
            HandPrediction(
                view.directions_to_cam(normal[i]),
                view.directions_to_cam(direction[i]),
                view.to_cam(landmarks[i]),
                np.exp(kappa[i]),
                float(expit(sure[i])),
            )
            for i, view in enumerate(views)
        ]


def color_word(view: HandView, palm: ColorPalm | None) -> Float32[np.ndarray, "9"]:
    """What the colour path says, as the network is told: normal and direction in the view, log of the spread (radians),
    its quality, and 1; zeros where it says nothing.
    """
    if palm is None:
        return np.zeros(9, np.float32)
    normal, direction = view.directions_from_cam(np.stack([palm.normal, palm.direction]))
    spread = np.log(max(palm.spread, _LEAST_SPREAD))
    return np.array([*normal, *direction, spread, palm.quality, 1.0], np.float32)
