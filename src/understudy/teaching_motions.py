"""Adapted demonstrations as what action models are learnt from: on a finer clock, the object along a smooth opening.

The opening that a camera measured has the camera's noise, and an action model learns when the handle goes through it:
noise there is acceleration of the robot. So the opening while the handle is held is a smooth monotone curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, CubicSpline
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation, RotationSpline

from understudy.actions import RobotMotion
from understudy.actions.segments import LEAST_SAMPLES, MANIPULATE
from understudy.adaptation.prepare import object_path
from understudy.adaptation.result import AdaptationResult, Adapted
from understudy.demonstration.demonstration import Demonstration, Segments
from understudy.errors import UnderstudyError
from understudy.objects.articulation import FIXED, REVOLUTE

RATE_HZ: Final = 50.0
"""while the object is held: with fewer samples, straight lines between them are kinks in the learnt opening"""

_DEGREE: Final = 5  # of the splines: the jerk is continuous
_KNOTS_PER_SAMPLE: Final = 0.7
_INTERVALS: Final = (4, 30)  # least and most
_SMOOTHEST, _ROUGHEST, _STEPS = 1e1, 1e-7, 33  # weights of the jerk that are tried, from the first on
_LEAST_NOISE: Final = 0.004  # share of the opening that a sample may always be off: 1 mm of 25 cm
_FULLY: Final = 1e3  # weight of the whole opening being 1
_ROUGH: Final = np.sqrt(20.0)  # standard deviation of third differences over that of white noise
_ENDS: Final = 5  # samples whose median is where the object rests


def too_short(demonstration: Demonstration) -> str:
    """Why nothing can be learnt from a demonstration; empty if something can."""
    for name, part in demonstration.segments.slices(len(demonstration)).items():
        if name != MANIPULATE and part.stop - part.start < LEAST_SAMPLES + 1:
            return f"{name} has {max(part.stop - part.start, 0)} samples only: record for longer before and after"
    return ""


def robot_motions(demonstrations: Sequence[Demonstration], result: AdaptationResult) -> list[RobotMotion]:
    """What the robot would do in each demonstration, ready for `actions.learn`.

    demonstrations: those that `result` was adapted from, in the same order. Raises UnderstudyError if they are not.
    """
    if len(demonstrations) != len(result.demonstrations):
        raise UnderstudyError(
            f"motions: {len(demonstrations)} demonstrations, but {len(result.demonstrations)} adapted ones"
        )
    return [robot_motion(d, a) for d, a in zip(demonstrations, result.demonstrations, strict=True)]


def robot_motion(demonstration: Demonstration, adapted: Adapted) -> RobotMotion:
    """One demonstration. While the object is held, it has `RATE_HZ` samples a second."""
    d, a = demonstration, adapted
    times, segments = _finer(a.times_s, d.segments)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, 3] = CubicSpline(a.times_s, a.T_world_tool[:, :3, 3])(times)
    T[:, :3, :3] = RotationSpline(a.times_s, Rotation.from_matrix(a.T_world_tool[:, :3, :3]))(times).as_matrix()
    rest = CubicSpline(a.times_s, np.column_stack([a.base, a.torso]))(times)
    q = smooth_opening(demonstration, a.times_s, times)
    return RobotMotion(times, T, rest[:, :3], rest[:, 3], d.articulation.pose(q), d.articulation, d.handle, segments)


def smooth_opening(
    demonstration: Demonstration, times_s: Float[np.ndarray, " t"], at_s: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The object's position along its articulation at the times `at_s`: at rest before and after it is held.

    times_s: of the demonstration's samples. Where the object was not seen, it is interpolated.
    """
    d, segments = demonstration, demonstration.segments
    if d.articulation.kind == FIXED:
        return np.zeros(len(at_s))
    q = d.articulation.position(object_path(d))
    q = np.unwrap(q) if d.articulation.kind == REVOLUTE else q
    first, last = segments.grasp, min(segments.release, len(d) - 1)
    begin, end = float(np.median(q[: first + 1])), float(np.median(q[last : last + _ENDS]))
    held = times_s[first : last + 1]
    if begin == end or len(held) < 3:
        return np.interp(at_s, times_s, q)
    share = smooth_share((held - held[0]) / (held[-1] - held[0]), (q[first : last + 1] - begin) / (end - begin))
    time = np.clip((at_s - held[0]) / (held[-1] - held[0]), 0, 1)
    return begin + (end - begin) * share(time)


def smooth_share(time: Float[np.ndarray, " n"], share: Float[np.ndarray, " n"]) -> BSpline:
    """The smoothest curve from 0 to 1 over [0, 1] that is as far from noisy samples as their noise is.

    It never falls, and has no speed and no acceleration at its ends. Of penalised B-splines (Eilers and Marx 1996) with
    increments that are not negative, the one whose jerk weighs most and whose residual is no larger than the noise
    (Morozov's discrepancy principle); the noise is that of the samples' third differences.
    """
    intervals = int(np.clip(round(_KNOTS_PER_SAMPLE * len(time)), *_INTERVALS))
    knots = np.concatenate([np.zeros(_DEGREE), np.linspace(0, 1, intervals + 1), np.ones(_DEGREE)])
    A = BSpline.design_matrix(time, knots, _DEGREE).toarray()
    sites = np.convolve(knots, np.ones(_DEGREE) / _DEGREE, "valid")[1:-1]  # Greville's: coefficient i is about there
    jerk = _third_derivative(sites)
    n = A.shape[1]
    # coefficients are sums of increments; 3 equal ones at an end are a curve at rest there
    sums = np.tril(np.ones((n, n)))[:, 3:-2]
    noise = max(_LEAST_NOISE, float(np.diff(share, 3).std() / _ROUGH) if len(share) > 6 else 0.0)
    found = np.zeros(n)
    for weight in np.geomspace(_SMOOTHEST, _ROUGHEST, _STEPS):
        rows = [A @ sums / np.sqrt(len(time)), np.sqrt(weight) * jerk @ sums, np.full((1, sums.shape[1]), _FULLY)]
        target = np.concatenate([share / np.sqrt(len(time)), np.zeros(len(jerk)), [_FULLY]])
        found = sums @ nnls(np.concatenate(rows), target)[0]
        if np.sqrt(np.mean((A @ found - share) ** 2)) <= noise:
            break
    return BSpline(knots, found / found[-1], _DEGREE)


def _third_derivative(sites: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m n"]:
    """Divided differences of coefficients at their sites, in units in which a curve from 0 to 1 has jerk around 1."""
    D = np.eye(len(sites))
    for k in range(1, 4):
        D = np.diff(D, axis=0) / (sites[k:] - sites[:-k])[:, None] * k
    return D / (60 * np.sqrt(len(D)))  # 60: greatest jerk of the minimum-jerk curve


def _finer(times_s: Float[np.ndarray, " t"], segments: Segments) -> tuple[Float[np.ndarray, " n"], Segments]:
    """The clock with more samples, even ones, while the object is held.

    Only there: from sample to sample, `actions` tells what is noise in the ways to the object and from it.
    """
    first, last = segments.grasp, min(segments.release, len(times_s) - 1)
    n = max(round(float(times_s[last] - times_s[first]) * RATE_HZ), last - first)
    held = np.linspace(times_s[first], times_s[last], n, endpoint=False)
    return np.concatenate([times_s[:first], held, times_s[last:]]), Segments(first, first + n)
