"""What the mixtures are over: gripper, base and torso relative to the object, as ten numbers.

The carrier is the handle's frame: at rest while the robot reaches, moving along the articulation while it manipulates,
where it was left while the robot releases. The gripper is taken in the carrier itself, the base in the carrier's floor
frame: its origin below the handle, wherever that is by now, its x along the floor projection of the handle's x at rest.
The torso's height is taken above the handle's.

So the way from the base to the handle, which decides how the arm is bent, is what is learnt. The base's axes do not
turn with a door: a base that stands still, or goes along with the handle, then moves along a simple curve. (In axes
that turn with the door it sweeps a large arc, which few Gaussians follow badly.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.actions.rotations import karcher_mean, nearest_vector, right_jacobian, to_tangent
from understudy.errors import UnderstudyError

FEATURES: Final = (
    "gripper x",
    "gripper y",
    "gripper z",
    "gripper rx",
    "gripper ry",
    "gripper rz",
    "base x",
    "base y",
    "base yaw",
    "torso",
)
"""Metres and radians; rotations: tangent vector at the mean, along the tool's axes at the mean."""
POSITION, ROTATION, BASE, YAW, TORSO = slice(0, 3), slice(3, 6), slice(6, 9), 8, 9
N: Final = len(FEATURES)

_STEEPEST: Final = 0.26  # horizontal part of the handle's x, at least: it leans by 75 degrees at most


def floor_frame(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3"]:
    """x, y and yaw of handle frames seen from above. Raises UnderstudyError where x points up or down."""
    if not (np.hypot(T[:, 0, 0], T[:, 1, 0]) > _STEEPEST).all():
        raise UnderstudyError("the handle's x axis must lead out of an upright front, but it points up or down")
    yaw = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return np.column_stack([T[:, :2, 3], yaw])


@dataclass(frozen=True, eq=False)
class Carrier:
    """The frames, at n moments, in which gripper and base are learnt. World."""

    T: Float[np.ndarray, "n 4 4"]
    """the handle's"""
    floor: Float[np.ndarray, "n 3"]
    """x, y, yaw: below the handle, turned as it is at rest"""


@dataclass(frozen=True, eq=False)
class Relative:
    """n poses of a robot relative to the carrier."""

    T_carrier_tool: Float[np.ndarray, "n 4 4"]
    base: Float[np.ndarray, "n 3"]
    """x, y, yaw in the carrier's floor frame"""
    torso: Float[np.ndarray, " n"]
    """height of the torso's lift minus height of the handle, metres"""

    @classmethod
    def of(
        cls,
        carrier: Carrier,
        T_world_tool: Float[np.ndarray, "n 4 4"],
        xy_yaw: Float[np.ndarray, "n 3"],
        torso_height: Float[np.ndarray, " n"],
    ) -> Relative:
        """From poses in the world."""
        T = lie.se3_inverse(carrier.T) @ T_world_tool
        base = lie.se2_compose(lie.se2_inverse(carrier.floor), xy_yaw)
        return cls(T, base, torso_height - carrier.T[:, 2, 3])

    def world(
        self, carrier: Carrier
    ) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """The inverse of `of`: tool poses, base poses (yaw unwrapped) and torso heights."""
        base = lie.se2_compose(carrier.floor, self.base)
        base[:, 2] = np.unwrap(base[:, 2])
        return carrier.T @ self.T_carrier_tool, base, self.torso + carrier.T[:, 2, 3]

    def mirrored(self, mirror: Mirror) -> Relative:
        """Seen in a mirror."""
        T, base = self.T_carrier_tool.copy(), self.base * (1, -1, -1)
        T[:, :3, :3] = mirror.handle[:, None] * T[:, :3, :3] * mirror.tool
        T[:, :3, 3] *= mirror.handle
        return Relative(T, base, self.torso)


@dataclass(frozen=True, eq=False)
class Mirror:
    """Swaps left and right: the upright plane through the handle's x.

    A mirrored rotation is none (its determinant is -1). A gripper looks the same in a mirror of its own; followed by
    that, it is a rotation again: R' = diag(handle) R diag(tool).
    """

    handle: Float[np.ndarray, "3"]
    """signs of the handle's axes: y is turned round where z is upright, z where the bar is level and y is upright"""
    tool: Float[np.ndarray, "3"]
    """signs of the tool's axes: of one of the gripper's planes of symmetry"""

    @property
    def map(self) -> Float[np.ndarray, "10 10"]:
        """What a mirror does to features: tangent vectors w become -diag(tool) w, as it turns them round as well."""
        return np.diag([*self.handle, *-self.tool, 1, -1, -1, 1])


def sideways_mirror(up: Float[np.ndarray, "3"], R_handle_tool: Float[np.ndarray, "3 3"], planes: str) -> Mirror:
    """The mirror for a handle and a grasp.

    up: the world's z in the handle's frame. planes: axes of the tool (of 'xyz') to which the gripper's planes of
    symmetry are normal; the one that turns the grasp least is taken.
    """
    handle = np.where(np.arange(3) == (1 if abs(up[2]) >= abs(up[1]) else 2), -1.0, 1.0)
    tools = [np.where(np.arange(3) == "xyz".index(axis), -1.0, 1.0) for axis in planes]
    alike = [np.sum(R_handle_tool * (handle[:, None] * R_handle_tool * tool)) for tool in tools]  # trace: cosine
    return Mirror(handle, tools[int(np.argmax(alike))])


@dataclass(frozen=True, eq=False)
class Chart:
    """From relative poses to features and back: the point at which rotations are flattened."""

    R_mean: Float[np.ndarray, "3 3"]
    """Karcher mean of the tool's rotations in the carrier"""
    yaw_mean: float
    """of the base in the carrier's floor frame"""

    @classmethod
    def at_mean(cls, poses: list[Relative]) -> Chart:
        """The chart for several paths."""
        R = np.concatenate([p.T_carrier_tool[:, :3, :3] for p in poses])
        yaw = np.concatenate([p.base[:, 2] for p in poses])
        return cls(karcher_mean(R), float(np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())))

    def features(self, poses: Relative) -> Float[np.ndarray, "n 10"]:
        """Of a path: continuous where it is."""
        y = np.empty((len(poses.base), N))
        y[:, POSITION] = poses.T_carrier_tool[:, :3, 3]
        y[:, ROTATION] = to_tangent(self.R_mean, poses.T_carrier_tool[:, :3, :3])
        y[:, BASE] = poses.base
        yaw = np.unwrap(poses.base[:, 2] - self.yaw_mean)
        least = yaw[np.abs(lie.wrapped(yaw)).argmin()]
        y[:, YAW] = yaw - 2 * np.pi * np.round(least / (2 * np.pi))
        y[:, TORSO] = poses.torso
        return y

    def features_near(self, pose: Relative, near: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
        """Of one pose, with the turns (full ones more or less) that bring it nearest to other features."""
        y = self.features(pose)[0]
        y[ROTATION] = nearest_vector(y[ROTATION], near[ROTATION])
        y[YAW] += 2 * np.pi * np.round((near[YAW] - y[YAW]) / (2 * np.pi))
        return y

    def poses(self, y: Float[np.ndarray, "n 10"]) -> Relative:
        """The inverse of `features`."""
        T = np.zeros((len(y), 4, 4))
        T[:, :3, :3] = self.R_mean @ lie.so3_exp(y[:, ROTATION])
        T[:, :3, 3] = y[:, POSITION]
        T[:, 3, 3] = 1
        return Relative(T, y[:, BASE] + (0, 0, self.yaw_mean), y[:, TORSO])

    def jacobian(self, y: Float[np.ndarray, "n 10"], carrier: Carrier) -> Float[np.ndarray, "n 10 10"]:
        """Derivative of (dp, dr, dx, dy, dyaw, dheight) in the world by the features.

        dp and dr as in `trajectories.PoseTrack`: p_true = p + dp, R_true = Exp(dr) R, along the world's axes.
        A covariance S of the features becomes J S J'.
        """
        J = np.zeros((len(y), N, N))
        R_world_carrier = carrier.T[:, :3, :3]
        J[:, POSITION, POSITION] = R_world_carrier
        R_world_tool = R_world_carrier @ self.R_mean @ lie.so3_exp(y[:, ROTATION])
        J[:, ROTATION, ROTATION] = R_world_tool @ right_jacobian(y[:, ROTATION])
        J[:, BASE, BASE] = lie.se2_to_se3(carrier.floor)[:, :3, :3]
        J[:, TORSO, TORSO] = 1
        return J

    def mirrored(self, mirror: Mirror) -> Chart:
        """The chart of mirrored poses."""
        return Chart(mirror.handle[:, None] * self.R_mean * mirror.tool, -self.yaw_mean)
