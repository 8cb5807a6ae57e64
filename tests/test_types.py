import numpy as np
import pytest

from understudy.camera import Camera, RGBDCamera
from understudy.errors import FrameError, UnderstudyError
from understudy.types import Frame, Keypoints2D, RegisteredDepth, RegisteredFrame


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


def test_timestamps_are_plain_finite_seconds():
    camera = RGBDCamera.aligned(Camera.from_fov(8, 6, 1.0))
    color, depth = np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32)
    assert type(Frame(color, depth, camera, 0, np.float64(0.5)).timestamp_s) is float  # type: ignore[arg-type]
    with pytest.raises(FrameError, match="finite number of seconds"):
        Frame(color, depth, camera, 0, float("nan"))


def test_registered_frames_check_their_arrays():
    camera = Camera.from_fov(8, 6, 1.0)
    depth = RegisteredDepth(np.ones((6, 8), np.float32), camera)
    with pytest.raises(FrameError, match="color must be 8-bit RGB"):
        RegisteredFrame(np.zeros((5, 8, 3), np.uint8), camera, depth)
    with pytest.raises(FrameError, match="must be float32 metres of shape"):
        RegisteredDepth(np.ones((6, 7), np.float32), camera)


def test_keypoints_check_themselves():
    uv, score = np.zeros((18, 2)), np.ones(18)
    with pytest.raises(UnderstudyError, match="scores in"):
        Keypoints2D(uv, 7 * score)
    uv[3] = np.nan
    with pytest.raises(UnderstudyError, match="must be finite"):
        Keypoints2D(uv, score)
    assert not Keypoints2D.where(uv, score).found[3]
