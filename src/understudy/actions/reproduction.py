"""The segments of an action model, chained into one motion of gripper, base and torso without jumps."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions.features import BASE, POSITION, ROTATION, YAW, N, Relative
from understudy.actions.motions import RobotPose
from understudy.actions.objects import ObjectMotion
from understudy.actions.rotations import right_jacobian
from understudy.actions.segments import MANIPULATE, REACH, RELEASE, SEGMENTS, progress_curve
from understudy.demonstration.demonstration import Segments
from understudy.errors import UnderstudyError

if TYPE_CHECKING:
    from understudy.actions.model import ActionModel, SegmentModel

_MEET: Final = 0.3  # of a segment: within this much of its end it bends to meet its neighbour
_STOP: Final = 0.15  # of a segment: within this much of its end it comes to rest
_JOIN: Final = 0.7  # of the reach: by then the robot has come from where it was to where the model would be
_QUICKEST: Final = 0.5  # of the demonstrated time of manipulation
_DENSE: Final = 100
_SHORT: Final = 0.2  # metres: ways below are not told apart when the reach is given more time
_RATES: Final = (1.0, 1000.0)  # per second


@dataclass(frozen=True, eq=False)
class Reproduction:
    """A motion for the robot: means, and how sure the model is. World frame."""

    times_s: Float[np.ndarray, " t"]
    """from 0, evenly spaced"""
    T_world_tool: Float[np.ndarray, "t 4 4"]
    xy_yaw: Float[np.ndarray, "t 3"]
    """of the base: metres, metres, radians (unwrapped; within half a turn of the start, or of 0, at first)"""
    torso_height: Float[np.ndarray, " t"]
    """metres; the robot's limits are not the model's business"""
    covariance: Float[np.ndarray, "t 10 10"]
    """of (dp, dr) of the tool, (dx, dy, dyaw) of the base and the torso's height. Metres and radians, along the world's
    axes: p_true = p + dp, R_true = Exp(dr) R"""
    segments: Segments
    """grasp: the sample at which the gripper closes; release: at which it opens. The robot is at rest at both"""
    q: Float[np.ndarray, " t"]
    """position of the object along its articulation"""
    T_world_object: Float[np.ndarray, "t 4 4"]
    """of the handle"""

    def __len__(self) -> int:
        return len(self.times_s)

    def until(self, time_s: float) -> Reproduction:
        """Its beginning; nothing before the gripper opens is left out."""
        n = max(int(np.searchsorted(self.times_s, time_s + 1e-9, side="right")), self.segments.release + 1)
        tracks = {f.name: getattr(self, f.name)[:n] for f in fields(self) if f.name != "segments"}
        return replace(self, **tracks)


def reproduce(model: ActionModel, thing: ObjectMotion, rate_hz: float, start: RobotPose | None) -> Reproduction:
    """The motion for an object. The model has to fit it already: same kind, same side (`ActionModel.reproduce`)."""
    if not _RATES[0] <= rate_hz <= _RATES[1]:
        raise UnderstudyError(f"rate_hz must be in {_RATES}, got {rate_hz}")
    ends = _ends(model, thing, start)
    scale = dict.fromkeys(SEGMENTS, 1.0)
    if model.object.way_m > 0:
        # the handle is as fast as was demonstrated; but however short its way, the base may have its own to go
        scale[MANIPULATE] = max(thing.way_m / model.object.way_m, _QUICKEST)
    if start is not None:
        scale[REACH] = _detour(model, ends)
    steps = [max(2, round(model.segments[name].duration_s[0] * scale[name] * rate_hz)) for name in SEGMENTS]
    parts, covariances, qs = [], [], []
    for name, n in zip(SEGMENTS, steps, strict=True):
        time = np.linspace(0, 1, n + 1)[: n + (name == RELEASE)]  # as in Segments, borders belong to what follows
        y, S = _segment(model, name, time, ends)
        q = _opening(model, thing, name, time)
        carrier = thing.carrier(q)
        chart = model.segments[name].chart
        J = chart.jacobian(y, carrier)
        parts.append(chart.poses(y).world(carrier))
        covariances.append(J @ S @ J.swapaxes(1, 2))
        qs.append(q)
    T_world_tool, xy_yaw, torso = (np.concatenate(part) for part in zip(*parts, strict=True))
    xy_yaw[:, 2] = np.unwrap(xy_yaw[:, 2])
    turned = xy_yaw[0, 2] - (0.0 if start is None else start.xy_yaw[2])
    xy_yaw[:, 2] -= 2 * np.pi * np.round(turned / (2 * np.pi))  # a base does not turn all the way round to begin
    q = np.concatenate(qs)
    return Reproduction(
        np.arange(sum(steps) + 1) / rate_hz,
        T_world_tool,
        xy_yaw,
        torso,
        np.concatenate(covariances),
        Segments(steps[0], steps[0] + steps[1]),
        q,
        thing.poses(q),
    )


def _opening(model: ActionModel, thing: ObjectMotion, name: str, time: np.ndarray) -> Float[np.ndarray, " t"]:
    share = {REACH: np.zeros_like(time), RELEASE: np.ones_like(time)}
    done = progress_curve(model.progress)(time) if name == MANIPULATE else share[name]
    return np.asarray(thing.q_start + thing.travel * done)


def _ends(
    model: ActionModel, thing: ObjectMotion, start: RobotPose | None
) -> dict[str, tuple[Relative | None, Relative | None]]:
    """Poses, relative to the carrier, at which each segment has to begin and to end; None: where it would."""
    segments = [model.segments[name] for name in SEGMENTS]
    meetings = [_meeting(a, b) for a, b in pairwise(segments)]
    first = None
    if start is not None:
        base, torso = start.xy_yaw[None], np.array([start.torso_height])
        first = Relative.of(thing.carrier(np.array([thing.q_start])), start.T_world_tool[None], base, torso)
    return dict(zip(SEGMENTS, zip((first, *meetings), (*meetings, None), strict=True), strict=True))


def _meeting(before: SegmentModel, after: SegmentModel) -> Relative:
    """Where two segments meet: the mean of what they say, weighted by their information (product of Gaussians)."""
    a, b = before.predict(np.ones(1)), after.predict(np.zeros(1))
    pose_a, pose_b = before.chart.poses(a.mean), after.chart.poses(b.mean)
    R = pose_a.T_carrier_tool[0, :3, :3]
    away = np.zeros(N)
    away[POSITION] = (pose_b.T_carrier_tool - pose_a.T_carrier_tool)[0, :3, 3]
    away[ROTATION] = lie.so3_log(R.T @ pose_b.T_carrier_tool[0, :3, :3])
    away[BASE] = (pose_b.base - pose_a.base)[0]
    away[YAW] = lie.wrapped(away[[YAW]])[0]
    away[-1] = (pose_b.torso - pose_a.torso)[0]
    S_a, S_b = _local(a.mean, a.covariance), _local(b.mean, b.covariance)
    away = S_a @ np.linalg.solve(S_a + S_b, away)
    T = pose_a.T_carrier_tool.copy()
    T[0, :3, 3] += away[POSITION]
    T[0, :3, :3] = R @ lie.so3_exp(away[ROTATION])
    return Relative(T, pose_a.base + away[BASE], pose_a.torso + away[-1])


def _local(mean: Float[np.ndarray, "1 10"], covariance: Float[np.ndarray, "1 10 10"]) -> Float[np.ndarray, "10 10"]:
    """The covariance with rotations as small ones about the tool's own axes."""
    J = np.eye(N)
    J[ROTATION, ROTATION] = right_jacobian(mean[:, ROTATION])[0]
    return np.asarray(J @ covariance[0] @ J.T)


def _segment(
    model: ActionModel, name: str, time: np.ndarray, ends: dict[str, tuple[Relative | None, Relative | None]]
) -> tuple[Float[np.ndarray, "t 10"], Float[np.ndarray, "t 10 10"]]:
    """Features over the time of a segment (0 to 1), bent to begin and end at the given poses and at rest."""
    segment, (first, last) = model.segments[name], ends[name]
    curve = progress_curve(model.progress) if name == MANIPULATE else None
    y = segment.predict(time if curve is None else curve(time))
    mean, covariance = y.mean, y.covariance
    for target, end in ((first, 0.0), (last, 1.0)):
        at = segment.predict(np.array([end]))  # the progress is 0 and 1 there, too
        speed = at.slope[0] * (1.0 if curve is None else curve.derivative()(end))
        value = np.zeros(N) if target is None else segment.chart.features_near(target, at.mean[0]) - at.mean[0]
        reach = _JOIN if name == REACH and end == 0 else _MEET
        mean = mean + _fade(np.abs(time - end), reach)[:, None] * value
        mean = mean - _brake(np.abs(time - end), _STOP)[:, None] * speed * (1 - 2 * end)
    return mean, covariance


def _fade(away: Float[np.ndarray, " t"], width: float) -> Float[np.ndarray, " t"]:
    """From 1 to 0, with speed and acceleration 0 at both ends."""
    u = np.clip(away / width, 0, 1)
    return np.asarray(1 - u**3 * (10 - 15 * u + 6 * u**2))


def _brake(away: Float[np.ndarray, " t"], width: float) -> Float[np.ndarray, " t"]:
    """0 at both ends, with slope 1 at the first and 0 at the other."""
    u = np.clip(away / width, 0, 1)
    return np.asarray(width * u * (1 - u) ** 2)


def _detour(model: ActionModel, ends: dict[str, tuple[Relative | None, Relative | None]]) -> float:
    """How much more time the reach needs from where the robot is, so that it is no faster than demonstrated."""
    time = np.linspace(0, 1, _DENSE)
    planned = _segment(model, REACH, time, ends)[0]
    usual = _segment(model, REACH, time, {**ends, REACH: (None, ends[REACH][1])})[0]
    ratios = [_length(planned[:, part]) / max(_length(usual[:, part]), _SHORT) for part in (slice(0, 3), slice(6, 8))]
    return max(1.0, *ratios)


def _length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
