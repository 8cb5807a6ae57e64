"""Self-collision of the arm: Pinocchio's geometry and Coal, over the pairs of links that the SRDF leaves on."""

from __future__ import annotations

from threading import Lock
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.robot.chain import frames
from understudy.robot.collision_cover import Cover, covered
from understudy.robot.description import RobotError
from understudy.robot.model import require_pinocchio
from understudy.robot.urdf import source_path

if TYPE_CHECKING:
    from understudy.robot.model import Robot

_HULL_EXCESS: Final = 0.3
_HULL_SIZE: Final = 0.12
"""a mesh whose hull is at most this share larger, or whose box's diagonal is at most so many metres (parts of fingers),
is replaced by the hull: convex shapes are many times faster, and the check errs to the safe side
"""


class SelfCollision:
    """Checks configurations of one robot. All other joints stay where the description's `others` puts them."""

    def __init__(self, robot: Robot):
        pin = require_pinocchio()
        self._lock = Lock()
        d = robot.description
        full = robot.model
        geometry = pin.buildGeomFromUrdfString(full, robot.urdf, pin.GeometryType.COLLISION)
        geometry.addAllCollisionPairs()
        if d.srdf is not None:
            srdf = source_path(d.srdf, d.where).read_text(encoding="utf-8", errors="replace")
            pin.removeCollisionPairsFromXML(full, geometry, srdf, False)
        chain = [*d.arm_joints] if d.torso_joint is None else [d.torso_joint, *d.arm_joints]
        locked = [i for i in range(1, full.njoints) if full.names[i] not in chain]
        self.model, self.geometry = pin.buildReducedModel(full, geometry, locked, _reference(robot))
        self._pin = pin
        self._columns = [d.arm_joints.index(name) + 1 if name in d.arm_joints else 0 for name in self.model.names[1:]]
        self._continuous = [bool(j.nq == 2) for j in self.model.joints][1:]
        self._keep([self._matters(robot, pair) for pair in self.geometry.collisionPairs])
        self.data = self.model.createData()
        if d.srdf is None:
            self._drop_touching(robot)
        self._simplify()
        self.geometry_data = self.geometry.createData()
        self._cover = self._covered(robot)
        if self.check(d.posture[None], np.array([robot.torso_limits[0]]))[0]:
            raise RobotError(f"{d.where}: posture: the arm touches {self.touching(d.posture, robot.torso_limits[0])}")

    def check(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether any pair touches, for each configuration."""
        rows, near = self.configurations(q, torso), self.near(q, torso)
        update, touch = self._pin.updateGeometryPlacements, self._pin.computeCollision
        out = np.zeros(len(rows), bool)
        with self._lock:  # one set of working data for all threads
            for i in np.flatnonzero(near.any(axis=1)):
                update(self.model, self.data, self.geometry, self.geometry_data, rows[i])
                pairs = np.flatnonzero(near[i]).tolist()
                out[i] = any(touch(self.geometry, self.geometry_data, pair) for pair in pairs)
        return out

    def near(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, "n p"]:
        """Pairs of shapes that may touch; the others cannot."""
        return self._cover.near(self._fixed, np.column_stack([torso, q]))

    def touching(self, q: Float[np.ndarray, " j"], torso: float) -> list[tuple[str, str]]:
        """The pairs of links that touch."""
        row = self.configurations(q[None], np.array([torso]))[0]
        self._pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.geometry_data, row)
        self._pin.computeCollisions(self.geometry, self.geometry_data, False)
        hit = [r.isCollision() for r in self.geometry_data.collisionResults]
        names = [self._links(pair) for pair in self.geometry.collisionPairs]
        return sorted({pair for pair, touches in zip(names, hit, strict=True) if touches})

    def configurations(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n m"]:
        """Configuration vectors of `model`: cosine and sine for a continuous joint."""
        values = np.column_stack([torso, q])[:, self._columns]
        parts = []
        for value, continuous in zip(values.T, self._continuous, strict=True):
            parts += [np.cos(value), np.sin(value)] if continuous else [value]
        return np.ascontiguousarray(np.column_stack(parts))

    def _links(self, pair: Any) -> tuple[str, str]:
        objects = self.geometry.geometryObjects
        first, second = (self.model.frames[objects[i].parentFrame].name for i in (pair.first, pair.second))
        return min(first, second), max(first, second)

    def _matters(self, robot: Robot, pair: Any) -> bool:
        """The arm moves the two against each other, they are no neighbours, and none is to be ignored."""
        objects = self.geometry.geometryObjects
        a, b = objects[pair.first].parentJoint, objects[pair.second].parentJoint
        if a == b or set(self._links(pair)) & set(robot.description.ignored_links):
            return False
        arm = {self.model.getJointId(name) for name in robot.description.arm_joints}
        neighbours = self.model.parents[a] == b or self.model.parents[b] == a
        return bool((a in arm or b in arm) and not (robot.description.srdf is None and neighbours))

    def _drop_touching(self, robot: Robot) -> None:
        """Without an SRDF: pairs that touch in the comfortable posture are how the meshes are, not collisions."""
        self.geometry_data = self.geometry.createData()
        touching = set(self.touching(robot.description.posture, robot.torso_limits[0]))
        self._keep([self._links(pair) not in touching for pair in self.geometry.collisionPairs])

    def _simplify(self) -> None:
        """Nearly convex meshes -> their convex hulls, many times faster."""
        for shape in self.geometry.geometryObjects:
            mesh = shape.geometry
            if not hasattr(mesh, "buildConvexRepresentation"):
                continue
            solid = abs(mesh.computeVolume())
            mesh.buildConvexHull(True, "Qt")
            hull = mesh.convex
            mesh.computeLocalAABB()
            small = 2 * mesh.aabb_radius <= _HULL_SIZE
            if hull is not None and (small or hull.computeVolume() <= (1 + _HULL_EXCESS) * solid):
                shape.geometry = hull

    def _covered(self, robot: Robot) -> Cover:
        """Balls around all shapes, in the frames of the chain's joints."""
        d, torso = robot.description, robot.torso_limits[0]
        self._fixed = robot.fixed
        x = robot.stack(d.posture[None], np.array([torso]))[0]
        work, tmp = np.empty((len(x) + 1, 3, 4)), np.empty((3, 4))
        frames(robot.fixed, x, work, tmp)
        self._pin.forwardKinematics(self.model, self.data, self.configurations(d.posture[None], np.array([torso]))[0])
        numbers = {name: k for k, name in enumerate([d.torso_joint, *d.arm_joints]) if name is not None}
        shapes, joints = [], []
        for shape in self.geometry.geometryObjects:
            points, spare = covered(shape.geometry)
            T = (self.data.oMi[shape.parentJoint] * shape.placement).homogeneous
            points = points @ T[:3, :3].T + T[:3, 3]
            joint = numbers.get(self.model.names[shape.parentJoint], -1)
            if joint >= 0:
                points = (points - work[joint, :, 3]) @ work[joint, :, :3]
            shapes.append((points, spare))
            joints.append(joint)
        pairs = np.array([(p.first, p.second) for p in self.geometry.collisionPairs], int).reshape(-1, 2)
        return Cover(shapes, np.array(joints, int), pairs)

    def _keep(self, wanted: list[bool]) -> None:
        """Keeps those pairs, and the shapes that are in any: placing the others costs time."""
        old, new = self.geometry, self._pin.GeometryModel()
        pairs = [(p.first, p.second) for p, keep in zip(old.collisionPairs, wanted, strict=True) if keep]
        index = {i: new.addGeometryObject(old.geometryObjects[i]) for i in sorted({i for p in pairs for i in p})}
        for first, second in pairs:
            new.addCollisionPair(self._pin.CollisionPair(index[first], index[second]))
        self.geometry = new


def _reference(robot: Robot) -> Float[np.ndarray, " nq"]:
    """The full model's configuration: neutral, but for `others` and the gripper, which is open."""
    pin, model, d = require_pinocchio(), robot.model, robot.description
    q = pin.neutral(model)
    gripper = {j: m * d.gripper.open for j, m in zip(d.gripper.joints, d.gripper.multipliers, strict=True)}
    for field, values in (("others", d.others), ("gripper: joints", gripper)):
        for name, value in values.items():
            if not model.existJointName(name):
                raise RobotError(f"{d.where}: {field}: the URDF has no movable joint {name!r}")
            joint = model.joints[model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
    return np.asarray(q)
