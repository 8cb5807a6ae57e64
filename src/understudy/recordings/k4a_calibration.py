"""The factory calibration inside an Azure Kinect recording -> cameras of the recorded modes.

The calibration describes two full sensors, with K as shares of their width and height: depth 1024 x 1024, colour
4096 x 3072. Each mode reads the sensor out at some resolution (binning, scaling) and cuts a part out of it. A share of
the sensor counts from the sensor's edge, hence the half pixel between it and our pixel centres. (That is what
Microsoft's SDK does too.)
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from understudy.camera import Camera, RGBDCamera
from understudy.errors import RecordingError, one_of
from understudy.geometry import inverse, rigid


@dataclass(frozen=True)
class Mode:
    """How a mode's image lies in the sensor; all in the pixels of the mode."""

    sensor: tuple[int, int]
    """width and height of the whole sensor, after binning or scaling"""
    offset: tuple[int, int]
    """left and top of the image in it"""
    size: tuple[int, int]
    """width and height of the image"""


DEPTH_MODES = {
    "NFOV_2X2BINNED": Mode((512, 512), (96, 90), (320, 288)),
    "NFOV_UNBINNED": Mode((1024, 1024), (192, 180), (640, 576)),
    "WFOV_2X2BINNED": Mode((512, 512), (0, 0), (512, 512)),
    "WFOV_UNBINNED": Mode((1024, 1024), (0, 0), (1024, 1024)),
}
COLOR_MODES = {  # 16:9 modes leave out an eighth of the 4:3 sensor above and below
    "720P": Mode((1280, 960), (0, 120), (1280, 720)),
    "1080P": Mode((1920, 1440), (0, 180), (1920, 1080)),
    "1440P": Mode((2560, 1920), (0, 240), (2560, 1440)),
    "1536P": Mode((2048, 1536), (0, 0), (2048, 1536)),
    "2160P": Mode((3840, 2880), (0, 360), (3840, 2160)),
    "3072P": Mode((4096, 3072), (0, 0), (4096, 3072)),
}

_LENS = "CALIBRATION_LensDistortionModelBrownConrady"


def camera_from_calibration(
    content: bytes, color_size: tuple[int, int], depth_size: tuple[int, int], where: str
) -> RGBDCamera:
    """The cameras for images of these sizes (width, height). Raises RecordingError that begins with `where`."""
    color_mode = _mode_of(color_size, COLOR_MODES, f"{where}: colour")
    depth_mode = _mode_of(depth_size, DEPTH_MODES, f"{where}: depth")
    try:
        cameras = json.loads(content.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        by_place = {c["Location"]: c for c in cameras}
        depth, color = by_place["CALIBRATION_CameraLocationD0"], by_place["CALIBRATION_CameraLocationPV0"]
        T_color_depth = _T_camera_rig(color) @ inverse(_T_camera_rig(depth))
        return RGBDCamera(
            _camera(color, color_mode, f"{where}: calibration of the colour camera"),
            _camera(depth, depth_mode, f"{where}: calibration of the depth camera"),
            T_color_depth,
        )
    except RecordingError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError, OverflowError, np.linalg.LinAlgError) as e:
        raise RecordingError(f"{where}: the calibration in the file cannot be read: {type(e).__name__}: {e}") from e


def _mode_of(size: tuple[int, int], modes: Mapping[str, Mode], where: str) -> Mode:
    """The mode with images of this size; no two modes of a camera share one."""
    for mode in modes.values():
        if mode.size == size:
            return mode
    known = one_of(f"{name} ({mode.size[0]} x {mode.size[1]})" for name, mode in modes.items())
    raise RecordingError(f"{where} images of {size[0]} x {size[1]} pixels are of no Azure Kinect mode: must be {known}")


def _camera(data: Mapping[str, Any], mode: Mode, where: str) -> Camera:
    intrinsics = data["Intrinsics"]
    if intrinsics["ModelType"] != _LENS:
        raise RecordingError(f"{where}: lens model {intrinsics['ModelType']!r} is not supported: must be {_LENS!r}")
    # codx, cody: a centre of distortion, not used by this lens model
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _codx, _cody, p2, p1 = (float(x) for x in intrinsics["ModelParameters"])
    (width, height), (left, top) = mode.sensor, mode.offset
    K = np.array([[fx * width, 0, cx * width - left - 0.5], [0, fy * height, cy * height - top - 0.5], [0, 0, 1.0]])
    return Camera(*mode.size, K, "rational", (k1, k2, p1, p2, k3, k4, k5, k6))


def _T_camera_rig(data: Mapping[str, Any]) -> np.ndarray:
    """Takes a point (metres) in the device's frame, which is the depth camera's, to the camera's."""
    R = np.array(data["Rt"]["Rotation"], dtype=np.float64).reshape(3, 3)
    u, _, vt = np.linalg.svd(R)  # the file holds single precision: the nearest rotation
    if np.abs(u @ vt - R).max() > 1e-3:
        raise ValueError("Rt holds no rotation")
    return rigid(u @ vt, np.array(data["Rt"]["Translation"], dtype=np.float64).reshape(3))
