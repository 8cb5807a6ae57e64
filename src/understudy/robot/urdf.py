"""Where a robot's URDF, SRDF and meshes are, and the URDF with a planar base that Pinocchio and MuJoCo share."""

from __future__ import annotations

import os
import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

from understudy.errors import MissingExtraError
from understudy.robot.description import RobotDescription, RobotError

BASE_JOINTS: Final = ("base_x", "base_y", "base_yaw")
"""The joints that `urdf_with_base` adds, in this order."""

_BASE = """
  <link name="world"/>
  <link name="base_x_link"/>
  <link name="base_y_link"/>
  <joint name="base_x" type="prismatic">
    <parent link="world"/><child link="base_x_link"/><axis xyz="1 0 0"/>
    <limit lower="-1000" upper="1000" effort="10000" velocity="{vx}"/>
  </joint>
  <joint name="base_y" type="prismatic">
    <parent link="base_x_link"/><child link="base_y_link"/><axis xyz="0 1 0"/>
    <limit lower="-1000" upper="1000" effort="10000" velocity="{vy}"/>
  </joint>
  <joint name="base_yaw" type="revolute">
    <parent link="base_y_link"/><child link="{root}"/><axis xyz="0 0 1"/>
    <limit lower="-1000" upper="1000" effort="10000" velocity="{vyaw}"/>
  </joint>
"""


def data_folder() -> Path:
    """The folder `robots` of the package example-robot-data. Raises MissingExtraError when it is not installed."""
    try:
        found = distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")
    except PackageNotFoundError as e:
        raise MissingExtraError("robots of the package example-robot-data", "robot") from e
    return Path(str(found))


def source_path(source: str, where: str) -> Path:
    """The file that a description names: absolute, or inside example-robot-data. Raises RobotError if there is none."""
    path = Path(source)
    if not path.is_absolute():
        path = data_folder() / source
    if not path.is_file():
        raise RobotError(
            f"{where}: no file {path}: give a path that is absolute, beside the description, "
            "or inside example-robot-data"
        )
    return path


def read_urdf(description: RobotDescription) -> str:
    """The robot's URDF with absolute mesh paths. Raises RobotError for files that are not there."""
    path = source_path(description.urdf, description.where)
    text = path.read_text(encoding="utf-8", errors="replace")

    def absolute(match: re.Match[str]) -> str:
        return f'filename="{_mesh_path(match.group(1), path)}"'

    return re.sub(r'filename="((?:package|file)://[^"]*)"', absolute, text)


def urdf_with_base(description: RobotDescription) -> str:
    """The URDF with three joints (`BASE_JOINTS`) between a new root link `world` and the base.

    Mesh paths are absolute. `mimic` tags stay: Pinocchio's loader and MuJoCo's treat their joints as free ones unless
    asked otherwise, so that whoever moves the gripper sets them all (`Gripper.joints`, `Gripper.multipliers`). The
    PR2's `*_parallel_*` joints carry limits that contradict their mimic: leave them at 0.
    """
    text = read_urdf(description)
    end = text.rfind("</robot>")
    if end < 0:
        raise RobotError(f"{description.where}: urdf {description.urdf}: no closing </robot>")
    v = description.limits.base_velocity
    base = _BASE.format(root=description.base_link, vx=v[0], vy=v[1], vyaw=v[2])
    return text[:end] + base + text[end:]


def _mesh_path(uri: str, urdf: Path) -> str:
    """`package://NAME/...` below the URDF's own ancestors or $ROS_PACKAGE_PATH; `file://...` as it stands."""
    if uri.startswith("file://"):
        return uri.removeprefix("file://")
    relative = uri.removeprefix("package://")
    ros = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    for folder in (*urdf.parents, *ros):
        if (folder / relative).is_file():
            return str(folder / relative)
    return uri
