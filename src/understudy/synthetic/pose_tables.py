"""The tables of `pose_activities` as tensors, and the uniform numbers that a posture is made of."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Final

import torch
from torch import Tensor

from understudy.synthetic.pose_activities import (
    ACTIVITIES,
    ACTIVITY_TABLE,
    FRAMES,
    HANDS,
    LEG_FIELDS,
    LOWER,
    LOWER_DEFAULT,
    PELVIS_FIELDS,
    TRUNK_DEFAULT,
    TRUNK_FIELDS,
)

NAMES: Final = tuple(ACTIVITIES)
LEGS_TRIED: Final = 4
TARGETS_TRIED: Final = 4
SWIVELS_TRIED: Final = 5
TRIED: Final = TARGETS_TRIED * SWIVELS_TRIED
_DEG: Final = math.pi / 180
_IN_DEGREES: Final = {"tilt", "roll", "yaw", "flex", "abd", "rot", "knee", "fyaw", "fpitch", "out"}
CHOICES: Final = ("lower", "hands", "mirror", "phase", "look", "lay")


@dataclass(frozen=True)
class Tables:
    """The activities' tables as tensors on one device; angles in radians."""

    lower_choice: Tensor  # [A, S] cumulative weights
    hands_choice: Tensor  # [A, P] cumulative weights
    hands: Tensor  # [A, P, 3]: style of hand a, of hand b, b mirrors a
    trunk: Tensor  # [A, T, 2]
    pelvis: Tensor  # [S, F, 2]
    legs: Tensor  # [S, leg a or b, F, 2]
    box: Tensor  # [H, 3, 2]
    palm: Tensor  # [H, 3]
    elbow: Tensor  # [H, 3]
    hand: Tensor  # [H, (frame, fk, ball, palm is free, swing, wrist), curl low, curl high]


def _cumulative(weights: list[list[float]]) -> Tensor:
    width = max(len(w) for w in weights)
    table = torch.tensor([w + [0.0] * (width - len(w)) for w in weights], dtype=torch.float64)
    return (table / table.sum(1, keepdim=True)).cumsum(1).float()


@lru_cache(maxsize=4)
def tables_on(device: str) -> Tables:
    styles, lowers = list(HANDS), list(LOWER)
    pairs: list[list[list[float]]] = []
    for row in ACTIVITY_TABLE.values():
        entries = row["hands"]
        pairs.append(
            [[styles.index(a), styles.index(b.rstrip("+")), float(b.endswith("+")), w] for a, b, w in entries]  # type: ignore[attr-defined]
        )
    width = max(len(p) for p in pairs)
    hands = torch.tensor([[e[:3] for e in p] + [[0.0, 0.0, 0.0]] * (width - len(p)) for p in pairs]).long()

    def span(row: dict[str, object], name: str, side: str = "") -> list[float]:
        value = row.get(f"{name}_{side}", row.get(name, LOWER_DEFAULT.get(name)))
        scale = _DEG if name in _IN_DEGREES else 1.0
        return [float(v) * scale for v in value]  # type: ignore[attr-defined]

    def trunk(row: dict[str, object], name: str) -> list[float]:
        value = row.get(name, TRUNK_DEFAULT[name])
        if name == "look":
            return [float(value), 0.0]  # type: ignore[arg-type]
        return [v * _DEG for v in value]  # type: ignore[attr-defined]

    box, palm, elbow, numbers = [], [], [], []
    for row in HANDS.values():
        place = row.get("ball", row.get("box", ((0, 0),) * 3))
        scale = (_DEG, _DEG, 1.0) if "ball" in row else (1.0, 1.0, 1.0)
        box.append([[v * s for v in r] for r, s in zip(place, scale, strict=True)])  # type: ignore[call-overload]
        palm.append(list(row.get("palm") or (0, 0, -1)))  # type: ignore[call-overload]
        elbow.append(list(row.get("elbow", (0.35, -0.7, -0.6))))  # type: ignore[call-overload]
        low, high = (float(v) * _DEG for v in row.get("curl", (0, 90)))  # type: ignore[attr-defined]
        numbers.append(
            [FRAMES.index(str(row.get("at", "level"))), float("fk" in row), float("ball" in row),
             float(row.get("palm") is None),
             float("swing" in row), float(row.get("wrist", 20)) * _DEG, low, high]  # type: ignore[arg-type]
        )  # fmt: skip
    tables = Tables(
        lower_choice=_cumulative([[float(row["lower"].get(s, 0)) for s in lowers] for row in ACTIVITY_TABLE.values()]),  # type: ignore[attr-defined]
        hands_choice=_cumulative([[e[3] for e in p] for p in pairs]),
        hands=hands,
        trunk=torch.tensor([[trunk(row, f) for f in TRUNK_FIELDS] for row in ACTIVITY_TABLE.values()]),
        pelvis=torch.tensor([[span(row, f) for f in PELVIS_FIELDS] for row in LOWER.values()]),  # type: ignore[arg-type]
        legs=torch.tensor([[[span(row, f, s) for f in LEG_FIELDS] for s in "ab"] for row in LOWER.values()]),  # type: ignore[arg-type]
        box=torch.tensor(box, dtype=torch.float32),
        palm=torch.tensor(palm, dtype=torch.float32),
        elbow=torch.tensor(elbow, dtype=torch.float32),
        hand=torch.tensor(numbers, dtype=torch.float32),
    )
    return Tables(**{f.name: getattr(tables, f.name).to(device) for f in fields(Tables)})


@lru_cache(maxsize=4)
def gait_cycles(device: str) -> Tensor:
    """[walk or run, 100 phases, (thigh forward, knee, toes down)] radians; phase 0 = the heel strikes."""
    knots = {  # degrees at 0, 10, ... 90 % of the cycle
        0: ((28, 24, 16, 6, -4, -12, -2, 18, 30, 32), (5, 17, 15, 8, 6, 20, 48, 60, 38, 10),
            (-18, 0, 0, 0, 4, 22, 58, 46, 12, -12)),
        1: ((38, 28, 8, -12, -24, -10, 18, 42, 56, 50), (22, 42, 36, 24, 30, 66, 100, 108, 80, 40),
            (-8, 0, 4, 24, 60, 80, 75, 55, 20, -5)),
    }  # fmt: skip
    phase = torch.arange(100) / 100
    order = torch.arange(10)
    basis = torch.exp(-(((phase[:, None] - order / 10 + 0.5) % 1 - 0.5) ** 2) / (2 * 0.055**2))
    basis = basis / basis.sum(1, keepdim=True)
    curves = torch.stack(
        [torch.stack([basis @ torch.tensor(c, dtype=torch.float32) for c in knots[k]], -1) for k in (0, 1)]
    )
    return (curves * _DEG).to(device)


@dataclass(frozen=True)
class Draws:
    """All that is random about postures: uniform numbers in [0, 1)."""

    activity: Tensor  # [n] indices
    choices: Tensor  # [n, len(CHOICES)]
    trunk: Tensor  # [n, T]
    pelvis: Tensor  # [n, tried, F]
    legs: Tensor  # [n, tried, 2, F]
    hands: Tensor  # [n, 2, tried, 12]

    def take(self, rows: Tensor) -> Draws:
        """Some rows only."""
        return Draws(*(getattr(self, f.name)[rows] for f in fields(self)))


_SHAPES: Final = (
    (len(CHOICES),), (len(TRUNK_FIELDS),), (LEGS_TRIED, len(PELVIS_FIELDS)), (LEGS_TRIED, 2, len(LEG_FIELDS)),
    (2, TRIED, 12),
)  # fmt: skip


def draw(activity: Tensor, generator: torch.Generator, device: str) -> Draws:
    """Uniform numbers for the given activities; the same generator state gives the same postures on every device."""
    sizes = [math.prod(s) for s in _SHAPES]
    u = torch.rand(len(activity), sum(sizes), generator=generator, device=generator.device).to(device)
    parts = [p.unflatten(1, s) for p, s in zip(u.split(sizes, 1), _SHAPES, strict=True)]
    return Draws(activity.to(device), *parts)
