"""AprilTag plates on the furniture and on the person, as in the earlier recordings with markers.

A marker's frame: origin in its middle, x to its right and y up as one reads it, z out of the plate.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt8

from understudy.geometry import inverse, rigid
from understudy.objects.marker_setup import Marker
from understudy.objects.markers import DICTIONARIES
from understudy.stage.furniture import Furniture

DICTIONARY: Final = "apriltag_36h11"
PLATE: Final = 1.25
"""A plate is this much larger than its marker: one cell of white all around."""
OBJECT: Final = "object"
_CELLS: Final = 8  # of the marker's side, its black border included
_CLEAR: Final = 0.02  # metres between the plate and the front's edges
_BELOW_TOP: Final = 0.25  # metres from a room door's upper edge to its marker's middle
_HAND_ROOM: Final = 0.07  # metres beside the handle's axis that a hand needs


def object_marker(furniture: Furniture, id: int = 0, size_m: float = 0.15) -> Marker:
    """A marker on the front, beside the handle where the hand does not cover it; smaller where there is no room.

    On a room door it is above head height, where somebody who walks through covers it least.
    """
    T_handle_panel = furniture.panel.T_frame_box
    T_panel_handle = inverse(T_handle_panel)
    half_wide, half_high = furniture.panel.half_m[1:]
    y, z = T_panel_handle[1:3, 3]
    toward = -1.0 if y > 0 else 1.0  # where the front goes on beyond the handle
    room = half_wide - toward * y - _HAND_ROOM - _CLEAR
    plate = min(size_m * PLATE, room, 2 * half_high - 2 * _CLEAR)
    middle = plate / 2
    u = y + toward * (_HAND_ROOM + middle)
    v = np.clip(z, _CLEAR + middle - half_high, half_high - middle - _CLEAR)
    if furniture.pushed:
        u, v = 0.0, half_high - _BELOW_TOP
    # as one reads it standing before the front: the world's -y is right, +z up, -x out
    R = np.array([[0, 0, -1.0], [-1, 0, 0], [0, 1, 0]])
    T_panel_marker = rigid(R, np.array([-furniture.panel.half_m[0] - 0.002, u, v]))
    return Marker(id, float(plate / PLATE), OBJECT, inverse(T_handle_panel @ T_panel_marker))


def plate_image(id: int, cell: int = 16) -> UInt8[np.ndarray, "n n 3"]:
    """The whole plate, white rim included."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[DICTIONARY])
    marker = cv2.aruco.generateImageMarker(dictionary, id, _CELLS * cell)
    return np.repeat(np.pad(marker, cell, constant_values=255)[..., None], 3, axis=2)
