import numpy as np
import pytest

from understudy.camera import Camera, RGBDCamera
from understudy.errors import FrameError
from understudy.types import Frame


def test_frame_checks_its_arrays():
    camera = RGBDCamera.aligned(Camera.from_fov(8, 6, 1.0))
    color, depth = np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32)
    Frame(color, depth, camera)
    with pytest.raises(FrameError, match=r"color must be 8-bit RGB of shape \(6, 8, 3\)"):
        Frame(color[:4], depth, camera)
    with pytest.raises(FrameError, match="float32 metres of shape"):
        Frame(color, depth[:, :3], camera)
    depth[0, 0] = np.nan
    with pytest.raises(FrameError, match="NaN"):
        Frame(color, depth, camera)
