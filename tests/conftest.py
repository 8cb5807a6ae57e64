"""Shared fixtures. Real recordings lie outside the project: tests skip, saying so, where they are absent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from understudy import assets
from understudy.camera import Camera, RGBDCamera
from understudy.types import Frame

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def freiburg() -> Path:
    """One real Kinect v2 frame with four people."""
    path = SHARED / "freiburg_frame"
    if not path.is_dir():
        pytest.skip(f"the real recording {path} is not on this machine")
    return path


@pytest.fixture(scope="session")
def models() -> None:
    """BlazePose's model files are in the cache."""
    absent = [name for name in assets.MODELS if assets.state(name) != "ready"]
    if absent:
        pytest.skip(f"model files {absent} are not in {assets.cache_dir()}: run `understudy models fetch`")


@pytest.fixture
def camera() -> Camera:
    """A Kinect v2's colour camera at half size."""
    return Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))


@pytest.fixture
def flat_frame(camera: Camera) -> Frame:
    """A grey wall, 2 m away, registered."""
    color = np.full((540, 960, 3), 120, np.uint8)
    return Frame(color, np.full((540, 960), 2.0, np.float32), RGBDCamera.aligned(camera))
