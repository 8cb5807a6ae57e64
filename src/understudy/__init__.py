"""Understudy: an RGB-D camera watches a person do a task, and a robot learns to do it.

import understudy
recording = understudy.recordings.open("RECORDING")
people = understudy.Estimator().estimate(recording[0])
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from understudy import recordings
    from understudy.camera import Camera, RGBDCamera
    from understudy.errors import UnderstudyError
    from understudy.estimator import Estimator
    from understudy.types import Frame, Keypoints2D, Person

_LAZY = {
    "Camera": "understudy.camera",
    "Estimator": "understudy.estimator",
    "Frame": "understudy.types",
    "Keypoints2D": "understudy.types",
    "Person": "understudy.types",
    "RGBDCamera": "understudy.camera",
    "UnderstudyError": "understudy.errors",
}

__all__ = [
    "Camera",
    "Estimator",
    "Frame",
    "Keypoints2D",
    "Person",
    "RGBDCamera",
    "UnderstudyError",
    "__version__",
    "recordings",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    if name == "recordings":
        return import_module("understudy.recordings")
    raise AttributeError(f"module 'understudy' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
