"""Where to look for people, and what to hide while looking.

With depth: a window around each thing that could be a person, other such things greyed out of it; large tiles for
people whom depth does not show; and, where things are joined to walls and furniture, tiles of about a person's size.
Without depth: the whole image, and tiles of two sizes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from understudy.camera import Camera
from understudy.detectors.blazepose_nets import Region
from understudy.detectors.components import Component, DepthGrid
from understudy.types import RegisteredDepth

_MARGIN = 1.25  # window side over the larger side of the thing
PERSON = 1.7
"""metres: a standing person's height, for windows around people who are cut off"""
MAX_JOINED = 10
"""tiles on walls and furniture"""
_FILL: Final = 128  # grey level of what is hidden
_OPACITY_BITS: Final = 7  # so many that int16 holds the product of a grey level and an opacity


@dataclass(frozen=True)
class Group:
    """Components that are likely one thing: a person whose head and chest are cut apart by an arm or a hole."""

    labels: frozenset[int]
    box: tuple[float, float, float, float]
    """left, top, right, bottom, colour pixels"""
    z: float
    """median depth of the largest part, metres"""
    compact: bool
    """could be one person, or a few who touch; else it is furniture, a wall, a person joined to them"""


@dataclass(frozen=True)
class Window:
    """One look at the image."""

    region: Region
    group: int | None
    """the group it is about; None for a tile"""


class Scene:
    """The things in one frame's depth, as far as the detector needs them."""

    def __init__(self, depth: RegisteredDepth, color: Camera):
        self.grid = DepthGrid(depth, color)
        self.groups = _merge(self.grid.components)
        self._group_of_label = np.full(int(self.grid.labels.max(initial=0)) + 1, -1)
        for i, group in enumerate(self.groups):
            self._group_of_label[list(group.labels)] = i
        self.group_of_cell = self._group_of_label[self.grid.labels]
        """(gh, gw) index into `groups`, -1 for none"""

    def hidden(self, group: int) -> Bool[np.ndarray, "gh gw"]:
        """Cells of the other groups that could be people."""
        others = [i for i, g in enumerate(self.groups) if g.compact and i != group]
        return np.isin(self.group_of_cell, others)

    def pixels_per_metre(self, z: float) -> float:
        """Colour pixels that a metre covers at a depth."""
        return self.grid.camera.fx * self.grid.color_pixels / z

    def groups_at(self, uv: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Group under each pixel, -1 for none; shape (n,)."""
        row, col, inside = self.grid.cells_of(uv)
        return np.where(inside, self.group_of_cell[row, col], -1)

    def shows(self, region: Region, cells: Bool[np.ndarray, "gh gw"]) -> bool:
        """Whether any of the cells lie in the region (in its upright square)."""
        half = region.size / 2
        corners = np.array(region.center) + np.array([[-half, -half], [half, half]])
        (top, bottom), (left, right), _ = self.grid.cells_of(corners)
        return bool(cells[top : bottom + 1, left : right + 1].any())

    def hide(self, crop: UInt8[np.ndarray, "n n 3"], region: Region, cells: Bool[np.ndarray, "gh gw"]) -> np.ndarray:
        """The crop with the given cells greyed out, softly at their rim."""
        size = crop.shape[0]
        # crop pixels -> image pixels -> cells
        to_image = np.vstack([region.to_image(size), (0, 0, 1)])
        to_color = np.vstack([self.grid.to_color(), (0, 0, 1)])
        alpha = cv2.warpAffine(
            cells.astype(np.uint8) << _OPACITY_BITS,
            (np.linalg.inv(to_color) @ to_image)[:2],
            (size, size),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        if not alpha.any():
            return crop
        opacity = cv2.merge([alpha] * 3).astype(np.int16)
        grey = (_FILL - crop.astype(np.int16)) * opacity >> _OPACITY_BITS
        return (crop + grey).astype(np.uint8)


def tiled(width: int, height: int) -> list[Window]:
    """Where to look in any image of width x height: all of it, and in squares as large as its shorter side."""
    return [Window(_around((-0.5, -0.5, width - 0.5, height - 0.5), 1.0), None), *_tiles(width, height, 1.0)]


def windows(width: int, height: int, scene: Scene | None) -> list[Window]:
    """Where to look besides: where depth shows things, or, without depth, in smaller squares."""
    if scene is None:
        return _tiles(width, height, 0.67)
    found = [Window(_completed(g, width, height, scene), i) for i, g in enumerate(scene.groups) if g.compact]
    return found + [Window(r, None) for r in _joined(width, height, scene)]


def _completed(group: Group, width: int, height: int, scene: Scene) -> Region:
    """A window around a group; where the image's border cuts it off, as large as if the rest of a person were there."""
    left, top, right, bottom = group.box
    rim = 2 * scene.grid.color_pixels
    if bottom > height - rim:
        bottom = max(bottom, top + PERSON * scene.pixels_per_metre(group.z))
    elif top < rim:
        top = min(top, bottom - PERSON * scene.pixels_per_metre(group.z))
    return _around((left, top, right, bottom))


def _joined(width: int, height: int, scene: Scene) -> list[Region]:
    """Tiles of 2.6 m where things are too large to be one person; none where the large tiles are not much larger."""
    large = [i for i, g in enumerate(scene.groups) if not g.compact]
    row, col = np.nonzero(np.isin(scene.group_of_cell, large) & (scene.grid.z > 0))
    if not len(row):
        return []
    side = max(2.6 * scene.pixels_per_metre(float(np.median(scene.grid.z[row, col]))), 0.35 * min(width, height))
    if side > 0.75 * min(width, height):
        return []
    (left, right), (top, bottom) = (scene.grid.edges_to_color(int(a.min()), int(a.max())) for a in (col, row))
    squares = _cover(left, top, right, bottom, side)
    return squares[:: -(-len(squares) // MAX_JOINED)]


def _tiles(width: int, height: int, side: float) -> list[Window]:
    """Overlapping squares with a side given in shorter image sides; none where one would do."""
    squares = _cover(-0.5, -0.5, width - 0.5, height - 0.5, side * min(width, height))
    return [Window(r, None) for r in squares] if len(squares) > 1 else []


def _cover(left: float, top: float, right: float, bottom: float, side: float) -> list[Region]:
    """Squares that cover a box, overlapping by half or more; they reach beyond a box that is smaller than they are."""
    side = max(side, max(right - left, bottom - top) / 8)  # at most 18 along an image, however long and thin
    spans = []
    for low, high in ((left, right), (top, bottom)):
        room = high - low - side
        n = max(1, int(np.ceil(room / (0.45 * side) - 1e-6)) + 1)
        spans.append(np.linspace(low, high - side, n) if room > 0 else np.array([(low + high - side) / 2]))
    return [_around((x, y, x + side, y + side), 1.0) for y in spans[1] for x in spans[0]]


def _around(box: tuple[float, float, float, float], margin: float = _MARGIN) -> Region:
    left, top, right, bottom = box
    return Region(((left + right) / 2, (top + bottom) / 2), margin * max(right - left, bottom - top), 0.0)


def _merge(components: list[Component]) -> list[Group]:
    """Groups compact components that stand above one another at about the same depth."""
    parts: list[list[Component]] = [[c] for c in components if not c.is_compact()]
    compact: list[list[Component]] = []
    for c in sorted((c for c in components if c.is_compact()), key=lambda c: -c.area):
        for group in compact:
            if _stacked(group, c):
                group.append(c)
                break
        else:
            compact.append([c])
    return [_group(p, True) for p in compact] + [_group(p, False) for p in parts]


def _stacked(group: list[Component], c: Component) -> bool:
    left, top, right, bottom = _union(group)
    overlap = min(right, c.box[2]) - max(left, c.box[0])
    gap = max(top, c.box[1]) - min(bottom, c.box[3])
    pixels_per_metre = (c.box[3] - c.box[1]) / max(c.height, 0.05)
    return (
        abs(group[0].z - c.z) < 0.4
        and overlap > 0.5 * min(right - left, c.box[2] - c.box[0])
        and gap < 0.25 * pixels_per_metre
        and (max(bottom, c.box[3]) - min(top, c.box[1])) < 2.3 * pixels_per_metre
    )


def _union(group: list[Component]) -> tuple[float, float, float, float]:
    boxes = np.array([c.box for c in group])
    left, top = boxes[:, :2].min(0).tolist()
    right, bottom = boxes[:, 2:].max(0).tolist()
    return left, top, right, bottom


def _group(parts: list[Component], compact: bool) -> Group:
    return Group(frozenset(c.label for c in parts), _union(parts), parts[0].z, compact)
