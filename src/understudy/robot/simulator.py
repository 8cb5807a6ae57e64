"""A robot before a piece of furniture, in physics: contact, friction, servos with limits (docs/execution.md).

The world's frame is the furniture's (`stage.furniture`): front in the plane x = 0, the robot at x < 0. The robot knows
where its base is; errors of localisation are part of what it measures of the handle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from understudy import lie
from understudy.errors import UnderstudyError
from understudy.geometry import rigid
from understudy.robot.model import Robot
from understudy.robot.simulator_contacts import Contacts, Touch
from understudy.robot.simulator_model import STEP_S, TOOL, Drives, build, metres_per_value
from understudy.robot.simulator_video import Video
from understudy.robot.urdf import BASE_JOINTS
from understudy.stage.furniture import Furniture
from understudy.stage.mechanism import PART, pose_of

_LOOK_S: Final = 0.01  # between looks at the contacts


@dataclass(frozen=True)
class Noise:
    """Of measurements of the handle. Root mean squares of the error's length: metres, degrees."""

    localisation: tuple[float, float] = (0.02, 2.0)
    """from afar: constant over a trial"""
    jitter: tuple[float, float] = (0.003, 0.3)
    """from afar, besides: new with every measurement"""
    near: tuple[float, float] = (0.005, 1.0)
    """from within arm's reach (a camera on the forearm, the hand's own kinematics): new with every measurement"""


@dataclass(frozen=True, eq=False)
class Targets:
    """Set points of the servos, and their rates, which are fed forward."""

    base: Float[np.ndarray, "3"]
    """x, y (metres), yaw (radians), world"""
    q: Float[np.ndarray, " j"]
    torso: float
    """metres"""
    opening_m: float
    """between the pads"""
    base_velocity: Float[np.ndarray, "3"] | None = None
    q_velocity: Float[np.ndarray, " j"] | None = None
    torso_velocity: float = 0.0


@dataclass(frozen=True, eq=False)
class RobotState:
    """What the robot's encoders say."""

    time_s: float
    base: Float[np.ndarray, "3"]
    base_velocity: Float[np.ndarray, "3"]
    q: Float[np.ndarray, " j"]
    q_velocity: Float[np.ndarray, " j"]
    torso: float
    opening_m: float
    T_world_tool: Float[np.ndarray, "4 4"]


class Simulator:
    """One trial's world. `step` moves it; nothing else does."""

    def __init__(
        self,
        robot: Robot,
        furniture: Furniture,
        *,
        seed: int,
        base_start: Float[np.ndarray, "3"],
        render: bool = False,
        torso_start: float | None = None,
        noise: Noise | None = None,
        drives: Drives | None = None,
    ):
        """base_start: x, y (metres), yaw (radians). torso_start: metres; None: the middle. seed: of the noise.

        Raises RobotError for a robot that MuJoCo cannot load, UnderstudyError for a start that is not finite.
        """
        if base_start.shape != (3,) or not np.isfinite(base_start).all():
            raise UnderstudyError(f"base_start: must be 3 finite numbers (x, y, yaw), got {base_start}")
        self.robot, self.furniture = robot, furniture
        self.model = build(robot, furniture, drives or Drives(), visual=render)
        self.data = mujoco.MjData(self.model)
        self.contacts = Contacts(self.model)
        self.video: Video | None = Video(self.model, furniture) if render else None
        self._rng = np.random.default_rng([seed, 20817])
        self._noise = noise or Noise()
        self._T_error = self._disturbance(*self._noise.localisation)
        self._index()
        d = robot.description
        torso = float(np.mean(robot.torso_limits)) if torso_start is None else torso_start
        self._place(np.asarray(base_start, float), d.posture, torso, 0.0)

    def _index(self) -> None:
        d = self.robot.description
        torso = [d.torso_joint] if d.torso_joint else []
        joints = [*BASE_JOINTS, *torso, *d.arm_joints, d.gripper.joints[0]]
        self._qpos = np.array([self.model.joint(name).qposadr[0] for name in joints])
        self._dof = np.array([self.model.joint(name).dofadr[0] for name in joints])
        self._servos = np.array([self.model.actuator(name).id for name in joints])
        self._lag = self.model.actuator_biasprm[self._servos, 2] / self.model.actuator_biasprm[self._servos, 1]
        self._lifts = len(torso)
        self._fingers = np.array([self.model.joint(name).qposadr[0] for name in d.gripper.joints])
        self._part = int(self.model.joint(PART).qposadr[0])

    def _place(self, base: np.ndarray, q: np.ndarray, torso: float, opening: float) -> None:
        gripper = self.robot.description.gripper
        value = self._gripper_value(opening)
        self.data.qpos[self._qpos] = np.concatenate([base, [torso] * self._lifts, q, [value]])
        self.data.qpos[self._fingers] = value * np.array(gripper.multipliers) / gripper.multipliers[0]
        self.data.ctrl[self._servos] = self.data.qpos[self._qpos]
        mujoco.mj_forward(self.model, self.data)

    def _gripper_value(self, opening_m: float) -> float:
        """Unlike Gripper.joint_value, may be beyond the limits: a set point that presses."""
        gripper = self.robot.description.gripper
        return gripper.closed + opening_m / metres_per_value(gripper)

    def step(self, targets: Targets, seconds: float) -> Touch:
        """Runs the world with these set points. Returns what was touched meanwhile."""
        n, j = round(seconds / STEP_S), self.robot.n
        x = np.concatenate(
            [targets.base, [targets.torso] * self._lifts, targets.q, [self._gripper_value(targets.opening_m)]]
        )
        v = np.zeros(len(x))
        v[:3] = 0 if targets.base_velocity is None else targets.base_velocity
        v[3 : 3 + self._lifts] = targets.torso_velocity
        v[-1 - j : -1] = 0 if targets.q_velocity is None else targets.q_velocity
        touched = Touch()
        every = round(_LOOK_S / STEP_S)
        for done in range(0, n, every):
            count = min(every, n - done)
            # the set point goes on meanwhile, and what the servo's damping holds back is made up for
            ahead = (done + 0.5 * count) * STEP_S
            self.data.ctrl[self._servos] = x + v * (ahead + self._lag)
            mujoco.mj_step(self.model, self.data, count)
            touched = touched.joined(self.contacts.now(self.data))
            if self.video is not None:
                self.video.maybe_frame(self.data)
        if not np.isfinite(self.data.qpos).all():
            raise UnderstudyError("simulation: it diverged (positions are not finite)")
        return touched

    def state(self) -> RobotState:
        """Joints as the encoders have them."""
        x, v, j = self.data.qpos[self._qpos], self.data.qvel[self._dof], self.robot.n
        gripper = self.robot.description.gripper
        site = self.data.site(TOOL)
        return RobotState(
            time_s=float(self.data.time),
            base=x[:3].copy(),
            base_velocity=v[:3].copy(),
            q=x[-1 - j : -1].copy(),
            q_velocity=v[-1 - j : -1].copy(),
            torso=float(x[3]) if self._lifts else 0.0,
            opening_m=float((x[-1] - gripper.closed) * metres_per_value(gripper)),
            T_world_tool=rigid(site.xmat.reshape(3, 3).copy(), site.xpos.copy()),
        )

    @property
    def opened(self) -> float:
        """True position of the part: radians or metres."""
        return float(self.data.qpos[self._part])

    @property
    def T_world_handle(self) -> Float[np.ndarray, "4 4"]:
        """True pose of the handle."""
        return pose_of(self.data, PART)

    def measured_handle_pose(self, near: bool = False) -> Float[np.ndarray, "4 4"]:
        """T_world_object with the noise of `Noise`. near: as the hand sees it from close by."""
        R = self.T_world_handle
        if near:
            return R @ self._disturbance(*self._noise.near)
        return R @ self._T_error @ self._disturbance(*self._noise.jitter)

    def _disturbance(self, metres: float, degrees: float) -> Float[np.ndarray, "4 4"]:
        """A random small motion; both lengths are root mean squares."""
        d = self._rng.normal(size=6) / np.sqrt(3)
        return np.asarray(lie.se3_exp(np.concatenate([metres * d[:3], np.radians(degrees) * d[3:]])))

    def block(self) -> None:
        """Locks the part: for tests and for demonstrations of what happens then."""
        self.model.jnt_range[self.model.joint(PART).id] = (self.opened - 1e-4, self.opened + 1e-4)

    def set_handle_friction(self, sliding: float) -> None:
        """Of handle and pads."""
        self.contacts.set_friction(self.model, sliding)

    def frame(self) -> UInt8[np.ndarray, "h w 3"]:
        """A picture of now. Raises UnderstudyError when the simulator was made without render."""
        if self.video is None:
            raise UnderstudyError("simulator: pictures need Simulator(..., render=True)")
        return self.video.picture(self.data)

    def close(self) -> None:
        """Gives graphics memory back."""
        if self.video is not None:
            self.video.close()

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
