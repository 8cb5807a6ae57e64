"""The baseline: the teacher's hand and torso, imitated. Nothing is adapted, when learning or when executing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions import ActionModel, RobotPose
from understudy.adaptation import prepare
from understudy.adaptation.platform import Platform
from understudy.adaptation.result import AdaptationResult, Adapted
from understudy.demonstration.demonstration import Demonstration
from understudy.errors import UnderstudyError
from understudy.execution.outcome import Reason, Stopped
from understudy.execution.planning import RATE_HZ, Plan, scaled
from understudy.execution.surroundings import Observed
from understudy.geometry import inverse
from understudy.robot.ik_path import solve_ik_path
from understudy.robot.model import Robot


def unadapted(
    demonstrations: Sequence[Demonstration], result: AdaptationResult, platform: Platform
) -> AdaptationResult:
    """The result as it would be without adaptation: gripper H X, base P Y, torso in the middle (gaps bridged).

    demonstrations: those that `result` came from. Only its two calibrations X and Y are kept.
    """
    return replace(
        result,
        demonstrations=tuple(
            _followed(d, a, result, platform) for d, a in zip(demonstrations, result.demonstrations, strict=True)
        ),
    )


def _followed(d: Demonstration, adapted: Adapted, result: AdaptationResult, platform: Platform) -> Adapted:
    tool, base = prepare.as_shown(d, result.calibration, adapted.grasp)
    return replace(
        adapted,
        times_s=d.times_s,
        T_world_tool=tool,
        base=base,
        torso=np.full(len(d), platform.torso_rest),
        joints=None,
    )


def imitation_plan(
    model: ActionModel,
    robot: Robot,
    platform: Platform,
    observed: Observed,
    start: RobotPose,
    q_start: Float[np.ndarray, " j"],
    q_goal: float | None = None,
) -> Plan:
    """The skill's motion as it is, for `Execution(planner=...)`: base and gripper where the model has them.

    Where the arm cannot reach, it stays where it was. Raises Stopped(NO_PLAN) when it can reach nothing.
    """
    began = time.process_time()
    try:
        motion = model.reproduce(observed.T_world_object, observed.articulation, q_goal, RATE_HZ, start)
    except UnderstudyError as e:
        raise Stopped(Reason.NO_PLAN, str(e)) from e
    torso = np.clip(motion.torso_height, *robot.torso_limits)
    T_base_tool = lie.se3_inverse(lie.se2_to_se3(motion.xy_yaw)) @ motion.T_world_tool
    path = solve_ik_path(robot, T_base_tool, torso, motion.times_s)
    if not path.success.any():
        raise Stopped(Reason.NO_PLAN, "the arm reaches none of the gripper's poses")
    grasp, release = (int(min(k, len(motion) - 1)) for k in (motion.segments.grasp, motion.segments.release))
    timed, at = scaled(
        robot, motion.times_s, motion.xy_yaw, path, q_start, motion.q, (max(grasp - 1, 1), grasp, release)
    )
    T_grasp = inverse(motion.T_world_object[grasp]) @ motion.T_world_tool[grasp]
    spent = time.process_time() - began
    return Plan(timed, *at, T_grasp, 0.0, observed.articulation, float(motion.q[-1]), spent)
