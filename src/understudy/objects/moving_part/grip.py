"""The handle of a part that is known: looked for before anything moved, or after, and settled by all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from understudy.camera import Camera
from understudy.geometry import inverse, transform_points
from understudy.objects.articulation import Articulation, Handle
from understudy.objects.moving_part.bar import settle_on_bar
from understudy.objects.moving_part.handle import find_handle
from understudy.objects.moving_part.scoring import PartModel, motions
from understudy.objects.moving_part.search import step_m
from understudy.objects.moving_part.stack import DepthStack, Reference, left, reference

Found = tuple[Float[np.ndarray, "4 4"], Handle, bool]
"""T_world_handle with the part at rest, the handle, and whether it was seen (else it is where the hand was)."""

_AT_REST = 0.05  # metres of the way: where the part may be and still hide what it hides at rest
_AWAY = 0.5  # of the way


@dataclass(frozen=True, eq=False)
class Part:
    """What moved, and where it was in t frames."""

    articulation: Articulation
    model: PartModel
    q: Float[np.ndarray, " t"]
    observed: Bool[np.ndarray, " t"]
    last: int
    """frame in which it comes to rest"""


def handle_of(
    part: Part,
    stack: DepthStack,
    ref: Reference,
    T_world_cam: Float[np.ndarray, "4 4"],
    hand: Float[np.ndarray, "3"],
) -> Found:
    """The handle near where the hand held the part. ref: before it moved; hand: on the part at rest (world)."""
    model, q = part.model, part.q
    way = np.abs(q) * step_m(part.articulation)
    front = float(model.points[model.flat].mean(0) @ model.normal)
    gone = left(stack, ref, np.flatnonzero(stack.usable & (way > _AWAY * way.max())))
    T, handle, seen = handle_near(ref, stack.camera, T_world_cam, model.normal, front, hand, gone)
    if not seen and part.last < len(q) - 3:  # somebody stood before it: look again where it came to rest
        after = reference(stack, np.arange(part.last + 1, len(q)), T_world_cam)
        moved = motions(part.articulation, q[-1:])[0]
        came = left(stack, after, np.flatnonzero(stack.usable & (way < _AT_REST)))
        at, normal = transform_points(moved, hand), moved[:3, :3] @ model.normal
        offset = float(normal @ transform_points(moved, model.normal * front))
        again, found, seen = handle_near(after, stack.camera, T_world_cam, normal, offset, at, came)
        T, handle = (inverse(moved) @ again, found) if seen else (T, handle)
    if seen:
        frames = np.flatnonzero(part.observed)
        T, handle = settle_on_bar(stack, T_world_cam, part.articulation, q, frames, T, handle)
    return T, handle, seen


def handle_near(
    ref: Reference,
    camera: Camera,
    T_world_cam: Float[np.ndarray, "4 4"],
    normal: Float[np.ndarray, "3"],
    front: float,
    hand: Float[np.ndarray, "3"],
    moved: Bool[np.ndarray, "h w"],
) -> Found:
    """What stands out of the front n . p = front near the hand, among pixels whose surface moved (`find_handle`)."""
    ray = hand - T_world_cam[:3, 3]
    pixel_m = float(ray @ T_world_cam[:3, 2]) / camera.fx
    return find_handle(ref, normal, front, hand, ray / np.linalg.norm(ray), pixel_m, moved)
