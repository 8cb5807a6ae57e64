"""Furniture as bodies, joints and collision shapes of MuJoCo, for pictures and for robots that open it by contact."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.geometry import rigid
from understudy.objects.articulation import REVOLUTE
from understudy.stage.furniture import Box, Furniture

PART: Final = "part"
"""Name of the moving body and of its joint. The body's frame is the handle's; the joint's position is q."""
HANDLE: Final = "handle"
"""Name of the grip's geom; geoms of its posts are `handle_post0`, ... Other geoms have the names of their boxes."""

_COLORS: Final = MappingProxyType(
    {
        "front": (0.80, 0.74, 0.64, 1),
        "body": (0.72, 0.66, 0.57, 1),
        "inside": (0.62, 0.56, 0.48, 1),
        "wall": (0.86, 0.85, 0.82, 1),
        "frame": (0.92, 0.91, 0.88, 1),
        "metal": (0.62, 0.62, 0.63, 1),
    }
)
_FRICTION: Final = (0.9, 0.01, 0.0005)  # of a metal bar against rubber finger pads: sliding, turning, rolling
_KNOB_M: Final = 0.05  # a shorter grip is a knob: one post instead of two
_HANDLE_KG: Final = 0.12


def add_furniture(
    spec: mujoco.MjSpec, furniture: Furniture, prefix: str = "", materials: Mapping[str, str] | None = None
) -> None:
    """Adds a piece of furniture to a scene, in place.

    Adds the body `part` with a joint `part` (range, dry friction, damping and spring of `furniture.dynamics`) and
    static geoms to the world. Every name gets the prefix. materials: `Box.material` (or 'metal', for the handle) ->
    the name of a material of the scene; plain colours without it.
    """
    spec.compiler.degree = False
    for box in furniture.blocks:
        _add_box(spec.worldbody, box, prefix, materials)
    rest = furniture.articulation.T_rest
    part = spec.worldbody.add_body(name=prefix + PART, pos=rest[:3, 3], quat=_quaternion(rest))
    _add_joint(part, furniture, prefix)
    boxes = (furniture.panel, *furniture.parts)
    volumes = np.array([np.prod(box.half_m) for box in boxes])
    masses = furniture.dynamics.mass_kg * volumes / volumes.sum()
    for box, mass in zip(boxes, masses, strict=True):
        _add_box(part, box, prefix, materials).mass = mass
    _add_handle(part, furniture, prefix, materials)


def mjcf(furniture: Furniture, prefix: str = "") -> str:
    """The furniture alone as MJCF text."""
    spec = mujoco.MjSpec()
    add_furniture(spec, furniture, prefix)
    spec.compile()
    return str(spec.to_xml())


def _add_joint(part: mujoco.MjsBody, furniture: Furniture, prefix: str) -> None:
    local, dynamics = furniture.articulation.in_part(), furniture.dynamics
    turning = local.kind == REVOLUTE
    joint = part.add_joint(
        name=prefix + PART,
        type=mujoco.mjtJoint.mjJNT_HINGE if turning else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=local.direction,
        pos=local.point if turning else np.zeros(3),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=local.range,
        frictionloss=dynamics.friction,
    )
    joint.damping[0] = dynamics.damping
    if dynamics.stiffness > 0:
        joint.stiffness[0] = dynamics.stiffness
        joint.springref = -dynamics.preload / dynamics.stiffness


def _add_handle(part: mujoco.MjsBody, furniture: Furniture, prefix: str, materials: Mapping[str, str] | None) -> None:
    handle = furniture.handle
    end = max(handle.length_m / 2 - handle.radius_m, 1e-3)
    look = _look("metal", materials)
    part.add_geom(
        name=prefix + HANDLE,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, -end, 0, 0, end],
        size=[handle.radius_m, 0, 0],
        mass=_HANDLE_KG,
        friction=_FRICTION,
        condim=4,
        **look,
    )
    ends = (0.0,) if handle.length_m < _KNOB_M else (-end, end)
    for i, z in enumerate(ends):
        part.add_geom(
            name=f"{prefix}{HANDLE}_post{i}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            fromto=[0, 0, z, -handle.standoff_m, 0, z],
            size=[0.75 * handle.radius_m, 0, 0],
            mass=0.01,
            **look,
        )


def _add_box(body: mujoco.MjsBody, box: Box, prefix: str, materials: Mapping[str, str] | None) -> mujoco.MjsGeom:
    return body.add_geom(
        name=prefix + box.name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=box.T_frame_box[:3, 3],
        quat=_quaternion(box.T_frame_box),
        size=box.half_m,
        **_look(box.material, materials),
    )


def _look(material: str, materials: Mapping[str, str] | None) -> dict[str, object]:
    if materials is not None and material in materials:
        return {"material": materials[material]}
    return {"rgba": _COLORS[material]}


def _quaternion(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    """w x y z."""
    return Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


def pose_of(data: mujoco.MjData, body: str) -> Float[np.ndarray, "4 4"]:
    """T_world_body of a body by its name, as the simulation has it."""
    found = data.body(body)
    return rigid(found.xmat.reshape(3, 3), found.xpos)
