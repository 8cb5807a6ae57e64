"""What the acting hand does: how it takes hold of a handle, and its way there and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from understudy.geometry import rigid
from understudy.objects.articulation import Handle
from understudy.stage.body import Skeleton
from understudy.stage.kinematics import X, Y, Z, about, apply
from understudy.stage.kinematics_body import Trunk
from understudy.stage.motion_profiles import Clock, ramp

_BAR_ABOVE_PALM: Final = 0.022  # metres between the bones of the palm and a held bar's surface
_BACK_OFF: Final = np.array([-0.03, 0.0, -0.075])  # metres, hand frame: where it is before it closes
_OPEN: Final = 0.22
_RELAXED: Final = 0.30
_SHARES: Final = np.array([0.75, 1.15, 0.6])  # of the bend, per joint of a finger
_THUMB: Final = np.array([0.5, 0.45, 0.5])


@dataclass(frozen=True, eq=False)
class Grip:
    """How a hand holds a handle."""

    T_handle_hand: Float[np.ndarray, "4 4"]
    bend: float
    """of the fingers around the bar, radians (the middle joints' about as much)"""


def draw_grip(
    rng: np.random.Generator, handle: Handle, height: float, level: bool, acting: str, skeleton: Skeleton
) -> Grip:
    """Fingers across the bar: around an upright bar with the thumb up, over the top of a level one.

    height: of the handle above the floor. The lower it is, the more the forearm and with it the fingers point down.
    """
    slope = float(np.clip(np.arctan2(0.63 * skeleton.stature_m - height, 0.26), -0.5, 1.0))
    turn = np.radians(rng.uniform(25, 40)) - max(slope, 0.0) if level else np.radians(rng.uniform(35, 55))
    thumb = -Z if level or acting == "right" else Z  # the hand's y axis
    aside = -Y if level or acting == "right" else Y  # where the palm would face if it did not turn to the front
    palm = np.cos(turn) * aside - np.sin(turn) * X
    R = np.column_stack([np.cross(thumb, palm), thumb, palm])
    tilt = rng.normal(0, 0.08) + (0.0 if level else float(np.clip(0.5 * slope, -0.15, 0.40)))  # fingers down
    R = R @ about(Z, np.asarray(tilt if acting == "right" else -tilt))
    knuckle = float(np.linalg.norm(skeleton.head("finger3-1", acting) - skeleton.head("wrist", acting))) / 2
    bar = np.array([knuckle - 0.005, 0.0, _BAR_ABOVE_PALM + handle.radius_m]) + rng.normal(0, 0.003, 3)
    along = rng.uniform(-0.5, 0.5) * max(0.0, handle.length_m - 0.09)
    return Grip(rigid(R, along * Z - R @ bar), float(np.clip(1.15 - 12 * handle.radius_m, 0.5, 1.1)))


def hanging(
    skeleton: Skeleton, side: str, trunk: Trunk, shoulder: Float[np.ndarray, "t 3"], swing: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t 4 4"]:
    """T_world_hand of an arm that hangs. swing: metres forwards."""
    sign = 1.0 if side == "left" else -1.0
    arm = skeleton.length("upperarm01", "lowerarm01", side) + skeleton.length("lowerarm01", "wrist", side)
    forwards = np.clip(0.02 + swing, -0.35, 0.4)
    down = np.sqrt(np.maximum((0.955 * arm) ** 2 - forwards**2 - 0.075**2, 0.01))
    heading = about(Z, trunk.yaw + trunk.twist)
    wrist = shoulder + apply(heading, np.column_stack([forwards, np.full_like(down, 0.075 * sign), -down]))
    fingers = np.column_stack([0.15 + 0.9 * forwards, np.full_like(down, -0.03 * sign), -np.ones_like(down)])
    fingers /= np.linalg.norm(fingers, axis=1, keepdims=True)
    palm = np.array([-0.25, -sign, 0.0]) / np.hypot(1, 0.25)
    palm = palm - fingers * (fingers @ palm)[:, None]
    palm /= np.linalg.norm(palm, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(down), 1, 1))
    T[:, :3, :3] = heading @ np.stack([fingers, np.cross(palm, fingers), palm], -1)
    half = float(np.linalg.norm(skeleton.T_body_hand[side][:3, 3] - skeleton.head("wrist", side)))
    T[:, :3, 3] = wrist + half * T[:, :3, 0]
    return T


def nearness(clock: Clock, times: Float[np.ndarray, " t"]) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """How far the hand is on its way to the handle, and from just before the handle onto it; both 0 to 1."""
    way = ramp(times, clock.reach, clock.grasp - 0.12) - ramp(times, clock.release + 0.12, clock.release + 1.0)
    onto = ramp(times, clock.grasp - 0.40, clock.grasp - 0.04) - ramp(times, clock.release, clock.release + 0.35)
    return way, onto


def acting_hand(
    clock: Clock,
    times: Float[np.ndarray, " t"],
    rest: Float[np.ndarray, "t 4 4"],
    grasp: Float[np.ndarray, "t 4 4"],
) -> Float[np.ndarray, "t 4 4"]:
    """From hanging to the handle and back. grasp: T_world_hand of a hand that holds the handle, at these times."""
    way, onto = nearness(clock, times)
    back = apply(grasp[:, :3, :3], (1 - onto)[:, None] * _BACK_OFF)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, 3] = rest[:, :3, 3] + way[:, None] * (grasp[:, :3, 3] + back - rest[:, :3, 3])
    for i, share in enumerate(way):
        ends = Rotation.from_matrix(np.stack([rest[i, :3, :3], grasp[i, :3, :3]]))
        T[i, :3, :3] = Slerp([0.0, 1.0], ends)([share]).as_matrix()[0]
    held = (times >= clock.grasp) & (times <= clock.release)
    T[held] = grasp[held]
    return T


def finger_flex(clock: Clock, times: Float[np.ndarray, " t"], grip: Grip, acting: bool) -> Float[np.ndarray, "t 5 3"]:
    """Radians of all joints, thumb first: relaxed, opened on the way, closed around the bar."""
    bend = np.full(len(times), _RELAXED)
    if acting:
        opened = ramp(times, clock.reach + 0.2, clock.reach + 0.6) - ramp(times, clock.release + 0.5, clock.rest)
        closed = ramp(times, clock.grasp - 0.22, clock.grasp) - ramp(times, clock.release, clock.release + 0.2)
        bend = _RELAXED + opened * (_OPEN - _RELAXED) + closed * (grip.bend - _OPEN)
    out = bend[:, None, None] * _SHARES * np.linspace(0.92, 1.1, 5)[None, :, None] - 0.05
    out[:, 0] = (0.15 + bend[:, None]) * _THUMB
    return out
