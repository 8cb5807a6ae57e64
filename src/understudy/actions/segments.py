"""Demonstrations made comparable: cut into segments, each over a phase from 0 to 1, relative to the object.

Reach and release run over time. Manipulation runs over the share of the opening, so that doors of other radii, drawers
of other travel and objects opened less far meet at the same phase: the robot then stands to the handle as it stood in
the demonstrations when theirs was as far open, and its arm is bent as it was, which the adaptation had made feasible.
When the handle goes through the opening is learnt apart (`progress`). Neighbouring segments share the sample between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.optimize import isotonic_regression

from understudy.actions.features import Carrier, Mirror, Relative
from understudy.actions.motions import RobotMotion
from understudy.actions.objects import ObjectMotion
from understudy.errors import UnderstudyError
from understudy.objects.articulation import FIXED

REACH, MANIPULATE, RELEASE = SEGMENTS = ("reach", "manipulate", "release")
LEAST_SAMPLES: Final = 5
"""of every segment"""
LEAST_WAY_M: Final = 0.02
"""that the handle must go, unless its object is fixed"""

_KNOTS: Final = 33  # of the progress over time


@dataclass(frozen=True, eq=False)
class SegmentPath:
    """One segment of one demonstration."""

    poses: Relative
    phase: Float[np.ndarray, " n"]
    """0 to 1, never falling"""
    duration_s: float


@dataclass(frozen=True, eq=False)
class Comparable:
    """One demonstration, relative to its object."""

    paths: dict[str, SegmentPath]
    """of SEGMENTS"""
    progress: Float[np.ndarray, " 33"]
    """share of the opening at evenly spaced times of the manipulation, from 0 to 1, never falling"""
    object: ObjectMotion

    def mirrored(self, mirror: Mirror) -> Comparable:
        """Seen in a mirror. The object stays: only what the robot does is mirrored."""
        paths = {
            name: SegmentPath(path.poses.mirrored(mirror), path.phase, path.duration_s)
            for name, path in self.paths.items()
        }
        return Comparable(paths, self.progress, self.object)


def comparable(motion: RobotMotion, where: str) -> Comparable:
    """Cuts a demonstration. Raises UnderstudyError that begins with `where`: too short, or nothing moved."""
    grasp, release = motion.segments.grasp, motion.segments.release
    spans = dict(
        zip(SEGMENTS, ((0, grasp), (grasp, min(release, len(motion) - 1)), (release, len(motion) - 1)), strict=True)
    )
    for name, (first, last) in spans.items():
        if last - first + 1 < LEAST_SAMPLES:
            raise UnderstudyError(
                f"{where}: {name} has {max(last - first, 0)} samples; a segment needs {LEAST_SAMPLES - 1} at least"
            )
    q = motion.articulation.position(motion.T_world_object)
    q = np.unwrap(q) if motion.articulation.kind == "revolute" else q
    q_start, q_goal = float(np.median(q[: grasp + 1])), float(np.median(q[release : release + LEAST_SAMPLES]))
    start = motion.articulation.pose(np.array([q_start]))[0]
    thing = ObjectMotion(motion.articulation, start, q_start, q_goal)
    if motion.articulation.kind != FIXED and thing.way_m < LEAST_WAY_M:
        raise UnderstudyError(f"{where}: the handle moves by {1000 * thing.way_m:.0f} mm only during manipulation")
    held = motion.times_s[grasp : release + 1]
    held = (held - held[0]) / (held[-1] - held[0])
    share = _share(q[grasp : release + 1], thing, held)
    q = np.concatenate([np.full(grasp, q_start), q_start + share * thing.travel, np.full(len(q) - release - 1, q_goal)])
    carrier = thing.carrier(q)
    paths = {}
    for name, (first, last) in spans.items():
        part = slice(first, last + 1)
        t = motion.times_s[part]
        frames = Carrier(carrier.T[part], carrier.floor[part])
        poses = Relative.of(frames, motion.T_world_tool[part], motion.xy_yaw[part], motion.torso_height[part])
        time = (t - t[0]) / (t[-1] - t[0])
        paths[name] = SegmentPath(poses, share if name == MANIPULATE else time, float(t[-1] - t[0]))
    progress = np.interp(np.linspace(0, 1, _KNOTS), held, share)
    return Comparable(paths, progress, thing)


def _share(q: np.ndarray, thing: ObjectMotion, time: np.ndarray) -> Float[np.ndarray, " n"]:
    """Share of the opening that is done: the nearest monotone sequence to the measured one, from 0 to 1."""
    if thing.articulation.kind == FIXED:
        return time
    raw = (q - thing.q_start) / thing.travel
    raw[0], raw[-1] = 0.0, 1.0
    return np.asarray(isotonic_regression(np.clip(raw, 0, 1)).x)


def progress_curve(progress: Float[np.ndarray, " 33"]) -> CubicHermiteSpline:
    """Smooth, monotone (Fritsch and Carlson 1980), and at rest at both ends."""
    time = np.linspace(0, 1, len(progress))
    slope = PchipInterpolator(time, progress).derivative()(time)
    slope[[0, -1]] = 0.0
    return CubicHermiteSpline(time, progress, slope)
