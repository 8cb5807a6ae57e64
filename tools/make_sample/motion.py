"""What the two people do, as a pose for every frame."""

from __future__ import annotations

import numpy as np
from bodies import Body
from layout import FPS, SOLE, Array
from rig import Arm, Foot, Pose, rot_z, unit

A_YAW = np.radians(47.0)
B_YAW = np.radians(11.0)
HANDLE = np.array([1.165, 2.00, 1.03])  # closed drawer's handle, the middle of the bar
B_PLACE = (-0.79, 3.42)


def ease(t: float, start: float, end: float) -> float:
    """Minimum-jerk ramp from 0 at `start` to 1 at `end`."""
    s = float(np.clip((t - start) / (end - start), 0.0, 1.0))
    return s**3 * (10 - 15 * s + 6 * s * s)


def drawer_pull(t: float) -> float:
    """How far the drawer is open at time t."""
    return 0.15 * ease(t, 0.68, 1.35)


def hip_height(body: Body) -> float:
    """Height of the hips of the straight-legged standing body, in shoes."""
    return float(body.head_of("upperleg01.L")[2]) + SOLE


def hanging(side: str, swing: float = 0.0, bend: float = 0.06, out: float = 0.075) -> Arm:
    """A relaxed arm at the side; `swing` is forward in metres at the wrist."""
    s = 1.0 if side == "L" else -1.0
    return Arm(
        wrist=np.array([s * out, -0.05 - swing, -0.60 + bend]),
        elbow=np.array([0.45 * s, 1.0, 0.0]),
        fingers=np.array([0.02 * s, -0.18 - 0.4 * swing, -1.0]),
        palm=np.array([-s, 0.22, 0.0]),
        curl=0.30,
    )


def pose_a(body: Body, t: float) -> Pose:
    """A steps up to the drawer unit, takes the handle of the top drawer and begins to pull."""
    ahead = rot_z(A_YAW) @ np.array([0.0, -1.0, 0.0])
    left = rot_z(A_YAW) @ np.array([1.0, 0.0, 0.0])
    end = HANDLE[:2] - 0.54 * ahead[:2] + 0.17 * left[:2]  # where the pelvis stops
    go = ease(t, -0.55, 0.75)
    back = 0.04 * ease(t, 0.75, 1.5)
    pelvis = end - ahead[:2] * (0.36 * (1 - go) + back)
    step = ease(t, -0.12, 0.55)
    swing = np.sin(np.pi * step)
    left_xy = end + left[:2] * 0.085 + ahead[:2] * (-0.44 + 0.54 * step)
    right_xy = end - left[:2] * 0.095 - ahead[:2] * 0.19
    heel = np.radians(30) * (1 - ease(t, -0.05, 0.3)) - np.radians(9) * np.sin(np.pi * ease(t, 0.2, 0.62))
    height = hip_height(body) - 0.014 - 0.012 * go
    feet = {
        "L": Foot((left_xy[0], left_xy[1]), A_YAW + 0.05, 0.055 * swing, heel),
        "R": Foot((right_xy[0], right_xy[1]), A_YAW - 0.12, 0.0, np.radians(7) * ease(t, 0.25, 0.8)),
    }

    reach = ease(t, -0.10, 0.70)
    grip = HANDLE + np.array([-drawer_pull(t), 0.0, 0.0])
    into = unit(np.array([0.90, -0.38, -0.22]))
    goal = grip - into * 0.114 + np.array([0.0, 0.0, 0.035])
    # starting point of the hand: hanging, a bit behind the thigh, as the arm swings in a step
    first = np.array([*(end - ahead[:2] * 0.22 - left[:2] * 0.245), height - 0.055])
    arch = np.array([0.0, 0.0, 0.06]) - 0.02 * np.array([*left[:2], 0.0])
    wrist = first + (goal - first) * reach + arch * np.sin(np.pi * reach)
    down = np.array([0.25, -0.15, -1.0])
    right = Arm(
        wrist=wrist,
        elbow=np.array([-0.35, -0.35, -0.55]) - 0.5 * (1 - reach) * ahead,
        fingers=unit(down * (1 - reach) + into * reach),
        palm=unit(np.array([*left[:2], 0.0]) * (1 - reach) + np.array([0.10, 0.25, -1.0]) * reach),
        local=False,
        curl=0.28 - 0.10 * np.sin(np.pi * reach) + 0.30 * ease(t, 0.42, 0.62),
        hand_pull=reach,
    )
    other = hanging("L", swing=0.10 * (1 - step) - 0.04, bend=0.07, out=0.07)
    return Pose(
        pelvis=np.array([*pelvis, height]),
        yaw=A_YAW + 0.06 * (1 - step),
        feet=feet,
        arms={"L": other, "R": right},
        tilt=0.05,
        roll=0.02 * swing,
        spine=(0.06 + 0.08 * reach, 0.0, 0.03 * reach),
        head=(0.09 * reach + 0.02, 0.0, -0.27),
    )


def pose_b(body: Body, t: float) -> Pose:
    """B stands behind the desk, shifts a little weight and moves one hand as if talking."""
    sway = np.sin(2 * np.pi * 0.45 * t + 0.4)
    turn = rot_z(B_YAW)
    side: Array = turn @ np.array([1.0, 0.0, 0.0])
    place = np.array(B_PLACE)
    mid = place + side[:2] * (0.022 + 0.014 * sway)
    feet = {}
    for s, lab in ((1.0, "L"), (-1.0, "R")):
        xy = place + (turn @ np.array([0.105 * s, -0.02 * s, 0.0]))[:2]
        feet[lab] = Foot((xy[0], xy[1]), B_YAW + 0.10 * s)
    talk = np.sin(2 * np.pi * 0.8 * t)
    left = Arm(
        wrist=np.array([-0.02 - 0.02 * talk, -0.27 - 0.015 * talk, -0.245 + 0.035 * talk]),
        elbow=np.array([0.55, 0.75, -0.5]),
        fingers=np.array([-0.42, -0.88, 0.22 + 0.1 * talk]),
        palm=np.array([-0.75, 0.30, 0.55]),
        curl=0.22,
    )
    right = hanging("R", swing=0.02 * sway, bend=0.075, out=0.085)
    right.wrist = right.wrist * np.array([1.0, 1.0, 0.92])
    return Pose(
        pelvis=np.array([*mid, hip_height(body) - 0.012]),
        yaw=B_YAW,
        feet=feet,
        arms={"L": left, "R": right},
        tilt=0.02,
        roll=0.025 + 0.01 * sway,
        spine=(0.03, -0.04 - 0.012 * sway, 0.03 * sway),
        head=(0.04 + 0.02 * talk, 0.02 * sway, 0.05 * sway + 0.04),
        knee_out={"L": 0.15, "R": 0.1},
    )


def time_of(index: int) -> float:
    """Time of a frame."""
    return index / FPS
