"""Skills for the tests of execution: the four tasks done by a geometric script, with exact truth of the furniture.

They are demonstrations of how, not of where: nothing in them is feasible for the robot except by luck.

As a program (`python execution_scenes.py OUT N`), it runs N trials with a drawer: for tests that kill it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from understudy import lie
from understudy.actions import ActionModel, RobotMotion, learn
from understudy.demonstration.demonstration import Segments
from understudy.stage.furniture import Furniture, sample_furniture

RATE_HZ = 10.0
FOLLOW = {"drawer": 0.9, "swivel_door": 0.7, "sliding_door": 1.0, "room_door": 0.9}
"""share of the handle's way that the base goes along"""
FIRST = np.array([-1.5, 0.25, 0.0])  # base at the start, the handle over the origin
STAND = np.array([-0.72, 0.22, 0.0])  # at the grasp
START_TOOL = np.array([0.45, -0.25, 0.9])
FRONTAL = np.column_stack([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])


def min_jerk(u: np.ndarray) -> np.ndarray:
    return u**3 * (10 - 15 * u + 6 * u**2)


def scripted_motion(furniture: Furniture, rng: np.random.Generator, seconds: tuple = (5.0, 5.0, 2.5)) -> RobotMotion:
    """Walks up, takes the handle from the front, opens the part to `open_to`, lets go, backs off."""
    n = [round(s * RATE_HZ) for s in seconds]
    reach, opening, back = (min_jerk(np.linspace(0, 1, k + 1)) for k in n)
    share = np.concatenate([0 * reach[:-1], opening[:-1], 1 + 0 * back])
    T_object = furniture.articulation.pose(share * furniture.open_to)
    near = np.concatenate([reach[:-1], 1 + 0 * opening[:-1], 1 - back])
    away = np.tile(np.eye(4), (len(share), 1, 1))
    away[:, :3, :3] = FRONTAL
    away[:, 0, 3] = 0.14 * (1 - near)  # out of the front
    T_tool = T_object @ away
    far = np.clip(1 - 1.6 * np.concatenate([reach[:-1], 0 * near[n[0] :] + 1]), 0, 1)
    start = np.array([*FIRST[:2], 0.0]) + START_TOOL + 0.03 * rng.normal(size=3)
    T_tool[:, :3, 3] += far[:, None] * (start - T_tool[0, :3, 3])
    base = FIRST + np.concatenate([reach[:-1], 1 + 0 * near[n[0] :]])[:, None] * (STAND - FIRST)
    way = T_object[:, :2, 3] - T_object[0, :2, 3]
    base[:, :2] += FOLLOW[furniture.task] * way + 0.03 * rng.normal(size=2)
    return RobotMotion(
        np.arange(len(share)) / RATE_HZ,
        T_tool,
        base,
        np.full(len(share), 0.15),
        T_object,
        furniture.articulation,
        furniture.handle,
        Segments(n[0], n[0] + n[1]),
    )


def scripted_skill(task: str, demonstrations: int = 3, first_seed: int = 0) -> ActionModel:
    """Learnt from furniture of the seeds first_seed, first_seed + 1, ..."""
    motions = [
        scripted_motion(sample_furniture(task, seed), np.random.default_rng(seed))
        for seed in range(first_seed, first_seed + demonstrations)
    ]
    return learn(motions)


def world_pose(base: np.ndarray) -> np.ndarray:
    return lie.se2_to_se3(base[None])[0]


def drawer_trials(out: Path, n: int) -> list[dict[str, Any]]:
    """n layouts with a drawer, in a folder."""
    from understudy.actions import Skill
    from understudy.adaptation.robots import platform_of
    from understudy.execution import trials

    robot, skill = trials.trial_robot("pr2"), Skill(scripted_skill("drawer"), "drawer", "pr2")
    return trials.run_trials(skill, robot, platform_of(robot), trials.setups("drawer", n, 2), out)


if __name__ == "__main__":
    drawer_trials(Path(sys.argv[1]), int(sys.argv[2]))
