"""AprilTag plates on the furniture and on the person, where a careful experimenter would put them.

Each thing carries several plates that face different ways, so that some are seen from wherever the camera stands: two
on an angled bracket on the moving front, a box beside the back of the acting hand, and a shell of three on the back.

A marker's frame: origin in its middle, x to its right and y up as one reads it, z out of the plate.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from understudy.geometry import inverse, rigid
from understudy.objects.marker_setup import Marker, MarkerSetup
from understudy.objects.markers import DICTIONARIES
from understudy.stage.furniture import Box, Furniture

DICTIONARY: Final = "apriltag_36h11"
PLATE: Final = 1.25
"""A plate is this much larger than its marker: one cell of white all around."""
OBJECT: Final = "object"
FIRST_ID: Final = {OBJECT: 0, "hand": 10, "torso": 20}
"""Of the markers on a thing."""

_CELLS: Final = 8  # of the marker's side, its black border included
_FRONT_PLATE_M: Final = (0.19, 0.15, 0.12)  # the largest that fits is taken
_TURNED: Final = np.radians(45)  # of a bracket's plates, to either side
_LOW_M: Final = 0.3  # height of a front that has brackets at both ends instead of one beside the handle
_CLEAR: Final = 0.02  # metres between a bracket and the front's edges
_GRASP: Final = (0.13, 0.11)  # metres beside and above the handle's middle that a hand with its box needs
_BELOW_TOP: Final = 0.25  # metres from a room door's upper edge to its bracket's middle

_HAND_PLATE_M: Final = 0.11
_HAND_BOX: Final = np.array([-0.055, 0.105, -0.10])
"""Its middle in the hand's frame, for a right hand: beyond the small finger's side, where no bent wrist reaches it."""
_TORSO_PLATE_M: Final = 0.19
_T_TORSO_SHELL: Final = rigid(np.eye(3), np.array([-0.27, 0, 0.09]))
"""T_torso_shell: the middle of its rear plate, axes those of the torso"""
_SHELL: Final = np.radians(70)  # turn of its wings


def marker_setup(furniture: Furniture, acting: str) -> MarkerSetup:
    """On the furniture, the acting hand (left or right) and the torso."""
    return MarkerSetup(DICTIONARY, (*object_markers(furniture), *hand_markers(acting), *torso_markers()))


def object_markers(furniture: Furniture) -> tuple[Marker, ...]:
    """Two plates on an upright bracket on the front, like a roof, where the hand does not cover them; a drawer's front
    has a bracket at each end.
    """
    places, side = _places(furniture)
    T_handle_front = furniture.panel.T_frame_box
    deep, wide = side / 2 * np.sin(_TURNED), side / 2 * np.cos(_TURNED)
    plates = []
    for place in places:
        for sign in (-1.0, 1.0):
            out = np.array([-np.cos(_TURNED), sign * np.sin(_TURNED), 0])
            plates.append(T_handle_front @ _plate(out, (0, 0, 1), place + (-deep, sign * wide, 0)))
    return _markers(OBJECT, side, plates)


def hand_markers(side: str) -> tuple[Marker, ...]:
    """Six sides of a box beside and behind the back of a hand. side: left or right."""
    half, axes = _HAND_PLATE_M / 2, np.concatenate([-np.eye(3), np.eye(3)])[[2, 0, 1, 3, 4, 5]]
    T_hand_box = rigid(np.eye(3), _hand_box(side))
    plates = [T_hand_box @ _plate(out, (0, -1, 0) if out[2] else (0, 0, -1), half * out) for out in axes]
    return _markers("hand", _HAND_PLATE_M, plates)


def torso_markers() -> tuple[Marker, ...]:
    """Three plates behind the back: one looks back, two to the sides."""
    half = _TORSO_PLATE_M / 2
    plates = [_plate((-1, 0, 0), (0, 0, 1), (0, 0, 0))]
    for sign in (-1.0, 1.0):
        out = np.array([-np.cos(_SHELL), sign * np.sin(_SHELL), 0])
        plates.append(_plate(out, (0, 0, 1), (half * np.sin(_SHELL), sign * half * (1 + np.cos(_SHELL)), 0)))
    return _markers("torso", _TORSO_PLATE_M, [_T_TORSO_SHELL @ T for T in plates])


def mount(on: str, markers: Iterable[Marker]) -> Box:
    """What holds the plates on hand or torso, in its frame: between the body and the middle of the plates."""
    middle = np.mean([inverse(m.T_marker_frame)[:3, 3] for m in markers if m.on == on], axis=0)
    at, half = {"hand": (0.45 * middle, (0.012, 0.03, 0.02)), "torso": (middle, (0.05, 0.03, 0.06))}[on]
    return Box(f"{on}_mount", "metal", rigid(np.eye(3), at), half)


def plate_image(id: int, cell: int = 16) -> UInt8[np.ndarray, "n n 3"]:
    """The whole plate, white rim included."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[DICTIONARY])
    marker = cv2.aruco.generateImageMarker(dictionary, id, _CELLS * cell)
    return np.repeat(np.pad(marker, cell, constant_values=255)[..., None], 3, axis=2)


def _places(furniture: Furniture) -> tuple[list[Float[np.ndarray, "3"]], float]:
    """Where the ridges' feet are on the panel (its box's frame), and the plates' side.

    Beside the handle where the front goes on beyond it, else above or below it, over the edge if need be. A low front,
    a drawer's, has one at each end, raised over the handle. On a room door it is high up, where who walks through
    covers it least.
    """
    half_wide, half_high = furniture.panel.half_m[1:]
    T_panel_handle = inverse(furniture.panel.T_frame_box)
    surface, (u, v) = -furniture.panel.half_m[0] - 0.004, T_panel_handle[1:3, 3]
    grasp_wide, grasp_high = np.maximum(np.abs(T_panel_handle[1:3, 2]) * furniture.handle.length_m / 2 + 0.02, _GRASP)
    if furniture.pushed:
        return [np.array([surface, 0.0, half_high - _BELOW_TOP])], _FRONT_PLATE_M[0]
    if 2 * half_high < _LOW_M:
        side = _FRONT_PLATE_M[1]
        wide = side * np.cos(_TURNED)
        end = max(half_wide - wide, _GRASP[0] + wide)
        return [np.array([surface, sign * end, v + 0.03 + side / 2]) for sign in (-1.0, 1.0)], side
    toward, over = (-1.0 if w > 0 else 1.0 for w in (u, v))  # where there is more room
    for side in _FRONT_PLATE_M:
        wide, high = side * np.cos(_TURNED), side / 2
        most_wide, most_high = half_wide - wide - _CLEAR, half_high - high - _CLEAR
        beside, above = u + toward * (grasp_wide + wide), v + over * (grasp_high + high)
        if abs(beside) < most_wide and most_high > 0:
            return [np.array([surface, beside, np.clip(v + 0.05, -most_high, most_high)])], side
        if (abs(above) < most_high or side == _FRONT_PLATE_M[-1]) and most_wide > 0:
            break
    return [np.array([surface, np.clip(u + toward * wide, -most_wide, most_wide), above])], side


def _hand_box(side: str) -> Float[np.ndarray, "3"]:
    return _HAND_BOX * (1, 1 if side == "right" else -1, 1)


def _markers(on: str, side: float, T_thing_marker: Iterable[np.ndarray]) -> tuple[Marker, ...]:
    first = FIRST_ID[on]
    return tuple(Marker(first + i, side / PLATE, on, inverse(T)) for i, T in enumerate(T_thing_marker))


def _plate(out: Iterable[float], up: Iterable[float], at: Iterable[float]) -> Float[np.ndarray, "4 4"]:
    """Pose of a marker in a frame in which it looks out, stands upright along `up`, and has its middle there."""
    z, y = np.array([*out], np.float64), np.array([*up], np.float64)
    return rigid(np.stack([np.cross(y, z), y, z], axis=1), np.array([*at], np.float64))
