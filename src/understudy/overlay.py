"""Pictures that show what was found: skeletons over colour, over depth, and the two side by side.

3D joints are drawn where the camera projects them, so a skeleton that sits on its person checks both the 3D and the
camera. What the 2D detector said is a small white dot with a tether to its joint: it shows only where the two disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from understudy.camera import Camera
from understudy.drawing import OUTLINE, WHITE, Box, Canvas, Rgb
from understudy.hand_overlay import HandFigure
from understudy.skeleton import BONES, FACE, JOINT, JOINTS, TORSO
from understudy.types import INFERRED, MISSING, Person, RegisteredFrame

PALETTE: Final = (
    (255, 150, 20), (70, 195, 255), (110, 225, 70), (255, 95, 205),
    (250, 225, 50), (255, 85, 70), (175, 135, 255), (30, 220, 185),
)  # fmt: skip
"""RGB, one per person id, over and over"""
NO_DEPTH: Final = (38, 38, 42)
LOW_SCORE: Final = 0.5
"""below this 2D score a joint and its bones are thin and faint"""

_LEFT = np.array([name.startswith("left_") for name in JOINTS])


def person_color(id: int) -> Rgb:
    """RGB of a person: the same in pictures and in the viewer."""
    return PALETTE[id % len(PALETTE)]


def left_color(color: Rgb) -> Rgb:
    """The darker colour of the person's left limbs."""
    r, g, b = (int(0.52 * c) for c in color)
    return r, g, b


def bone_color(bone: tuple[int, int], color: Rgb) -> Rgb:
    """RGB of a bone: the darker one when it leads to the left side."""
    return color if bone[0] == JOINT["right_hip"] else joint_color(bone[1], color)


def joint_color(row: int, color: Rgb) -> Rgb:
    """RGB of a joint: the darker one on the left side."""
    return left_color(color) if _LEFT[row] else color


def torso_distance(person: Person) -> float | None:
    """Metres from the camera to the mean of the torso's joints (of all joints when there are none); None without 3D."""
    for rows in (person.keypoints[TORSO], person.keypoints):
        known = rows[np.isfinite(rows).all(axis=1)]
        if len(known):
            return float(np.linalg.norm(known.mean(axis=0)))
    return None


def describe(person: Person) -> str:
    """'#2 3.61 m', or '#2 failed: why'."""
    if person.failed is not None:
        return f"#{person.id} failed: {person.failed}"
    distance = torso_distance(person)
    return f"#{person.id}" if distance is None else f"#{person.id} {distance:.2f} m"


def draw_people(
    color: UInt8[np.ndarray, "h w 3"], people: Sequence[Person], camera: Camera, *, legend: bool = True
) -> UInt8[np.ndarray, "h w 3"]:
    """A copy of the RGB image with the people drawn on it; far people first. `camera` is the image's."""
    canvas = Canvas(color.copy(order="C"))
    figures = sorted((_Figure.of(p, camera) for p in people), key=lambda f: -f.distance)
    faint = [f for f in figures if f.weak.any() or any(h.weak for h in f.hands)]
    if faint:
        layer = Canvas(canvas.image.copy())
        for figure in faint:
            figure.draw_bones(layer, weak=True)
            figure.draw_palms(layer, weak=True)
        cv2.addWeighted(canvas.image, 0.4, layer.image, 0.6, 0, dst=canvas.image)
    for figure in figures:
        figure.draw_bones(canvas, weak=False)
        figure.draw_detections(canvas)
        figure.draw_joints(canvas)
        figure.draw_palms(canvas, weak=False)
    taken: list[Box] = []
    for figure in reversed(figures):  # the nearest person's label gets its place first
        if figure.head is not None:
            box = canvas.label(describe(figure.person), figure.head, figure.color, taken)
            taken += [] if box is None else [box]
    if legend and figures:
        _draw_legend(canvas)
    return canvas.image


@dataclass(frozen=True)
class _Figure:
    """A person in pixels."""

    person: Person
    uv: Float[np.ndarray, "18 2"]
    """the joints: 3D ones projected, else the 2D detections; NaN where neither is"""
    only_2d: np.ndarray
    """found in 2D, no place in 3D; shape (18,)"""
    weak: np.ndarray
    """2D score below `LOW_SCORE`; shape (18,)"""
    color: Rgb
    thickness: int
    """of a bone, pixels"""
    size: float
    """diagonal of the joints' box, pixels"""
    distance: float
    """metres"""
    hands: tuple[HandFigure, ...]

    @classmethod
    def of(cls, person: Person, camera: Camera) -> _Figure:
        k2d = person.keypoints_2d
        limit = 8 * max(camera.width, camera.height)  # further out is as good as behind the camera
        projected = camera.project(person.keypoints)
        projected[~(np.abs(projected) < limit).all(axis=1)] = np.nan
        missing = np.array([s == MISSING for s in person.source]) | np.isnan(person.keypoints).any(axis=1)
        only_2d = missing & k2d.found
        uv = np.where(only_2d[:, None], np.clip(k2d.uv, -limit, limit), projected)
        known = uv[np.isfinite(uv).all(axis=1)]
        size = float(np.linalg.norm(np.ptp(known, axis=0))) if len(known) else 0.0
        largest = max(1, min(camera.width, camera.height) // 100)
        color, thickness = person_color(person.id), int(np.clip(round(size / 90), 1, largest))
        hands = (
            HandFigure.of(person, side, camera, joint_color(JOINT[f"{side}_wrist"], color), thickness)
            for side in ("left", "right")
        )
        return cls(
            person,
            uv,
            only_2d,
            k2d.score < LOW_SCORE,
            color,
            thickness,
            size,
            torso_distance(person) or np.inf,
            tuple(hand for hand in hands if hand is not None),
        )

    @property
    def head(self) -> tuple[float, float] | None:
        """Pixel that the label hangs above: over the highest joint."""
        known = self.uv[np.isfinite(self.uv).all(axis=1)]
        if not len(known):
            return None
        top = known[np.argmin(known[:, 1])]
        return float(top[0]), float(top[1] - 0.07 * self.size - 2 * self.thickness)

    @property
    def radius(self) -> float:
        """of a joint's disc, pixels"""
        return max(1.5, 1.3 * self.thickness)

    def draw_bones(self, canvas: Canvas, *, weak: bool) -> None:
        """Outlined lines: those with a weak end, or the others; hands too."""
        drawn = [b for b in BONES if np.isfinite(self.uv[list(b)]).all() and bool(self.weak[list(b)].any()) == weak]
        thin = weak or self.person.failed is not None
        t = max(1, self.thickness // 2) if thin else self.thickness
        for a, b in drawn:
            canvas.line(self.uv[a], self.uv[b], OUTLINE, t + max(2, t))
        for a, b in drawn:
            canvas.line(self.uv[a], self.uv[b], bone_color((a, b), self.color), t)
        for hand in self.hands:
            if hand.weak == weak:
                hand.draw_bones(canvas)

    def draw_joints(self, canvas: Canvas) -> None:
        """Disc: observed. Ring: inferred. Cross: only in 2D."""
        for row in np.flatnonzero(np.isfinite(self.uv).all(axis=1)):
            r = self.radius * (0.75 if self.weak[row] or row in FACE else 1.0)
            color = joint_color(int(row), self.color)
            if self.only_2d[row]:
                canvas.outlined_cross(self.uv[row], r, color)
            elif self.person.source[row] == INFERRED:
                canvas.outlined_ring(self.uv[row], r, color)
            else:
                canvas.outlined_disc(self.uv[row], r, color)

    def draw_detections(self, canvas: Canvas) -> None:
        """What the 2D detector said: dots, tethered to the joints."""
        k2d = self.person.keypoints_2d
        for row in np.flatnonzero(k2d.found & ~self.only_2d & np.isfinite(self.uv).all(axis=1)):
            at = np.clip(k2d.uv[row], -1e5, 1e5)
            canvas.line(self.uv[row], at, WHITE, 1)
            canvas.outlined_disc(at, max(0.8, 0.3 * self.thickness), WHITE)

    def draw_palms(self, canvas: Canvas, *, weak: bool) -> None:
        """Arrows out of the palms: the doubtful ones, or the others."""
        for hand in self.hands:
            if hand.weak == weak:
                hand.draw_palm(canvas)


def _draw_legend(canvas: Canvas) -> None:
    """What sides and marks mean, in the lower left corner; nothing where there is no room."""
    color: Rgb = (215, 215, 215)
    h = canvas.text_height
    words = ("right", "left", "observed", "inferred", "2D only")
    widths = [canvas.text_width(w) + 2 * h for w in words]
    if sum(widths) > canvas.width or canvas.width < 320:
        return
    box = canvas.shade(sum(widths), h)
    r, v = 0.2 * h, box[1] + h / 2
    for i, word in enumerate(words):
        u = box[0] + sum(widths[:i]) + h
        if word in ("right", "left"):
            stroke = color if word == "right" else left_color(color)
            canvas.line((u - 0.5 * h, v), (u + 0.5 * h, v), stroke, max(2, round(0.15 * h)))
        else:
            mark = (canvas.outlined_disc, canvas.outlined_ring, canvas.outlined_cross)[i - 2]
            mark((u, v), r, color)
        canvas.text(word, (round(u + 0.5 * h), box[1]), WHITE)


def draw_depth(
    depth: Float32[np.ndarray, "h w"], *, near_m: float | None = None, far_m: float | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Depth (metres, 0 = no measurement) in colours of even steps: yellow near, violet far, grey nothing; with a scale.

    The ends of the scale default to the 2nd and 98th percentile. Sparse depth is drawn with larger dots.
    """
    valid = depth > 0
    values = depth[valid]
    if not len(values):
        return np.full((*depth.shape, 3), NO_DEPTH, np.uint8)
    low, high = np.percentile(values[:: max(1, len(values) // 100_000)], [2, 98])
    low, high = near_m if near_m is not None else float(low), far_m if far_m is not None else float(high)
    high = max(high, low + 0.1)
    size = int(np.clip(np.ceil(np.sqrt(valid.size / len(values)) - 0.2), 1, 9)) | 1
    grown = cv2.erode(np.where(valid, depth, np.float32(1e9)), np.ones((size, size), np.uint8))  # nearest one wins
    shown = np.where(valid, depth, grown)
    image = _colormap((255 * np.clip((high - shown) / (high - low), 0, 1)).astype(np.uint8))
    image[shown >= 1e9] = NO_DEPTH
    _draw_scale(Canvas(image), low, high)
    return image


def _colormap(level: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def _draw_scale(canvas: Canvas, low: float, high: float) -> None:
    """The colours and the metres at their ends, in the lower right corner; nothing where there is no room."""
    h, bar = canvas.text_height, canvas.width // 8
    near, far = f"{low:.1f} m", f"{high:.1f} m"
    widths = canvas.text_width(near), canvas.text_width(far)
    if bar < 24 or bar + sum(widths) > canvas.width or 2 * h > canvas.height:
        return
    left, top, right, bottom = canvas.shade(bar + sum(widths), h, right=True)
    canvas.text(near, (left, top), WHITE)
    canvas.text(far, (right - widths[1], top), WHITE)
    row = _colormap(np.linspace(255, 0, bar).astype(np.uint8)[None])
    canvas.image[top + h // 4 : bottom - h // 4, left + widths[0] : left + widths[0] + bar] = row


def draw_frame(frame: RegisteredFrame, people: Sequence[Person]) -> UInt8[np.ndarray, "h w2 3"]:
    """Colour with skeletons beside depth with skeletons."""
    size = (frame.camera.width, frame.camera.height)
    depth = cv2.resize(draw_depth(frame.depth.z), size, interpolation=cv2.INTER_AREA)
    return np.hstack(
        [draw_people(frame.color, people, frame.camera), draw_people(depth, people, frame.camera, legend=False)]
    )
