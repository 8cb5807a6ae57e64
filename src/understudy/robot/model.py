"""A robot: its description, its kinematics (compiled), its limits and its self-collisions (Pinocchio and Coal)."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import MissingExtraError
from understudy.robot.description import RobotDescription, RobotError, load_description
from understudy.robot.urdf import read_urdf, source_path, urdf_with_base

if TYPE_CHECKING:
    from understudy.robot.collision import SelfCollision

__all__ = ["Robot", "load_robot", "urdf_with_base"]


def load_robot(name_or_path: str | Path) -> Robot:
    """A robot by name (`description.ROBOTS`) or by the path of a description.

    Meshes are read only when collisions are asked for. Raises RobotError for a description, URDF or SRDF that cannot
    be used, MissingExtraError when the extra `robot` is not installed.
    """
    return Robot(load_description(name_or_path))


def require_pinocchio() -> Any:
    """The module pinocchio. Raises MissingExtraError."""
    try:
        import pinocchio
    except ImportError as e:
        raise MissingExtraError("robot models", "robot") from e
    return pinocchio


class Robot:
    """One arm on a lifting torso on a planar base.

    The base frame is the description's `base_link`, on the floor, x forward. `q` are the arm's joints in order,
    `torso` the lift's height in metres (0 where there is none).
    """

    def __init__(self, description: RobotDescription):
        pin = require_pinocchio()
        self.description = description
        self.urdf = read_urdf(description)
        try:
            self.model = pin.buildModelFromXML(self.urdf)
        except Exception as e:  # what Pinocchio throws is not a class of its own
            raise RobotError(f"{description.where}: urdf {description.urdf}: {e}") from e
        joints = [self._joint_id(name, "arm_joints") for name in description.arm_joints]
        torso = None if description.torso_joint is None else self._joint_id(description.torso_joint, "torso_joint")
        self._check_root()
        self._check_chain(joints, torso)
        self.fixed: Float[np.ndarray, "k 3 4"] = self._fixed_transforms(joints, torso)
        """constant transforms between the joints (see `chain`)"""
        self._read_limits(joints, torso)

    @property
    def name(self) -> str:
        """The description's."""
        return self.description.name

    @property
    def n(self) -> int:
        """Number of arm joints."""
        return len(self.description.arm_joints)

    @cached_property
    def checksum(self) -> str:
        """SHA-256 over the URDF, the SRDF and the description: what is computed for a robot is kept under it."""
        d = self.description
        digest = hashlib.sha256(d.content)
        for source in (d.urdf, d.srdf):
            if source is not None:
                digest.update(source_path(source, d.where).read_bytes())
        return digest.hexdigest()

    def forward(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """T_base_tool of n configurations."""
        from understudy.robot.chain import forward_many

        return np.asarray(forward_many(self.fixed, self.stack(q, torso)))

    def stack(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
        """Torso and arm in one array, as `chain` and `collides` want it: k = j + 1."""
        return np.ascontiguousarray(np.column_stack([torso, q]), dtype=float)

    def sample(self, n: int, seed: int = 0) -> tuple[Float[np.ndarray, "n j"], Float[np.ndarray, " n"]]:
        """Configurations (q, torso), uniform within the limits; a continuous joint within +-pi."""
        rng = np.random.default_rng(seed)
        low, high = np.where(self.continuous, -np.pi, self.lower), np.where(self.continuous, np.pi, self.upper)
        return rng.uniform(low, high, (n, self.n)), rng.uniform(*self.torso_limits, n)

    def within_limits(
        self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"], tolerance: float = 1e-9
    ) -> Bool[np.ndarray, " n"]:
        """Whether every joint is within its limits."""
        arm = ((q >= self.lower - tolerance) & (q <= self.upper + tolerance)).all(axis=1)
        low, high = self.torso_limits
        return np.asarray(arm & (torso >= low - tolerance) & (torso <= high + tolerance))

    def unwrap(self, q: Float[np.ndarray, "t j"]) -> Float[np.ndarray, "t j"]:
        """A path whose continuous joints take the short way round from step to step."""
        return np.where(self.continuous, np.unwrap(q, axis=0), q)

    @cached_property
    def self_collision(self) -> SelfCollision:
        """The checker; reads the meshes when first asked for."""
        from understudy.robot.collision import SelfCollision

        return SelfCollision(self)

    def collides(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether the arm or gripper touches the robot itself (the SRDF's pairs; the gripper open)."""
        return self.self_collision.check(q, torso)

    def urdf_with_base(self) -> str:
        """See `understudy.robot.urdf.urdf_with_base`."""
        return urdf_with_base(self.description)

    def _joint_id(self, name: str, field: str) -> int:
        if not self.model.existJointName(name):
            raise RobotError(f"{self.description.where}: {field}: the URDF has no movable joint {name!r}")
        return int(self.model.getJointId(name))

    def _check_root(self) -> None:
        d = self.description
        for field, name in (("base_link", d.base_link), ("tool_link", d.tool_link)):
            if not self.model.existBodyName(name):
                raise RobotError(f"{d.where}: {field}: the URDF has no link {name!r}")
        frame = self.model.frames[self.model.getBodyId(d.base_link)]
        if frame.parentJoint != 0 or np.abs(frame.placement.homogeneous - np.eye(4)).max() > 1e-12:
            raise RobotError(f"{d.where}: base_link: {d.base_link!r} is not the root of the URDF")

    def _check_chain(self, joints: list[int], torso: int | None) -> None:
        """The torso hangs on the base, each joint on the one before, the tool on the last."""
        d, model = self.description, self.model
        chain = ([] if torso is None else [torso]) + joints
        parents = [int(model.parents[j]) for j in chain] + [model.frames[model.getBodyId(d.tool_link)].parentJoint]
        for name, parent, expected in zip(
            [model.names[j] for j in chain] + [d.tool_link], parents, [0, *chain], strict=True
        ):
            if parent != expected:
                raise RobotError(
                    f"{d.where}: {name!r} moves with joint {model.names[parent]!r}, "
                    f"not with {model.names[expected]!r}: "
                    "torso_joint, arm_joints and tool_link must form one chain without a movable joint in between"
                )
        for j in joints:
            if model.joints[j].nv != 1 or "P" in model.joints[j].shortname():
                raise RobotError(f"{d.where}: arm_joints: {model.names[j]!r} is not revolute or continuous")
        if torso is not None and not model.joints[torso].shortname().startswith("JointModelP"):
            raise RobotError(f"{d.where}: torso_joint: {d.torso_joint!r} is not prismatic")

    def _fixed_transforms(self, joints: list[int], torso: int | None) -> Float[np.ndarray, "k 3 4"]:
        """Each joint frame is turned so that its axis is z; what turns it is taken back at the start of the next."""
        pin, model, d = require_pinocchio(), self.model, self.description
        data = model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model), np.ones(model.nv))
        placements, back = [], np.eye(4)
        for j in [torso, *joints]:
            T = np.eye(4) if j is None else model.jointPlacements[j].homogeneous
            motion = np.array([0, 0, 1.0]) if j is None else _axis(model.joints[j].createData().S)
            turn = np.eye(4)
            turn[:3, :3] = _rotation_taking_z_to(motion)
            placements.append(back @ T @ turn)
            back = turn.T
        tool = model.frames[model.getBodyId(d.tool_link)].placement.homogeneous @ d.T_link_tool
        return np.ascontiguousarray(np.array([*placements, back @ tool])[:, :3])

    def _read_limits(self, joints: list[int], torso: int | None) -> None:
        model = self.model
        q0, v0 = [model.joints[j].idx_q for j in joints], [model.joints[j].idx_v for j in joints]
        self.continuous: Bool[np.ndarray, " j"] = np.array([model.joints[j].nq == 2 for j in joints])
        """no limits; q and q + 2 pi are the same"""
        self.lower: Float[np.ndarray, " j"] = np.where(self.continuous, -np.inf, model.lowerPositionLimit[q0])
        self.upper: Float[np.ndarray, " j"] = np.where(self.continuous, np.inf, model.upperPositionLimit[q0])
        """radians; infinite for continuous joints"""
        self.velocity: Float[np.ndarray, " j"] = np.array(model.velocityLimit[v0])
        """radians/s"""
        k = None if torso is None else model.joints[torso].idx_q
        self.torso_limits: tuple[float, float] = (
            (0.0, 0.0) if k is None else (float(model.lowerPositionLimit[k]), float(model.upperPositionLimit[k]))
        )
        """metres"""
        posture = self.description.posture
        if not self.within_limits(posture[None], np.array([self.torso_limits[0]]))[0]:
            raise RobotError(f"{self.description.where}: posture: outside of the joint limits")


def _axis(S: Float[np.ndarray, "*six"]) -> Float[np.ndarray, "3"]:
    """A one-joint motion subspace's direction, of translation or rotation."""
    S = np.asarray(S).reshape(6)
    return S[:3] if np.abs(S[:3]).max() > 0.5 else S[3:]


def _rotation_taking_z_to(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Any rotation whose third column is the axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
