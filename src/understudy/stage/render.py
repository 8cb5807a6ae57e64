"""Pictures of a scene: colour, exact depth, and what is where."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from understudy.camera import Camera
from understudy.errors import UnderstudyError
from understudy.stage.scene import Scene

NEAR, FAR = 0.1, 15.0
"""metres; nothing nearer or farther is drawn"""

_SAMPLES: Final = 4  # per pixel of the colour picture
_MOST_GEOMS: Final = 2000
_DARK: Final = 0.2
"""Luminance below which hair returns too little light to depth cameras."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What an ideal depth camera sees."""

    depth: Float32[np.ndarray, "h w"]
    """z, metres; FAR where there is nothing"""
    person: Bool[np.ndarray, "h w"]
    dark: Bool[np.ndarray, "h w"]
    """dark hair"""


class Renderer:
    """Draws a scene off screen. Close it, or use it in a `with` block.

    Needs OpenGL, see `open_gl`.
    """

    def __init__(self, scene: Scene):
        self._scene, model = scene, scene.model
        width, height = model.vis.global_.offwidth, model.vis.global_.offheight
        self._gl = open_gl(width, height)
        self._gl.make_current()
        # two contexts: blended edges belong into a photograph and not into a depth image
        model.vis.quality.offsamples = _SAMPLES
        self._photo = self._context()
        model.vis.quality.offsamples = 0
        self._exact = self._context()
        self._view = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
        self._options = mujoco.MjvOption()
        self._options.flags[mujoco.mjtVisFlag.mjVIS_SKIN] = True
        self._free = mujoco.MjvCamera()
        skins = [f"person_{piece.name}" for piece in scene.pieces]
        light = [_luminance(piece) for piece in scene.pieces]
        dark = ["hair" in name and value < _DARK for name, value in zip(skins, light, strict=True)]
        self._dark = np.array([*dark, False])

    def _context(self) -> mujoco.MjrContext:
        context = mujoco.MjrContext(self._scene.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        return context

    def update(self) -> None:
        """Takes over the scene's pose. Call it after `Scene.pose`."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._scene.model, self._scene.data, self._options, None, self._free, everything, self._view
        )

    def color(self, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "h w 3"]:
        """A photograph without noise and lens errors."""
        self._render(self._photo, camera, T_world_cam, ids=False)
        image = np.empty((camera.height, camera.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, mujoco.MjrRect(0, 0, camera.width, camera.height), self._photo)
        return image[::-1]

    def surfaces(self, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"]) -> Surfaces:
        """Exact z through the middle of every pixel, and what is there."""
        self._render(self._exact, camera, T_world_cam, ids=True)
        image = np.empty((camera.height, camera.width, 3), np.uint8)
        raw = np.empty((camera.height, camera.width), np.float32)
        mujoco.mjr_readPixels(image, raw, mujoco.MjrRect(0, 0, camera.width, camera.height), self._exact)
        image, raw = image[::-1], raw[::-1]
        # reversed depth: 1 at the near plane, 0 at the far one, and linear in 1/z
        depth = NEAR * FAR / (NEAR + raw.astype(np.float64) * (FAR - NEAR))
        number = image.astype(np.int32) @ (1, 256, 65536)
        skin = np.full(self._view.ngeom + 1, -1)
        for geom in self._view.geoms[: self._view.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_SKIN and geom.segid >= 0:
                skin[geom.segid + 1] = geom.objid
        which = skin[number]
        return Surfaces(depth.astype(np.float32), which >= 0, self._dark[which])

    def _render(
        self, context: mujoco.MjrContext, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"], ids: bool
    ) -> None:
        offscreen = self._scene.model.vis.global_
        if camera.width > offscreen.offwidth or camera.height > offscreen.offheight:
            raise UnderstudyError(
                f"a picture of {camera.width} x {camera.height} is larger than the stage can draw: "
                f"{offscreen.offwidth} x {offscreen.offheight}"
            )
        self._gl.make_current()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        flags = self._view.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = ids
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not ids
        for eye in self._view.camera:
            _look(eye, camera, T_world_cam)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, camera.width, camera.height), self._view, context)

    def close(self) -> None:
        """Gives the graphics memory back."""
        self._gl.make_current()
        self._photo.free()
        self._exact.free()
        self._gl.free()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def open_gl(width: int, height: int) -> Any:
    """A `GLContext` of one of MuJoCo's back-ends, for pictures off screen. Raises UnderstudyError that says what to do
    where there is none.

    On Linux it is one of EGL, which needs no display, unless the environment variable MUJOCO_GL says otherwise.
    """
    advice = "rendering needs OpenGL: on Linux install libegl1 and libgl1-mesa-dri, or set MUJOCO_GL=osmesa"
    try:
        if sys.platform == "linux" and os.environ.get("MUJOCO_GL", "egl") == "egl":
            from mujoco.egl import GLContext
        else:
            from mujoco import GLContext
        return GLContext(width, height)
    except Exception as e:  # MuJoCo raises what the GL binding raises: ImportError, RuntimeError, EGLError ...
        raise UnderstudyError(f"{advice} ({e})") from e


def _look(eye: mujoco.MjvGLCamera, camera: Camera, T_world_cam: Float[np.ndarray, "4 4"]) -> None:
    """Sets a GL camera from a pinhole camera; the image reaches half a pixel beyond the outer pixels' centres."""
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (0.5 + camera.cy) / camera.fy, (camera.cy + 0.5 - camera.height) / camera.fy
    eye.pos[:] = T_world_cam[:3, 3]
    eye.forward[:], eye.up[:] = T_world_cam[:3, 2], -T_world_cam[:3, 1]
    eye.frustum_near, eye.frustum_far = NEAR, FAR
    eye.frustum_center, eye.frustum_width = NEAR * (left + right) / 2, NEAR * (right - left) / 2
    eye.frustum_top, eye.frustum_bottom = NEAR * top, NEAR * bottom


def _luminance(piece: object) -> float:
    texture = getattr(piece, "texture", None)
    color = np.asarray(piece.color) if texture is None else texture.reshape(-1, 3).mean(0) / 255  # type: ignore[attr-defined]
    return float(color @ (0.299, 0.587, 0.114))
