"""What touches what in a simulation, and how hard."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np

from understudy.robot.simulator_model import BODY, GRIPPER, PAD
from understudy.stage.mechanism import HANDLE, PART

_TOUCH_N: Final = 1.0  # less is no touch


@dataclass(frozen=True)
class Touch:
    """Contacts over some time."""

    pads: frozenset[str] = field(default_factory=frozenset)
    """finger tips that are on the handle, at the last look"""
    force: float = 0.0
    """greatest force between gripper and part without the squeezing of the two fingers against each other, newtons"""
    grip: float = 0.0
    """greatest sum of the normal forces of the finger tips on the handle, newtons"""
    unwanted: frozenset[tuple[str, str]] = field(default_factory=frozenset)
    """(link, what it touched): anything but the gripper on the part"""

    def joined(self, later: Touch) -> Touch:
        """Of both times."""
        return Touch(
            later.pads,
            max(self.force, later.force),
            max(self.grip, later.grip),
            self.unwanted | later.unwanted,
        )


class Contacts:
    """Sorts contacts by the names of `simulator_model` and `stage.mechanism`."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        names = [model.geom(i).name for i in range(model.ngeom)]
        part = model.body(PART).id
        of_part = model.geom_bodyid == part
        self._part = of_part
        self._handle = np.array([name.startswith(HANDLE) for name in names]) & of_part
        self._pad = np.array([name.startswith(PAD) for name in names]) & ~of_part
        self._gripper = self._pad | np.array([name.startswith(GRIPPER) for name in names])
        self._robot = self._gripper | np.array([name.startswith(BODY) for name in names])
        self._names = [name.removeprefix(GRIPPER).removeprefix(BODY).rsplit("_", 1)[0] for name in names]
        self._full = names
        self._part_names = {name for name, moves in zip(names, of_part, strict=True) if moves}
        self._force = np.zeros(6)

    def now(self, data: mujoco.MjData) -> Touch:
        """Contacts of this moment."""
        n = data.ncon
        if not n:
            return Touch()
        pairs = data.contact.geom[:n]
        robot = self._robot[pairs]
        pads, unwanted, total, grip = set(), set(), np.zeros(3), 0.0
        for i in np.flatnonzero(robot.any(axis=1)):
            mujoco.mj_contactForce(self._model, data, int(i), self._force)
            normal = float(self._force[0])
            if normal < _TOUCH_N:
                continue
            own, other = pairs[i] if robot[i, 0] else pairs[i, ::-1]
            if not (self._gripper[own] and self._part[other]):
                unwanted.add((self._names[own], self._full[other]))
                continue
            sign = 1.0 if robot[i, 0] else -1.0
            total += sign * (data.contact.frame[i].reshape(3, 3).T @ self._force[:3])
            if self._pad[own] and self._handle[other]:
                pads.add(self._full[own])
                grip += normal
        return Touch(frozenset(pads), float(np.linalg.norm(total)), grip, frozenset(unwanted))

    def is_part(self, name: str) -> bool:
        """Whether a geom (by its name) is of the part that moves."""
        return name in self._part_names

    def set_friction(self, model: mujoco.MjModel, sliding: float) -> None:
        """Sliding friction of the handle and of the finger tips."""
        model.geom_friction[self._handle | self._pad, 0] = sliding
