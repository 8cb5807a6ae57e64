"""One MuJoCo model of a robot before a piece of furniture: links, servos, fingers, what may touch what.

The robot is its URDF with a planar base. Joints that do not take part (the other arm, the head, casters) are frozen
at the description's `others`. Links collide as convex hulls of their meshes; the finger tips are boxes of the size of
their pads, with the friction of rubber. Nothing is welded to anything: what is held is held by friction.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.geometry import inverse, rigid
from understudy.robot.description import Gripper, RobotError
from understudy.robot.model import Robot, require_pinocchio
from understudy.robot.urdf import BASE_JOINTS
from understudy.stage.furniture import Furniture
from understudy.stage.mechanism import add_furniture

STEP_S: Final = 0.002
TOOL: Final = "robot_tool"
"""Name of the site at the tool frame."""
PAD: Final = "pad"
"""Collision geoms of the finger tips are `pad0`, `pad1`; of the gripper's other links, `gripper_LINK`; of the rest,
`robot_LINK`. Geoms of furniture have other names (`stage.mechanism`)."""
GRIPPER, BODY = "gripper_", "robot_"
VISUAL_GROUP, HULL_GROUP = 2, 3

_PAD_FRICTION: Final = (1.0, 0.01, 0.0005)
_PAD_THICKNESS_M: Final = 0.008
_HULL_VERTICES: Final = 40
_ROBOT_BITS: Final = (2, 1)  # contype, conaffinity: the robot meets what has (1, 1), but not itself
_FINGER_EQUALITY: Final = (0.004, 1.0)  # solref


@dataclass(frozen=True)
class Drives:
    """Servos: stiffness, damping, greatest force. Chosen such that the arm is compliant (about 1.5 kN/m at the tool),
    and no stronger than a PR2: the arm's efforts are the URDF's, the grip of a PR2 is at most 100 N.
    """

    base: tuple[float, float, float] = (3.0e4, 4.0e3, 500.0)
    """N/m, N s/m, N"""
    base_turn: tuple[float, float, float] = (1.2e4, 1.2e3, 250.0)
    """Nm/rad, ..."""
    torso: tuple[float, float, float] = (4.0e4, 4.0e3, 1500.0)
    arm: tuple[float, ...] = (500.0, 500.0, 250.0, 350.0, 80.0, 80.0, 60.0)
    """Nm/rad, from the shoulder to the wrist; further joints as the last"""
    arm_damping_s: float = 0.12
    """damping over stiffness"""
    grip: tuple[float, float, float] = (3.0e3, 100.0, 60.0)
    """N/m, N s/m, N, between the pads"""


def build(robot: Robot, furniture: Furniture, drives: Drives, visual: bool = False) -> mujoco.MjModel:
    """The compiled model. visual: with meshes for pictures, floor and light."""
    spec = mujoco.MjSpec.from_string(_bare_urdf(robot.urdf_with_base(), _frozen(robot)))
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10  # friction as stiff as it is normal to the surface: grasps do not creep
    for body in spec.bodies:
        body.gravcomp = 0 if body.name == "world" else 1
    _add_hulls(spec, robot)
    _add_fingers(spec, robot, drives)
    _add_servos(spec, robot, drives)
    d = robot.description
    tool = spec.body(d.tool_link)
    tool.add_site(name=TOOL, pos=d.T_link_tool[:3, 3], quat=_quaternion(d.T_link_tool))
    add_furniture(spec, furniture)
    if visual:
        _add_looks(spec, robot)
    try:
        return spec.compile()
    except ValueError as e:
        raise RobotError(f"{d.where}: urdf {d.urdf}: MuJoCo cannot use it: {e}") from e


def _moving(robot: Robot) -> list[str]:
    d = robot.description
    return [*BASE_JOINTS, *([d.torso_joint] if d.torso_joint else []), *d.arm_joints, *d.gripper.joints]


def _frozen(robot: Robot) -> dict[str, float]:
    """Joint -> value, for all that do not move."""
    moving, others = set(_moving(robot)), robot.description.others
    names = list(robot.model.names)[1:]
    return {name: others.get(name, 0.0) for name in names if name not in moving}


def _bare_urdf(urdf: str, frozen: dict[str, float]) -> str:
    """The URDF without shapes, with frozen joints made fixed ones where they stand."""
    root = ET.fromstring(urdf)
    for link in root.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    for joint in root.findall("joint"):
        value = frozen.get(joint.get("name", ""))
        if value is not None:
            _freeze(joint, value)
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(
        extension, "compiler", balanceinertia="true", boundmass="0.001", boundinertia="0.00001", fusestatic="false",
        strippath="false", discardvisual="false",
    )  # fmt: skip
    return ET.tostring(root, encoding="unicode")


def _freeze(joint: ET.Element, value: float) -> None:
    axis = np.array((_attribute(joint, "axis", "xyz") or "1 0 0").split(), float)
    T = _origin(joint)
    step = axis * value
    if joint.get("type") == "prismatic":
        T = T @ rigid(np.eye(3), step)
    else:
        T = T @ rigid(Rotation.from_rotvec(step).as_matrix(), np.zeros(3))
    for child in [c for c in joint if c.tag not in ("parent", "child")]:
        joint.remove(child)
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    ET.SubElement(joint, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(rpy))
    joint.set("type", "fixed")


def _origin(element: ET.Element) -> Float[np.ndarray, "4 4"]:
    xyz = (_attribute(element, "origin", "xyz") or "0 0 0").split()
    rpy = (_attribute(element, "origin", "rpy") or "0 0 0").split()
    R = Rotation.from_euler("xyz", np.array(rpy, float)).as_matrix()
    return rigid(R, np.array(xyz, float))


def _attribute(element: ET.Element, tag: str, name: str) -> str | None:
    found = element.find(tag)
    return None if found is None else found.get(name)


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


@dataclass(frozen=True, eq=False)
class _Mesh:
    link: str
    file: str
    scale: tuple[float, ...]
    T_link_mesh: Float[np.ndarray, "4 4"]


@lru_cache(maxsize=4)
def _meshes(urdf: str, tag: str) -> tuple[_Mesh, ...]:
    """The meshes of all links; tag: visual or collision."""
    out = []
    for link in ET.fromstring(urdf).findall("link"):
        for shape in link.findall(tag):
            mesh = shape.find("geometry/mesh")
            if mesh is not None and mesh.get("filename", "").lower().endswith((".stl", ".obj")):
                scale = tuple(float(s) for s in (mesh.get("scale") or "1 1 1").split())
                out.append(_Mesh(link.get("name", ""), mesh.get("filename", ""), scale, _origin(shape)))
    return tuple(out)


def finger_links(robot: Robot) -> tuple[set[str], set[str]]:
    """Links that the gripper's joints move, and those among them that move no other: the tips."""
    root = ET.fromstring(robot.urdf)
    joints = {j.get("name"): j for j in root.findall("joint")}
    ends = [joints[name] for name in robot.description.gripper.joints]
    children = {_attribute(j, "child", "link") or "" for j in ends}
    parents = {_attribute(j, "parent", "link") or "" for j in ends}
    return children, children - parents


def _add_hulls(spec: mujoco.MjSpec, robot: Robot) -> None:
    fingers, tips = finger_links(robot)
    palm = _rigid_with(robot, robot.description.tool_link)
    for i, mesh in enumerate(_meshes(robot.urdf, "collision")):
        if mesh.link in tips:
            continue
        name = f"hull{i}"
        spec.add_mesh(name=name, file=mesh.file, scale=mesh.scale, maxhullvert=_HULL_VERTICES, inertia=_SHELL)
        prefix = GRIPPER if mesh.link in fingers or mesh.link in palm else BODY
        _add_mesh_geom(spec, mesh, name, f"{prefix}{mesh.link}_{i}", HULL_GROUP)


_SHELL: Final = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open meshes have no volume; it is not used


def _add_mesh_geom(spec: mujoco.MjSpec, mesh: _Mesh, asset: str, name: str, group: int) -> mujoco.MjsGeom:
    solid = group == HULL_GROUP
    return spec.body(mesh.link).add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=asset,
        pos=mesh.T_link_mesh[:3, 3],
        quat=_quaternion(mesh.T_link_mesh),
        contype=_ROBOT_BITS[0] if solid else 0,
        conaffinity=_ROBOT_BITS[1] if solid else 0,
        group=group,
        mass=0,
    )


def _rigid_with(robot: Robot, link: str) -> set[str]:
    """Links that fixed joints join to the last arm joint's, such as the palm."""
    model = robot.model
    parent = model.frames[model.getBodyId(link)].parentJoint
    pin = require_pinocchio()
    return {f.name for f in model.frames if f.parentJoint == parent and f.type == pin.FrameType.BODY}


def _tool_in_tips(robot: Robot) -> dict[str, Float[np.ndarray, "4 4"]]:
    """T_tip_tool of each tip with the gripper closed."""
    pin, model, d = require_pinocchio(), robot.model, robot.description
    data, q = model.createData(), require_pinocchio().neutral(model)
    for name, m in zip(d.gripper.joints, d.gripper.multipliers, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = m * d.gripper.closed
    pin.framesForwardKinematics(model, data, q)
    T_tool = data.oMf[model.getBodyId(d.tool_link)].homogeneous @ d.T_link_tool
    return {tip: inverse(data.oMf[model.getBodyId(tip)].homogeneous) @ T_tool for tip in sorted(finger_links(robot)[1])}


def _add_fingers(spec: mujoco.MjSpec, robot: Robot, drives: Drives) -> None:
    """Pads on the tips, and one drive for all of the gripper's joints."""
    gripper = robot.description.gripper
    length, height = gripper.pad_size_m
    for i, (tip, T_tip_tool) in enumerate(_tool_in_tips(robot).items()):
        body = spec.body(tip)
        side = -np.sign(T_tip_tool[1, 3]) or (1 - 2 * i)  # the tip lies on this side of the tool's middle
        middle = rigid(np.eye(3), np.array([gripper.reach_m - length / 2, side * _PAD_THICKNESS_M / 2, 0]))
        T = T_tip_tool @ middle
        body.add_geom(
            name=f"{PAD}{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=T[:3, 3],
            quat=_quaternion(T),
            size=[length / 2, _PAD_THICKNESS_M / 2, height / 2],
            friction=_PAD_FRICTION,
            condim=4,
            contype=_ROBOT_BITS[0],
            conaffinity=_ROBOT_BITS[1],
            group=HULL_GROUP,
            mass=0,
            solref=[0.005, 1.0],
        )
    first = gripper.joints[0]
    for name, multiplier in zip(gripper.joints[1:], gripper.multipliers[1:], strict=True):
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1=name,
            name2=first,
            data=[0, multiplier / gripper.multipliers[0], *[0.0] * 10],
            solref=_FINGER_EQUALITY,
        )
    for name in gripper.joints:
        joint = spec.joint(name)
        joint.armature, joint.damping[0], joint.frictionloss = 2e-3, 0.05, 0
    kp, kv, force = drives.grip
    lever = metres_per_value(gripper)
    _add_servo(spec, first, kp * lever**2, kv * lever**2, force * abs(lever))


def metres_per_value(gripper: Gripper) -> float:
    """Opening between the pads over the first joint's value."""
    return gripper.opening_m / (gripper.open - gripper.closed)


def _add_servos(spec: mujoco.MjSpec, robot: Robot, drives: Drives) -> None:
    d = robot.description
    for name, (kp, kv, force) in zip(BASE_JOINTS, (drives.base, drives.base, drives.base_turn), strict=True):
        _bare_joint(spec, name)
        _add_servo(spec, name, kp, kv, force)
    if d.torso_joint:
        _bare_joint(spec, d.torso_joint)
        _add_servo(spec, d.torso_joint, *drives.torso)
    for i, name in enumerate(d.arm_joints):
        joint = robot.model.getJointId(name)
        effort = float(robot.model.effortLimit[robot.model.joints[joint].idx_v])
        kp = drives.arm[min(i, len(drives.arm) - 1)]
        _bare_joint(spec, name).armature = 0.1 if i < 4 else 0.02
        _add_servo(spec, name, kp, drives.arm_damping_s * kp, effort)


def _bare_joint(spec: mujoco.MjSpec, name: str) -> mujoco.MjsJoint:
    """The servo's damping replaces the URDF's, which stands for friction that the real drives make up for."""
    joint = spec.joint(name)
    joint.damping[0], joint.frictionloss = 0.0, 0.0
    return joint


def _add_servo(spec: mujoco.MjSpec, joint: str, kp: float, kv: float, force: float) -> None:
    spec.add_actuator(
        name=joint,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[kp, *[0.0] * 9],
        biasprm=[0, -kp, -kv, *[0.0] * 7],
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-force, force],
    )


def _add_looks(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Visual meshes, floor, sky, light."""
    for i, mesh in enumerate(_meshes(robot.urdf, "visual")):
        name = f"look{i}"
        spec.add_mesh(name=name, file=mesh.file, scale=mesh.scale, inertia=_SHELL)
        geom = _add_mesh_geom(spec, mesh, name, f"look_{i}", VISUAL_GROUP)
        geom.rgba = _color(mesh.link)
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.94, 0.95], rgb2=[0.70, 0.74, 0.78], width=64, height=384,
    )  # fmt: skip
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.60, 0.57, 0.53], rgb2=[0.56, 0.53, 0.49], width=256, height=256,
    )  # fmt: skip
    material = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True, reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[6, 6, 0.1], material="floor", contype=0, conaffinity=0
    )
    light = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(pos=[-2, 1, 4], dir=[0.4, -0.25, -1], type=light, diffuse=[0.55] * 3, castshadow=True)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 20
    spec.stat.extent, spec.stat.center = 3.0, [-0.6, 0, 0.8]


def _color(link: str) -> list[float]:
    if "finger" in link or "wheel" in link:
        return [0.25, 0.26, 0.28, 1]
    if any(word in link for word in ("gripper", "forearm", "shoulder_lift", "head_pan")):
        return [0.80, 0.81, 0.83, 1]
    return [0.95, 0.95, 0.94, 1] if "upper_arm" not in link else [0.70, 0.72, 0.75, 1]


def _quaternion(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    return Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
