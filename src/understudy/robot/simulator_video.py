"""Pictures and videos of a simulation, off screen."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from jaxtyping import UInt8

from understudy.errors import MissingExtraError, UnderstudyError
from understudy.robot.simulator_model import VISUAL_GROUP
from understudy.stage.furniture import Furniture
from understudy.stage.render import open_gl

SIZE: Final = (480, 640)
RATE_HZ: Final = 10.0
_MOST_GEOMS: Final = 5000


class Video:
    """Collects frames of one trial."""

    def __init__(self, model: mujoco.MjModel, furniture: Furniture, size: tuple[int, int] = SIZE):
        height, width = size
        self._gl = open_gl(width, height)  # not mujoco.Renderer, which needs a display unless MUJOCO_GL was set early
        self._gl.make_current()
        self._model = model
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._scene = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[[0, VISUAL_GROUP]] = 1
        self._camera = mujoco.MjvCamera()
        handle = furniture.articulation.T_rest[:3, 3]
        self._camera.lookat[:] = (-0.45, 0.0, 0.85)
        hinge = np.sign(furniture.articulation.point[1]) if furniture.articulation.kind == "revolute" else 1.0
        self._camera.distance, self._camera.elevation = 3.3, -28.0
        self._camera.azimuth = 35.0 if hinge >= 0 else -35.0
        if furniture.pushed:
            self._camera.lookat[:] = (-0.1, handle[1], 0.9)
            self._camera.distance, self._camera.elevation = 4.2, -42.0
            self._camera.azimuth = 25.0 if hinge >= 0 else -25.0
        self.frames: list[UInt8[np.ndarray, "h w 3"]] = []
        self.times_s: list[float] = []
        self._next = 0.0

    def maybe_frame(self, data: mujoco.MjData) -> None:
        """Keeps a frame when the next one is due."""
        if data.time >= self._next:
            self.frames.append(self.picture(data))
            self.times_s.append(float(data.time))
            self._next = data.time + 1.0 / RATE_HZ

    def picture(self, data: mujoco.MjData) -> UInt8[np.ndarray, "h w 3"]:
        """Of now."""
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._options, None, self._camera, everything, self._scene)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        image = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, self._rect, self._context)
        return np.ascontiguousarray(image[::-1])

    def close(self) -> None:
        """Gives graphics memory back."""
        self._context.free()
        self._gl.free()


def write_video(path: Path, frames: list[UInt8[np.ndarray, "h w 3"]], rate_hz: float = RATE_HZ) -> None:
    """An mp4 (H.264), whole or not at all. Raises MissingExtraError without imageio-ffmpeg."""
    try:
        import imageio_ffmpeg
    except ImportError as e:
        raise MissingExtraError("videos", "robot") from e
    if not frames:
        raise UnderstudyError(f"{path}: a video needs at least one frame")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    h, w = frames[0].shape[:2]
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        part = Path(folder) / "video.mp4"
        writer = imageio_ffmpeg.write_frames(str(part), (w, h), fps=rate_hz, quality=6, macro_block_size=8)
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        part.replace(path)


def contact_sheet(
    frames: list[UInt8[np.ndarray, "h w 3"]], columns: int = 4, most: int = 12
) -> UInt8[np.ndarray, "rows columns_px 3"]:
    """Frames evenly spread over the time, side by side."""
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, most).round().astype(int))]
    blank = np.full_like(chosen[0], 255)
    chosen += [blank] * (-len(chosen) % columns)
    return np.concatenate([np.concatenate(chosen[i : i + columns], 1) for i in range(0, len(chosen), columns)])
