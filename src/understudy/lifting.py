"""From 2D keypoints and depth to people in 3D. A method is a `Lifter`; `methods` names them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import gammainc

from understudy.camera import Camera
from understudy.skeleton import JOINTS, TORSO, rows
from understudy.types import INFERRED, MISSING, OBSERVED, Keypoints2D, Person, RegisteredDepth, RegisteredFrame

NEAREST = 3
"""valid depths whose median is taken (the paper's naive lifting)"""
RADIUS = 0.02
"""search radius around a keypoint, in image widths: about 19 pixels of a 960-pixel image"""

BALL_68 = 1.8724
"""radius that holds 68 % of an isotropic 3D Gaussian, in its standard deviations along one axis"""

SEEN_SCORE = 0.5
"""a 2D keypoint with a lower score is likely hidden (the paper's threshold for its score maps)"""

# Metres from the visible surface to the joint inside the body: what naive lifting leaves out.
_JOINT_DEPTH = {"neck": 0.06, "shoulder": 0.065, "elbow": 0.04, "wrist": 0.03, "hip": 0.11, "knee": 0.05, "ankle": 0.04}
_SURFACE_TO_JOINT = np.array([_JOINT_DEPTH.get(name.split("_")[-1], 0.02) for name in JOINTS])
_SIGMA_2D = 0.004  # of a 2D keypoint, in image widths
# Metres that a joint can lie before or behind the torso; further away it is something else that was measured.
_REACH = {"neck": 0.35, "shoulder": 0.35, "hip": 0.35, "elbow": 0.55, "wrist": 0.8, "knee": 0.65, "ankle": 0.95}
_REACH_OF_JOINT = np.array([_REACH.get(name.split("_")[-1], 0.4) for name in JOINTS])
_SIGMA_UNSEEN = 0.3  # metres: of a joint that is surely hidden, lifted to what hides it
_SHOULDERS = rows("right_shoulder", "left_shoulder")
_SHOULDER_WIDTH = 0.33  # metres between the joints of an adult


@runtime_checkable
class Lifter(Protocol):
    """Lifts all people of one frame."""

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        """One Person for each entry of `people`, in their order. Who cannot be lifted is a `Person.failure`."""
        ...


class NaiveLifter:
    """The paper's baseline, "naive lifting": each 2D keypoint, back-projected at the depth under it.

    The depth is the median of the 3 valid values nearest to the keypoint. A joint without a 2D keypoint, or without 3
    valid depths within `RADIUS`, has no position. A hidden joint lands on what hides it: the position stays the
    paper's, but where the 2D score is low, or no body could reach from the torso to that depth, `source` is inferred
    and sigma large. Sigma also grows for shoulders that come out too narrow.
    """

    def __init__(self, min_score: float = 0.2):
        """min_score: a 2D keypoint with a lower score counts as not found."""
        self.min_score = min_score

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        if not people:
            return []
        uv = np.stack([p.uv for p in people])
        found = np.stack([p.found & (p.score >= self.min_score) for p in people])
        depths = nearest_depths(frame.depth, frame.camera, np.where(found[..., None], uv, np.nan).reshape(-1, 2))
        z = np.median(depths, axis=1).reshape(found.shape).astype(np.float64)
        spread = np.ptp(depths, axis=1).reshape(found.shape)
        keypoints = frame.camera.unproject(uv, z)
        sigma = _sigma(z, spread, frame.camera)
        return [self._person(*args) for args in zip(people, keypoints, sigma, strict=True)]

    @staticmethod
    def _person(seen: Keypoints2D, keypoints: np.ndarray, sigma: np.ndarray) -> Person:
        lifted = np.isfinite(keypoints).all(1)
        if not lifted.any():
            return Person.failure(seen, "no depth near any of the 2D keypoints")
        beyond = _beyond_reach(seen, keypoints)
        weak = np.clip(SEEN_SCORE - seen.score, 0, None) / SEEN_SCORE
        sigma = np.hypot(np.hypot(sigma, beyond), _SIGMA_UNSEEN * weak)
        sigma[_SHOULDERS] = np.hypot(sigma[_SHOULDERS], _missing_width(keypoints))
        # 10 cm in units of an isotropic Gaussian's sigma -> probability (chi distribution, 3 degrees of freedom)
        within = gammainc(1.5, np.where(lifted, 0.1 / np.where(lifted, sigma, 1), 0) ** 2 / 2)
        return Person(
            keypoints_2d=seen,
            keypoints=np.where(lifted[:, None], keypoints, np.nan),
            confidence=seen.score * within,
            sigma_m=np.where(lifted, BALL_68 * sigma, np.nan),
            source=tuple(np.where(lifted, np.where((beyond > 0) | (weak > 0), INFERRED, OBSERVED), MISSING).tolist()),
        )


def _sigma(z: np.ndarray, spread: np.ndarray, camera: Camera) -> np.ndarray:
    """One isotropic standard deviation (metres) with the same mean square error as: the joint's unknown distance behind
    the surface, the spread of the depths, the keypoint's jitter. A rough model; it does not know of occlusion.
    """
    across = _SIGMA_2D * camera.width / camera.fx * z
    return np.sqrt((_SURFACE_TO_JOINT**2 + spread**2 + 2 * across**2) / 3)


def _beyond_reach(seen: Keypoints2D, keypoints: np.ndarray) -> Float[np.ndarray, "18"]:
    """How far (metres) each joint's depth is from the torso's, where that is more than a body allows; else 0."""
    torso = keypoints[TORSO, 2]
    if seen.torso_z is None and not np.isfinite(torso).any():
        return np.zeros(len(keypoints))
    torso_z = float(np.nanmedian(torso)) if seen.torso_z is None else seen.torso_z
    away = np.abs(np.nan_to_num(keypoints[:, 2], nan=torso_z) - torso_z)
    return np.where(away > _REACH_OF_JOINT, away, 0.0)


def _missing_width(keypoints: np.ndarray) -> float:
    """What the shoulders lack (metres) of an adult's width: from the side, the far one is lifted to the near side."""
    right, left = keypoints[_SHOULDERS]
    width = float(np.linalg.norm(right - left))
    return max(0.0, _SHOULDER_WIDTH - width) / np.sqrt(3) if np.isfinite(width) else 0.0


def nearest_depths(
    depth: RegisteredDepth, color: Camera, uv: Float[np.ndarray, "n 2"], k: int = NEAREST, radius: float = RADIUS
) -> Float32[np.ndarray, "n k"]:
    """The k valid depths (metres) nearest in the image to each colour pixel, nearest first.

    A row is NaN where fewer than k lie within `radius` (image widths), or where uv is not finite. Equal distances are
    taken by row, then column.
    """
    scale = depth.scale_to(color)
    center = (np.asarray(uv, dtype=np.float64) + 0.5) * scale - 0.5
    out = np.full((len(center), k), np.nan, np.float32)
    todo = np.flatnonzero(np.isfinite(center).all(1))
    reach = radius * depth.camera.width
    for r in (min(4.0, reach), min(12.0, reach), reach):  # the small windows settle nearly all
        if len(todo):
            values = _nearest_within(depth.z, center[todo], k, r)
            out[todo] = values
            todo = todo[np.isnan(values).any(1)]
    out[np.isnan(out).any(1)] = np.nan
    return out


def _nearest_within(z: np.ndarray, center: np.ndarray, k: int, reach: float) -> np.ndarray:
    """`nearest_depths` in depth pixels, with NaN for values beyond `reach` pixels."""
    r = int(np.ceil(reach)) + 1
    offset = np.arange(-r, r + 1)
    column = np.rint(center[:, :1]).astype(np.int64) + offset
    row = np.rint(center[:, 1:]).astype(np.int64) + offset
    h, w = z.shape
    values = z[row.clip(0, h - 1)[:, :, None], column.clip(0, w - 1)[:, None, :]]
    distance2 = (row - center[:, 1:])[:, :, None] ** 2 + (column - center[:, :1])[:, None, :] ** 2
    inside = ((row >= 0) & (row < h))[:, :, None] & ((column >= 0) & (column < w))[:, None, :]
    distance2[~(inside & (values > 0) & (distance2 <= reach**2))] = np.inf
    values, distance2 = values.reshape(len(center), -1), distance2.reshape(len(center), -1)
    if values.shape[1] < k:
        return np.full((len(center), k), np.nan, np.float32)
    order = np.argsort(distance2, axis=1, kind="stable")[:, :k]
    chosen = np.take_along_axis(values, order, 1)
    return np.where(np.isfinite(np.take_along_axis(distance2, order, 1)), chosen, np.float32(np.nan))
