"""Hand and torso of the person who acts, in the world, from the tracked joints and the palms of single frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from understudy.geometry import transform_points
from understudy.hands.smoothing import smooth_rotations
from understudy.skeleton import HAND_KEYPOINTS, JOINT, rows
from understudy.tracking import PersonTrack
from understudy.trajectories import PlanarTrack, PoseTrack
from understudy.types import OBSERVED, Palm

PALM_M: Final = 0.085
"""from the wrist to the middle of the palm, of a forearm of MEAN_FOREARM"""
MEAN_FOREARM: Final = 0.255
"""metres"""

_MIDDLE = [HAND_KEYPOINTS.index(name) for name in ("wrist", "index_1", "middle_1", "ring_1", "pinky_1")]
_SIDES = {side: rows(f"{side}_shoulder", f"{side}_hip") for side in ("left", "right")}
_BALL = 1.87  # radius that holds 68 % of a normal distribution in space, in sigmas along an axis
_WINDOW_S = 0.15  # sigma of the window in which the palm's place beside the wrist is measured
_HELD_S = 0.5  # the same while the hand holds the object, in the object's frame
_DOUBT = 0.04  # metres: measurements so far from their neighbours lose half of their weight
_TURN_DOUBT = np.radians(25)
_LEAST = 0.3  # of the weight of a sure measurement: fewer do not count as one


def torso_track(track: PersonTrack, T_world_cam: Float[np.ndarray, "4 4"]) -> PlanarTrack:
    """Below the middle of shoulders and hips; the heading is square to the lines through shoulders and hips."""
    joints = transform_points(T_world_cam, track.keypoints)
    variance = (track.sigma_m / _BALL) ** 2
    left, right = (joints[:, _SIDES[side]] for side in ("left", "right"))
    v = np.stack([variance[:, _SIDES[side]] for side in ("left", "right")], axis=1)  # t, side, shoulder or hip
    middle = (left + right).mean(axis=1) / 2
    across = (left - right)[..., :2]  # t, shoulder or hip, xy
    weight = 1 / np.maximum(v.sum(axis=1), 1e-6)
    share = weight / weight.sum(axis=1, keepdims=True)
    line = (share[..., None] * across).sum(axis=1)
    yaw = np.arctan2(-line[:, 0], line[:, 1])  # left is a quarter turn from the way that the chest faces
    known = np.isfinite(yaw) & np.isfinite(middle).all(axis=1)
    yaw[known] = np.unwrap(yaw[known])
    covariance = np.zeros((len(yaw), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = v.mean(axis=(1, 2))
    width = np.maximum(np.linalg.norm(line, axis=1), 0.1)
    covariance[:, 2, 2] = (share**2 * v.sum(axis=1)).sum(axis=1) / width**2
    observed = np.stack([measured_joints(track)[:, _SIDES[side]] for side in ("left", "right")], axis=1)
    xy_yaw = np.column_stack([middle[:, :2], yaw])
    xy_yaw[~known] = np.nan
    return PlanarTrack(xy_yaw, covariance, (observed.sum(axis=(1, 2)) >= 2) & known)


def measured_joints(track: PersonTrack) -> Bool[np.ndarray, "t 18"]:
    """Which joints the camera saw: those that the network inferred behind something are not measurements."""
    seen: Bool[np.ndarray, "t 18"] = track.observed & (track.source == OBSERVED)
    return seen


def on_the_floor(torso: PoseTrack) -> PlanarTrack:
    """The planar track of a torso that is followed in space (x the way that the chest faces)."""
    R = torso.T_world_x[:, :3, :3]
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    known = torso.known
    yaw[known] = np.unwrap(yaw[known])
    rows_ = [0, 1, 5]
    return PlanarTrack(
        np.column_stack([torso.positions[:, :2], yaw]), torso.covariance[:, rows_][:, :, rows_], torso.observed
    )


def hand_track(
    track: PersonTrack, palms: Sequence[Palm | None], side: str, T_world_cam: Float[np.ndarray, "4 4"]
) -> PoseTrack:
    """One hand. palms: of the single frames (None where there is none), at the track's times.

    The palm's middle is where the palms' keypoints have it beside the tracked wrist, in a short window; without any it
    is that far from the wrist as the size of the forearm says, in the direction of the hand, or of the forearm.
    """
    times = track.times_s
    wrist, elbow = (track.keypoints[:, JOINT[f"{side}_{name}"]] for name in ("wrist", "elbow"))
    sure = np.array([0.0 if p is None or p.R_cam_hand is None else p.confidence for p in palms])
    R = np.array([_rotation(p) for p in palms])
    smooth = smooth_rotations(times, R, sure)
    forearm = wrist - elbow
    length = np.linalg.norm(forearm, axis=1)
    along = np.where(np.isfinite(smooth.R[:, :, 0]), smooth.R[:, :, 0], forearm / np.maximum(length, 1e-6)[:, None])
    reach = PALM_M * (np.nanmedian(length) / MEAN_FOREARM if np.isfinite(length).any() else 1.0)
    measured = np.array([_palm_middle(p) for p in palms]).reshape(-1, 3) - wrist
    beside, spread, support = local_mean(times, measured, sure, _WINDOW_S)
    offset = np.where((support > _LEAST)[:, None], beside, along * reach)
    position = wrist + offset
    known = np.isfinite(position).all(axis=1)
    sigma = track.sigma_m[:, JOINT[f"{side}_wrist"]] / _BALL
    near = np.hypot(np.nan_to_num(spread, nan=1.0), 0.012)
    sigma = np.where(support > _LEAST, np.minimum(sigma, near), np.hypot(sigma, 0.03))
    rotation = np.where(np.isfinite(smooth.R), smooth.R, _of_forearm(along))
    oriented = np.isfinite(smooth.R).all(axis=(1, 2)) & (sure > 0)
    turn = np.where(np.isfinite(smooth.spread), np.hypot(np.nan_to_num(smooth.spread), np.radians(10)), np.radians(70))
    T = np.full((len(times), 4, 4), np.nan)
    ok = known & np.isfinite(rotation).all(axis=(1, 2))
    T[ok] = np.eye(4)
    T[ok, :3, :3], T[ok, :3, 3] = rotation[ok], position[ok]
    T[ok] = T_world_cam @ T[ok]
    observed = measured_joints(track)[:, JOINT[f"{side}_wrist"]] & ok
    return PoseTrack(T, _isotropic(sigma, turn, ok), observed, oriented & ok)


def hold(hand: PoseTrack, object: PoseTrack, times_s: Float[np.ndarray, " t"], span: slice) -> PoseTrack:
    """The hand, smoothed in the object's frame while it holds the object (samples in `span`).

    A hand that holds something keeps its place on it, so there a longer window loses nothing: what the hand does is
    what the object does. Where the object is not known the hand stays as it is.
    """
    inside = np.zeros(len(times_s), bool)
    inside[span] = True
    both = np.flatnonzero(inside & hand.known & object.known)
    if len(both) < 3:
        return hand
    T_object_world = np.linalg.inv(object.T_world_x[both])
    held = T_object_world @ hand.T_world_x[both]
    sigma = np.sqrt(np.trace(hand.covariance[both, :3, :3], axis1=1, axis2=2) / 3)
    weight = np.where(hand.observed[both], np.clip(0.03 / sigma, 0, 1) ** 2, 0.0)
    place, spread, support = local_mean(times_s[both], held[:, :3, 3], weight, _HELD_S)
    turn_weight = np.where(hand.oriented[both], 1.0, 0.0)
    smooth = smooth_rotations(times_s[both], held[:, :3, :3], turn_weight, _HELD_S)
    T, covariance = hand.T_world_x.copy(), hand.covariance.copy()
    better = support > 1.0
    rows_ = both[better]
    T[rows_, :3, 3] = transform_all(object.T_world_x[rows_], place[better])
    variance = np.minimum(spread[better] ** 2 / 3 + 0.01**2, covariance[rows_, 0, 0])
    covariance[rows_[:, None], np.arange(3), np.arange(3)] = variance[:, None]
    turned = np.isfinite(smooth.R).all(axis=(1, 2)) & (smooth.support > 1.0)
    T[both[turned], :3, :3] = object.T_world_x[both[turned], :3, :3] @ smooth.R[turned]
    return PoseTrack(T, covariance, hand.observed, hand.oriented)


def transform_all(T: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Each point by its own transform."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def local_mean(
    times_s: Float[np.ndarray, " t"], values: Float[np.ndarray, "t 3"], weight: Float[np.ndarray, " t"], sigma_s: float
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Means in a Gaussian window, reweighted against outliers; with the RMS distance to them, and the sum of weights.

    Values may be NaN; where no weight is near, so is the mean.
    """
    known = np.isfinite(values).all(axis=1) & (weight > 0)
    y, w0 = values[known], weight[known]
    if not len(y):
        return np.full_like(values, np.nan), np.full(len(times_s), np.nan), np.zeros(len(times_s))
    base = np.exp(-0.5 * ((times_s[known] - times_s[:, None]) / sigma_s) ** 2) * w0
    w = base
    for k in range(6):
        total = np.maximum(w.sum(axis=1), 1e-12)
        mean = (w @ y) / total[:, None]
        if k == 0:  # a start that a few gross outliers do not move
            mean = mean + np.median(y - mean[np.flatnonzero(known)], axis=0)
        away = np.linalg.norm(y - mean[:, None], axis=2)
        w = base / (1 + (away / _DOUBT) ** 2)
    support = base.sum(axis=1)
    total = np.maximum(w.sum(axis=1), 1e-12)
    mean, spread = (w @ y) / total[:, None], np.sqrt((w * away**2).sum(axis=1) / total)
    nothing = support < 1e-6
    mean[nothing], spread[nothing] = np.nan, np.nan
    return mean, spread, support


def _rotation(palm: Palm | None) -> Float[np.ndarray, "3 3"]:
    R = None if palm is None else palm.R_cam_hand
    return np.full((3, 3), np.nan) if R is None else R


def _palm_middle(palm: Palm | None) -> Float[np.ndarray, "3"]:
    """Of the keypoints at wrist and knuckles; NaN if fewer than three of them are supported."""
    if palm is None or palm.keypoints is None:
        return np.full(3, np.nan)
    points = palm.keypoints[_MIDDLE]
    points = points[np.isfinite(points).all(axis=1)]
    middle: Float[np.ndarray, "3"] = points.mean(axis=0) if len(points) >= 3 else np.full(3, np.nan)
    return middle


def _of_forearm(along: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3 3"]:
    """A hand frame in the camera's frame when only the direction of the fingers is known: palm down, or towards the
    side; its covariance says how little that is worth.
    """
    down = np.array([0.0, 1.0, 0.0])
    z = down - along * (along @ down)[:, None]
    z = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-6)
    x = along - z * (along * z).sum(axis=1, keepdims=True)
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-6)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    good = np.isfinite(R).all(axis=(1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(R)) - 1) < 1e-6)
    R[~good] = np.nan
    if good.any():
        R[good] = Rotation.from_matrix(R[good]).as_matrix()
    return R


def _isotropic(
    sigma: Float[np.ndarray, " t"], turn: Float[np.ndarray, " t"], known: Bool[np.ndarray, " t"]
) -> Float[np.ndarray, "t 6 6"]:
    covariance = np.zeros((len(sigma), 6, 6))
    position, rotation = np.arange(3), np.arange(3, 6)
    covariance[:, position, position] = np.where(known, sigma, np.nan)[:, None] ** 2
    covariance[:, rotation, rotation] = np.where(known, turn, np.nan)[:, None] ** 2
    return covariance
