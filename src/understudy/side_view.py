"""One frame by several methods, side by side: the image, and every method's people as seen from the side.

An overlay cannot show what lifting does to hidden joints, since a wrong depth projects to the right pixel. Seen from
the side it is plain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from understudy.drawing import OUTLINE, WHITE, Canvas
from understudy.overlay import bone_color, draw_people, joint_color, person_color
from understudy.recordings.truth import TruthPerson
from understudy.skeleton import BONES
from understudy.types import INFERRED, Person, RegisteredFrame
from understudy.voxels import cloud

_BACKGROUND: Final = (28, 28, 32)
_POINT: Final = (95, 95, 102)
_MARGIN_M: Final = 0.35
_TRUTH: Final = WHITE


def draw_methods(
    frame: RegisteredFrame, people: Mapping[str, Sequence[Person]], truth: Sequence[TruthPerson] = ()
) -> UInt8[np.ndarray, "h w 3"]:
    """The image with the first method's people, then one side view for each method; truth is a thin white skeleton.

    people: method -> its people. In a side view the camera is to the left; right is away from it, down is down.
    """
    picture = draw_people(frame.color, next(iter(people.values())), frame.camera)
    low, high = _range([*(p.keypoints for each in people.values() for p in each), *(t.keypoints for t in truth)])
    height = picture.shape[0]
    scale = height / max(high[1] - low[1], 1e-3)
    width = int(np.clip((high[2] - low[2]) * scale, height // 3, 2 * height))
    panels = [picture]
    for name, each in people.items():
        canvas = Canvas(np.full((height, width, 3), _BACKGROUND, np.uint8))
        _points(canvas, frame, low, high, scale)
        for true in truth:
            _skeleton(canvas, _place(true.keypoints, low, scale), None)
        for person in each:
            _skeleton(canvas, _place(person.keypoints, low, scale), person)
        canvas.text(f"{name}, from the side{_score(each, truth)}", (4, 4), WHITE)
        panels.append(canvas.image)
    rule = np.full((height, 4, 3), WHITE, np.uint8)
    return np.concatenate([part for panel in panels for part in (rule, panel)][1:], axis=1)


def hidden_errors(people: Sequence[Person], truth: Sequence[TruthPerson]) -> Float[np.ndarray, " n"]:
    """Errors (metres) of hidden joints in view; NaN where the method gives none. The nearest person by 3D counts."""
    errors = []
    for true in truth:
        distances = [np.linalg.norm(p.keypoints - true.keypoints, axis=1) for p in people]
        near = [d for d in distances if np.isfinite(d).any()]
        if near:
            errors.append(min(near, key=lambda d: float(np.nanmedian(d)))[true.occluded & true.in_view])
    return np.concatenate(errors) if errors else np.empty(0)


def _score(people: Sequence[Person], truth: Sequence[TruthPerson]) -> str:
    errors = hidden_errors(people, truth)
    known = errors[np.isfinite(errors)]
    if not len(known):
        return ""
    lacking = f", {len(errors) - len(known)} not given" if len(known) < len(errors) else ""
    return f": hidden joints {100 * known.mean():.0f} cm off{lacking}"


def _range(skeletons: Sequence[Float[np.ndarray, "18 3"]]) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest coordinates of what is to be seen, with a margin."""
    joints = np.concatenate([np.empty((0, 3)), *skeletons])
    joints = joints[np.isfinite(joints).all(1)]
    if not len(joints):
        return np.array([-1.0, -1.0, 1.0]), np.array([1.0, 1.0, 4.0])
    return joints.min(0) - _MARGIN_M, joints.max(0) + _MARGIN_M


def _place(points: Float[np.ndarray, "n 3"], low: np.ndarray, scale: float) -> Float[np.ndarray, "n 2"]:
    """Metres -> pixels of a side view."""
    return np.asarray((points[:, [2, 1]] - low[[2, 1]]) * scale, dtype=np.float64)


def _points(canvas: Canvas, frame: RegisteredFrame, low: np.ndarray, high: np.ndarray, scale: float) -> None:
    """What the camera measured around the people."""
    points = cloud(frame.depth)
    points = points[((points > low) & (points < high)).all(1)]
    u, v = _place(points.astype(np.float64), low, scale).astype(int).T
    inside = (u >= 0) & (u < canvas.width) & (v >= 0) & (v < canvas.height)
    canvas.image[v[inside], u[inside]] = _POINT


def _skeleton(canvas: Canvas, at: Float[np.ndarray, "18 2"], person: Person | None) -> None:
    """Bones, and joints as discs (observed) or rings (inferred); without a person the truth's thin lines."""
    thick = max(1, canvas.height // 180)
    color = _TRUTH if person is None else person_color(person.id)
    for bone in BONES:
        a, b = at[list(bone)]
        if not np.isfinite([*a, *b]).all():
            continue
        if person is None:
            canvas.line(a, b, color, 1)
        else:
            canvas.line(a, b, OUTLINE, thick + 2)
            canvas.line(a, b, bone_color(bone, color), thick)
    if person is not None:
        for row, (place, source) in enumerate(zip(at, person.source, strict=True)):
            if np.isfinite(place).all():
                draw = canvas.outlined_ring if source == INFERRED else canvas.outlined_disc
                draw(place, thick + 1.5, joint_color(row, color))
