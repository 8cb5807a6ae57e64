"""Strokes and words on RGB images: a thin layer over OpenCV, antialiased, at fractions of a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt8

Rgb = tuple[int, int, int]
Box = tuple[int, int, int, int]
"""left, top, right, bottom in pixels; right and bottom are outside"""

OUTLINE: Final = (20, 20, 20)
WHITE: Final = (255, 255, 255)

MIN_TEXT_SCALE: Final = 0.3
"""of OpenCV's font: about 7 pixels high"""

_SHIFT = 4  # OpenCV draws at 1/16 pixel
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Canvas:
    """An RGB image that is drawn on in place. Positions are pixels (u, v), not necessarily inside."""

    def __init__(self, image: UInt8[np.ndarray, "h w 3"]):
        assert image.flags.c_contiguous
        self.image = image
        self.height, self.width = image.shape[:2]
        self._scale = max(MIN_TEXT_SCALE, min(self.height, self.width) / 1150)

    # --- strokes ---

    def line(self, a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, color: Rgb, width: int) -> None:
        cv2.line(self.image, _fixed(a), _fixed(b), color, width, cv2.LINE_AA, _SHIFT)

    def arrow(self, a: np.ndarray, b: np.ndarray, color: Rgb, width: int) -> None:
        """An arrow with a dark outline, from a to b."""
        for c, w in ((OUTLINE, width + max(2, width)), (color, width)):
            cv2.arrowedLine(self.image, _fixed(a), _fixed(b), c, w, cv2.LINE_AA, shift=_SHIFT, tipLength=0.3)

    def disc(self, at: Sequence[float] | np.ndarray, radius: float, color: Rgb) -> None:
        r = round(radius * (1 << _SHIFT))
        cv2.circle(self.image, _fixed(at), r, color, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def outlined_disc(self, at: Sequence[float] | np.ndarray, radius: float, color: Rgb) -> None:
        self.disc(at, radius + max(1.0, 0.4 * radius), OUTLINE)
        self.disc(at, radius, color)

    def outlined_ring(self, at: Sequence[float] | np.ndarray, radius: float, color: Rgb) -> None:
        self.outlined_disc(at, 1.1 * radius, color)
        self.disc(at, max(0.8, 0.55 * radius), OUTLINE)

    def outlined_cross(self, at: Sequence[float] | np.ndarray, radius: float, color: Rgb) -> None:
        """A diagonal cross."""
        (u, v), t = at, max(1, round(radius / 2))
        for stroke, width in ((OUTLINE, t + 2), (color, t)):
            self.line((u - radius, v - radius), (u + radius, v + radius), stroke, width)
            self.line((u - radius, v + radius), (u + radius, v - radius), stroke, width)

    # --- words ---

    @property
    def text_height(self) -> int:
        """Height of a line of text with its margins, pixels."""
        return self._text_size("#", self._scale)[1]

    def label(self, text: str, above: tuple[float, float], color: Rgb, taken: Sequence[Box] = ()) -> Box | None:
        """Words in a dark box with a coloured edge, centred above a pixel; moved into the image, off the `taken` boxes.

        Shrinks to the image's width, and is cut off where that is not enough. Returns the box; None where it could not
        be read (the image is too small).
        """
        scale = self._scale
        while (w := self._text_size(text, scale)[0]) > self.width:
            if scale > MIN_TEXT_SCALE:
                scale = max(MIN_TEXT_SCALE, scale * self.width / w - 0.005)
            elif len(text) > 8:
                text = text[:-4].rstrip(".") + "..."
            else:
                return None
        h = self._text_size(text, scale)[1]
        if h > self.height // 2:
            return None
        left = int(np.clip(round(above[0] - w / 2), 0, self.width - w))
        top = int(np.clip(round(above[1] - h), 0, self.height - h))
        for step in (0, -1, 1, -2, 2, -3, 3):  # the first free place, up and down
            box = (left, top + step * h, left + w, top + (step + 1) * h)
            if box[1] >= 0 and box[3] <= self.height and not any(_overlap(box, b) for b in taken):
                break
        else:
            box = (left, top, left + w, top + h)
        self._box(box, color)
        self.text(text, (box[0], box[1]), WHITE, scale)
        return box

    def text(self, text: str, left_top: tuple[int, int], color: Rgb, scale: float | None = None) -> None:
        """Words whose margin's corner is at a pixel."""
        scale = self._scale if scale is None else scale
        height = self._text_size(text, scale)[1]
        at = (left_top[0] + round(8 * scale), left_top[1] + round(0.72 * height))
        cv2.putText(self.image, text, at, _FONT, scale, color, max(1, round(1.5 * scale)), cv2.LINE_AA)

    def text_width(self, text: str) -> int:
        return self._text_size(text, self._scale)[0]

    def _text_size(self, text: str, scale: float) -> tuple[int, int]:
        (w, h), below = cv2.getTextSize(text, _FONT, scale, max(1, round(1.5 * scale)))
        return w + round(16 * scale), h + below + round(8 * scale)

    def _box(self, box: Box, edge: Rgb | None) -> None:
        left, top, right, bottom = box
        patch = self.image[top:bottom, left:right]
        patch[:] = (0.25 * patch + 0.75 * np.array(OUTLINE)).astype(np.uint8)
        if edge is not None:
            t = max(1, round(2 * self._scale))
            self.image[bottom - t : bottom, left:right] = edge

    # --- keys ---

    def shade(self, width: int, height: int, *, right: bool = False) -> Box:
        """Darkens a box in the lower left (or right) corner and says where it is."""
        left = self.width - width if right else 0
        box = (left, self.height - height, left + width, self.height)
        self._box(box, None)
        return box


def _fixed(uv: Sequence[float] | np.ndarray) -> tuple[int, int]:
    return round(float(uv[0]) * (1 << _SHIFT)), round(float(uv[1]) * (1 << _SHIFT))


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
