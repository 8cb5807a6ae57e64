"""What understudy must know of a robot beyond its URDF: small JSON files, read and checked here (docs/robot.md)."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError, one_of
from understudy.files import parse_json

ROBOTS: Final = {
    "pr2": "pr2_right",
    "pr2:right": "pr2_right",
    "pr2:left": "pr2_left",
    "tiago_pro": "tiago_pro_right",
    "tiago_pro:right": "tiago_pro_right",
}
"""Name -> shipped description (`descriptions/*.json`)."""


class RobotError(UnderstudyError):
    """A robot's description, URDF or SRDF that cannot be used."""


@dataclass(frozen=True, eq=False)
class Gripper:
    """Two fingers that close along the tool frame's y axis."""

    joints: tuple[str, ...]
    """in the URDF: the first is driven, the others follow"""
    multipliers: tuple[float, ...]
    """value of each joint over the first's"""
    closed: float
    """first joint's value (radians or metres) at opening 0 (or the smallest that there is)"""
    open: float
    """first joint's value at `opening_m`"""
    opening_m: float
    """largest distance between the pads"""
    pad_size_m: Float[np.ndarray, "2"]
    """of a pad: along the tool's x, along its z"""
    reach_m: float
    """how far the finger tips stand out beyond the tool frame's origin, along x"""

    def joint_value(self, opening_m: float) -> float:
        """Value of the first joint for a distance between the pads (linear; good to 2 mm on the shipped robots)."""
        share = float(np.clip(opening_m / self.opening_m, 0, 1))
        return self.closed + share * (self.open - self.closed)


@dataclass(frozen=True, eq=False)
class Limits:
    """What the robot's drives can do. Accelerations are not in URDFs: chosen, and documented in docs/robot.md."""

    base_velocity: Float[np.ndarray, "3"]
    """x, y (metres/s), yaw (radians/s)"""
    base_acceleration: Float[np.ndarray, "3"]
    torso_velocity: float
    """metres/s"""
    torso_acceleration: float
    arm_acceleration: Float[np.ndarray, " n"]
    """radians/s^2; the velocities come from the URDF"""


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """A robot with a planar base, a lifting torso (or none), one arm with a gripper. Frames: CONVENTIONS.md."""

    name: str
    urdf: str
    """path, or path inside the package example-robot-data, such as `pr2_description/urdf/pr2.urdf`"""
    srdf: str | None
    """the same for the SRDF; without it, pairs of links that touch in `posture` are never checked"""
    base: str
    """how the base moves: `planar` (x, y, yaw: holonomic)"""
    base_link: str
    """root link of the URDF, on the floor; the base's pose (x, y, yaw) is this link's"""
    torso_joint: str | None
    """prismatic, along z"""
    arm_joints: tuple[str, ...]
    """from the shoulder to the wrist"""
    tool_link: str
    T_link_tool: Float[np.ndarray, "4 4"]
    """the tool frame in `tool_link`: origin between the pads, x out of the gripper, y the closing direction,
    z = x cross y"""
    gripper: Gripper
    footprint: Float[np.ndarray, "k 2"]
    """the base's outline, metres, base frame, counter-clockwise, convex"""
    limits: Limits
    posture: Float[np.ndarray, " n"]
    """a comfortable posture of the arm, radians"""
    others: dict[str, float]
    """values of other joints (the other arm's, the head's) that are not 0 while the robot works"""
    ignored_links: tuple[str, ...]
    """left out of collision checks"""
    where: str
    """the file it comes from"""
    content: bytes
    """of that file, for checksums"""


def load_description(name_or_path: str | Path) -> RobotDescription:
    """A shipped robot's description by name (`ROBOTS`), or one from a JSON file.

    Raises RobotError that names the file and the field.
    """
    name = str(name_or_path)
    if name in ROBOTS:
        file = files("understudy.robot") / "descriptions" / f"{ROBOTS[name]}.json"
        return parse_description(file.read_bytes(), f"{ROBOTS[name]}.json")
    path = Path(name_or_path)
    if path.suffix != ".json":
        raise RobotError(f"robot {name!r}: must be {one_of(ROBOTS)}, or a path to a description (.json)")
    try:
        return parse_description(path.read_bytes(), str(path))
    except OSError as e:
        raise RobotError(f"{path}: not readable: {e}") from e


def parse_description(content: bytes, where: str) -> RobotDescription:
    """A description from the bytes of a JSON file. Raises RobotError that begins with `where`."""
    try:
        fields = _Fields(parse_json(content, where), where)
    except RobotError:
        raise
    except UnderstudyError as e:
        raise RobotError(str(e)) from e
    arm = fields.words("arm_joints")
    base = fields.word("base")
    if base != "planar":
        raise RobotError(f"{where}: base {base!r}: must be {one_of(['planar'])}")
    posture = fields.vector("posture", len(arm))
    description = RobotDescription(
        name=fields.word("name"),
        urdf=_located(fields.word("urdf"), where),
        srdf=None if fields.get("srdf") is None else _located(fields.word("srdf"), where),
        base=base,
        base_link=fields.word("base_link"),
        torso_joint=None if fields.get("torso_joint") is None else fields.word("torso_joint"),
        arm_joints=arm,
        tool_link=fields.word("tool_link"),
        T_link_tool=_tool_frame(fields.part("tool_frame")),
        gripper=_gripper(fields.part("gripper")),
        footprint=_footprint(fields),
        limits=_limits(fields.part("limits"), len(arm)),
        posture=posture,
        others=fields.numbers("others"),
        ignored_links=fields.words("ignored_links"),
        where=where,
        content=content,
    )
    fields.refuse_rest()
    return description


class _Fields:
    """Takes typed fields out of a JSON object; what is missing, wrong or left over becomes a RobotError."""

    def __init__(self, data: dict[str, Any], where: str):
        self.data, self.where, self.seen = data, where, {"comment"}
        self.parts: list[_Fields] = []

    def get(self, key: str) -> Any:
        self.seen.add(key)
        if key not in self.data:
            raise RobotError(f"{self.where}: the field {key!r} is missing")
        return self.data[key]

    def fail(self, key: str, must: str) -> RobotError:
        return RobotError(f"{self.where}: {key}: must be {must}, got {self.data[key]!r}")

    def word(self, key: str) -> str:
        value = self.get(key)
        if not isinstance(value, str) or not value:
            raise self.fail(key, "text")
        return value

    def words(self, key: str) -> tuple[str, ...]:
        value = self.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.fail(key, "a list of names")
        return tuple(value)

    def number(self, key: str, positive: bool = False) -> float:
        value = self.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or (positive and value <= 0):
            raise self.fail(key, "a number above 0" if positive else "a number")
        return float(value)

    def numbers(self, key: str) -> dict[str, float]:
        value = self.get(key)
        if not isinstance(value, dict) or not all(type(v) in (int, float) for v in value.values()):
            raise self.fail(key, "an object of numbers")
        return {name: float(v) for name, v in value.items()}

    def vector(self, key: str, n: int | None, positive: bool = False) -> Float[np.ndarray, " n"]:
        value = self.get(key)
        good = isinstance(value, list) and all(type(v) in (int, float) for v in value)
        if not good or (n is not None and len(value) != n) or (positive and min(value) <= 0):
            raise self.fail(key, f"{'a list of' if n is None else n} numbers{' above 0' if positive else ''}")
        return np.array(value, float)

    def part(self, key: str) -> _Fields:
        value = self.get(key)
        if not isinstance(value, dict):
            raise self.fail(key, "an object")
        self.parts.append(_Fields(value, f"{self.where}: {key}"))
        return self.parts[-1]

    def refuse_rest(self) -> None:
        for part in (self, *self.parts):
            if rest := sorted(set(part.data) - part.seen):
                raise RobotError(f"{part.where}: unknown field {rest[0]!r}: must be {one_of(sorted(part.seen))}")


def _located(source: str, where: str) -> str:
    """A file beside the description, if there is one; otherwise as it stands (absolute, or in example-robot-data)."""
    beside = Path(where).parent / source
    return str(beside.resolve()) if beside.is_file() else source


def _tool_frame(fields: _Fields) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, 3] = fields.vector("origin", 3)
    T[:3, 0], T[:3, 1] = fields.vector("x", 3), fields.vector("y", 3)
    if np.abs(T[:3, :2].T @ T[:3, :2] - np.eye(2)).max() > 1e-6:
        raise RobotError(f"{fields.where}: x and y: must be unit vectors at a right angle")
    T[:3, 2] = np.cross(T[:3, 0], T[:3, 1])
    return T


def _gripper(fields: _Fields) -> Gripper:
    joints = fields.words("joints")
    gripper = Gripper(
        joints=joints,
        multipliers=tuple(fields.vector("multipliers", len(joints)).tolist()),
        closed=fields.number("closed"),
        open=fields.number("open"),
        opening_m=fields.number("opening_m", positive=True),
        pad_size_m=fields.vector("pad_size_m", 2, positive=True),
        reach_m=fields.number("reach_m"),
    )
    if not joints:
        raise RobotError(f"{fields.where}: joints: must name at least the driven one")
    return gripper


def _footprint(fields: _Fields) -> Float[np.ndarray, "k 2"]:
    rows = fields.get("footprint")
    try:
        polygon = np.array(rows, float)
    except (TypeError, ValueError):
        polygon = np.empty(0)
    if polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
        raise fields.fail("footprint", "at least 3 pairs of metres")
    edges = np.roll(polygon, -1, axis=0) - polygon
    after = np.roll(edges, -1, axis=0)
    if (edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]).min() <= 0:
        raise fields.fail("footprint", "a convex polygon, counter-clockwise")
    return polygon


def _limits(fields: _Fields, n: int) -> Limits:
    return Limits(
        base_velocity=fields.vector("base_velocity", 3, positive=True),
        base_acceleration=fields.vector("base_acceleration", 3, positive=True),
        torso_velocity=fields.number("torso_velocity", positive=True),
        torso_acceleration=fields.number("torso_acceleration", positive=True),
        arm_acceleration=fields.vector("arm_acceleration", n, positive=True),
    )
