"""The ten rows of the 2018 paper's table, before and after adaptation, and what else a robot must keep to.

Before: the robot does what the teacher did, G = H X and B = P Y (gaps bridged, the torso in the middle of its range).
Definitions: docs/adaptation.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy import lie
from understudy.adaptation import parts, prepare
from understudy.adaptation.around import Around, Surrounded
from understudy.adaptation.clock import Motion, arm_motion, base_motion
from understudy.adaptation.fields import collision_free
from understudy.adaptation.platform import JointPath, Platform
from understudy.adaptation.result import AdaptationResult
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import UnderstudyError

_NAN: Final = float("nan")

ROWS: Final = {
    "grasp_cm": "gripper-grasp, cm",
    "grasp_deg": "gripper-grasp, deg",
    "hand_cm": "gripper-hand, cm",
    "hand_deg": "gripper-hand, deg",
    "gripper_object_cm": "std gripper-object, cm",
    "gripper_object_deg": "std gripper-object, deg",
    "hand_object_cm": "std hand-object, cm",
    "hand_object_deg": "std hand-object, deg",
    "map_free_percent": "clear of the map, %",
    "achievable_percent": "kinematically achievable, %",
}
"""Field of `Metrics` -> the row's name."""

MORE: Final = {
    "hand_reaching_cm": "gripper-hand while reaching, cm",
    "hand_reaching_median_cm": "the same, median, cm",
    "gripper_speed": "greatest gripper speed, m/s",
    "base_speed": "greatest base speed, m/s",
    "base_acceleration": "greatest base acceleration, m/s^2",
    "within_limits_percent": "within velocity and acceleration limits, %",
    "part_free_percent": "base clear of the moving part, %",
    "arm_scene_percent": "arm clear of the scene, %",
    "arm_part_percent": "arm clear of the moving part, %",
    "joint_speed_percent": "greatest joint velocity, % of its limit",
    "joints_within_percent": "arm joints within velocity and acceleration limits, %",
}

PAPER: Final[Mapping[str, Mapping[str, tuple[float, float, float, float]]]] = {
    "RGB-D": {
        "grasp_cm": (0.40, 0.53, 0.32, 0.19),
        "grasp_deg": (0.24, 0.4, 0.06, 0.07),
        "hand_cm": (32.8, 14.2, 24.2, 19.3),
        "gripper_object_cm": (0.25, 0.15, 0.12, 0.10),
        "gripper_object_deg": (0.14, 0.76, 0.06, 0.03),
        "map_free_percent": (99.51, _NAN, _NAN, _NAN),
        "achievable_percent": (96.05, 97.27, 98.92, 95.12),
    },
    "markers": {
        "hand_cm": (2.2, 2.68, 5.54, 3.13),
        "achievable_percent": (96.86, 99.52, 100.0, 99.93),
    },
}
"""Optimised values of the paper (ICRA 2018), for the tasks in the order of `TASKS`, as far as they are known here."""

PAPER_BEFORE: Final[Mapping[str, Mapping[str, tuple[float, float, float, float]]]] = {
    "RGB-D": {"map_free_percent": (89.14, _NAN, _NAN, _NAN), "achievable_percent": (38.1, 80.0, 60.8, 63.6)},
    "markers": {},
}
"""The same before optimisation."""


@dataclass(frozen=True)
class Metrics:
    """Of all demonstrations of one task. NaN: nothing to measure."""

    grasp_cm: float
    """of (O_tg g*)^-1 G_tg where the hand takes hold, mean over demonstrations"""
    grasp_deg: float
    hand_cm: float
    """of (H_t X)^-1 G_t, mean over the samples with an observed hand"""
    hand_deg: float
    gripper_object_cm: float
    """RMS deviation of O_t^-1 G_t from its Karcher mean within the manipulation, mean over demonstrations"""
    gripper_object_deg: float
    hand_object_cm: float
    """the same of O_t^-1 H_t"""
    hand_object_deg: float
    map_free_percent: float
    """samples at which the exact footprint overlaps no occupied cell"""
    achievable_percent: float
    """samples with an exact solution of the inverse kinematics"""
    hand_reaching_cm: float
    """as `hand_cm`, before the grasp only"""
    hand_reaching_median_cm: float
    """the same, median: what gross outliers among the observations do not change"""
    gripper_speed: float
    """metres/s, between samples"""
    base_speed: float
    base_acceleration: float
    """metres/s^2, over two samples"""
    within_limits_percent: float
    """steps within the base's and torso's velocity limits, the base's acceleration limits"""
    part_free_percent: float = _NAN
    """samples at which no point of the moving part, as far as it is known, is above the footprint"""
    arm_scene_percent: float = _NAN
    """of the samples at which its joints are exact: the arm's links touch nothing of the scene's points"""
    arm_part_percent: float = _NAN
    """the same with the points of the moving part that were seen"""
    joint_speed_percent: float = _NAN
    """of the fastest joint of the arm over its limit, where the arm's motion is continuous"""
    joints_within_percent: float = _NAN
    """steps along which the arm's motion is continuous, through exact solutions, and all its joints are within their
    velocity and acceleration limits; before adaptation, of the joint path that a quick search finds"""


@dataclass(frozen=True, eq=False)
class _Path:
    """What the robot does in one demonstration."""

    tool: Float[np.ndarray, "t 4 4"]
    base: Float[np.ndarray, "t 3"]
    torso: Float[np.ndarray, " t"]
    times_s: Float[np.ndarray, " t"]
    grasp: Float[np.ndarray, "4 4"]
    joints: JointPath | None


def evaluate(demonstrations: Sequence[Demonstration], result: AdaptationResult, robot: Platform) -> dict[str, Metrics]:
    """Metrics 'before' and 'after' of the demonstrations that `result` came from."""
    if len(demonstrations) != len(result.demonstrations):
        raise UnderstudyError(
            f"metrics: {len(demonstrations)} demonstrations, but a result of {len(result.demonstrations)}"
        )
    arounds = prepare.arounds(demonstrations, prepare.Obstacles(demonstrations))
    before = [
        _before(d, a.grasp, around, result, robot)
        for d, around, a in zip(demonstrations, arounds, result.demonstrations, strict=True)
    ]
    after = [_Path(a.T_world_tool, a.base, a.torso, a.times_s, a.grasp, a.joints) for a in result.demonstrations]
    return {
        "before": _metrics(demonstrations, before, result, robot),
        "after": _metrics(demonstrations, after, result, robot),
    }


def _before(
    d: Demonstration, grasp: Float[np.ndarray, "4 4"], around: Around, result: AdaptationResult, robot: Platform
) -> _Path:
    tool, base = prepare.as_shown(d, result.calibration, grasp)
    torso, joints = np.full(len(d), robot.torso_rest), None
    if robot.arm is not None:
        seen_from_base = lie.se3_inverse(lie.se2_to_se3(base)) @ tool
        surrounded = Surrounded(around, base, parts.object_path(d))
        joints = robot.arm.path(seen_from_base, torso, d.times_s, surrounded=surrounded, thorough=False)
    return _Path(tool, base, torso, d.times_s, grasp, joints)


def _metrics(
    demonstrations: Sequence[Demonstration], paths: Sequence[_Path], result: AdaptationResult, robot: Platform
) -> Metrics:
    grasp, hand, reaching, gripper_object, hand_object = [], [], [], [], []
    for d, path in zip(demonstrations, paths, strict=True):
        object, k = prepare.object_path(d), d.segments.grasp
        grasp.append(_size(lie.se3_inverse(object[k : k + 1] @ path.grasp) @ path.tool[k : k + 1]))
        target, _ = prepare.hand_targets(d, result.calibration.hand_tool(d.acting))
        seen = np.isfinite(target).all(axis=(1, 2))
        away = _size(lie.se3_inverse(target[seen]) @ path.tool[seen])
        hand.append(away)
        reaching.append(away[np.flatnonzero(seen) < k])
        holding = prepare.holding(d) & d.object.known
        gripper_object.append(_spread(lie.se3_inverse(object[holding]) @ path.tool[holding]))
        both = holding & d.hand.observed & d.hand.known
        hand_object.append(_spread(lie.se3_inverse(object[both]) @ d.hand.T_world_x[both]))
    free = [collision_free(d.map, robot.footprint, p.base) for d, p in zip(demonstrations, paths, strict=True)]
    panels = [parts.panel_path(d, parts.object_path(d)) for d in demonstrations]
    beside = [parts.beside_part(panel, robot.footprint, p.base) for panel, p in zip(panels, paths, strict=True)]
    seen_from_base = [lie.se3_inverse(lie.se2_to_se3(p.base)) @ p.tool for p in paths]
    achieved = robot.achievable(np.concatenate(seen_from_base), np.concatenate([p.torso for p in paths]))
    columns = [
        *_mean(np.concatenate(grasp)),
        *_mean(np.concatenate(hand)),
        *_mean(np.array(gripper_object)),
        *_mean(np.array(hand_object)),
        100 * float(np.concatenate(free).mean()),
        100 * float(achieved.mean()),
        *_middle(np.concatenate(reaching)[:, 0]),
        *_motion(paths, robot),
        100 * float(np.concatenate(beside).mean()),
        *_arm(paths, robot),
    ]
    return Metrics(*columns)


def _size(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 2"]:
    """Centimetres and degrees of transforms."""
    angle = np.linalg.norm(lie.so3_log(T[:, :3, :3]), axis=1)
    return np.column_stack([100 * np.linalg.norm(T[:, :3, 3], axis=1), np.degrees(angle)])


def _mean(rows: Float[np.ndarray, "n 2"]) -> list[float]:
    return [float(x) for x in rows.mean(axis=0)] if len(rows) else [float("nan")] * 2


def _middle(values: Float[np.ndarray, " n"]) -> list[float]:
    return [float(values.mean()), float(np.median(values))] if len(values) else [float("nan")] * 2


def _spread(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "2"]:
    """RMS deviation (cm, deg) from the Karcher mean; positions and rotations each for themselves."""
    if not len(T):
        return np.full(2, np.nan)
    centre = T[0].copy()
    centre[:3, 3] = T[:, :3, 3].mean(axis=0)
    for _ in range(50):
        step = lie.so3_log(centre[:3, :3].T @ T[:, :3, :3]).mean(axis=0)
        centre[:3, :3] = centre[:3, :3] @ lie.so3_exp(step)
        if np.abs(step).max() < 1e-12:
            break
    away = np.tile(np.eye(4), (len(T), 1, 1))
    away[:, :3, :3] = centre[:3, :3].T @ T[:, :3, :3]
    away[:, :3, 3] = T[:, :3, 3] - centre[:3, 3]
    return np.sqrt(np.mean(_size(away) ** 2, axis=0))


def _motion(paths: Sequence[_Path], robot: Platform) -> list[float]:
    """Greatest speeds and accelerations, and the share of steps within the robot's limits."""
    tool, speed, change, within = [0.0], [0.0], [0.0], []
    for path in paths:
        dt, motion = np.diff(path.times_s), base_motion(robot, path.base, path.torso)
        tool.append(np.linalg.norm(np.diff(path.tool[:, :3, 3], axis=0) / dt[:, None], axis=1).max())
        v = motion.steps[:, :2] / dt[:, None]
        speed.append(np.linalg.norm(v, axis=1).max())
        a = np.diff(v, axis=0) / (0.5 * (dt[:-1] + dt[1:]))[:, None]
        change.append(np.linalg.norm(a, axis=1).max())
        within.append(_within(motion, dt))
    return [float(max(tool)), float(max(speed)), float(max(change)), 100 * float(np.concatenate(within).mean())]


def _within(motion: Motion, dt: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Steps within all limits: their velocity, and the acceleration that leads to it."""
    speed, acceleration = motion.shares(dt)
    return (speed <= 1) & np.append(True, acceleration <= 1)


def _arm(paths: Sequence[_Path], robot: Platform) -> list[float]:
    """Shares of samples at which the arm is clear of scene and of part, greatest share of a joint's velocity limit, and
    the share of steps within all limits of joints.
    """
    fastest, within, clear = [0.0], [], []
    for path in paths:
        if path.joints is None:
            return [_NAN] * 4
        clear.append(np.column_stack([path.joints.scene_clear, path.joints.part_clear])[path.joints.exact])
        dt, motion = np.diff(path.times_s), arm_motion(robot, path.joints)
        fastest.append(motion.shares(dt)[0].max(initial=0.0))
        within.append(_within(motion, dt) & path.joints.linked)
    every = np.concatenate(clear)
    free = 100 * every.mean(axis=0) if len(every) else np.full(2, np.nan)
    return [*free.tolist(), 100 * float(max(fastest)), 100 * float(np.concatenate(within).mean())]


def table(results: Mapping[str, Mapping[str, Metrics]]) -> str:
    """Before and after, per task, as text (Markdown)."""
    heads = [f"{task}: {when}" for task, pair in results.items() for when in pair]
    lines = ["| | " + " | ".join(heads) + " |", "|---" + "|---:" * len(heads) + "|"]
    for name, words in {**ROWS, **MORE}.items():
        values = [getattr(m, name) for pair in results.values() for m in pair.values()]
        lines.append(f"| {words} | " + " | ".join(_digits(v) for v in values) + " |")
    return "\n".join(lines)


def _digits(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.4f}" if value < 0.01 else f"{value:.2f}" if value < 99.995 else f"{value:.0f}"


def as_numbers(metrics: Metrics) -> dict[str, float | None]:
    """For JSON: NaN becomes null."""
    values = {f.name: getattr(metrics, f.name) for f in fields(metrics)}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
