"""The methods of lifting, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Final

from understudy.errors import UnderstudyError, one_of
from understudy.lifting import Lifter, NaiveLifter
from understudy.voxel_lifting import VoxelLifter

DEFAULT: Final = "voxelposenet"
NAIVE: Final = "naive"

_LIFTERS: Final = MappingProxyType[str, Callable[[float, Path | None], Lifter]](
    {"voxelposenet": lambda score, weights: VoxelLifter(score, weights), NAIVE: lambda score, _: NaiveLifter(score)}
)
METHODS: Final = tuple(_LIFTERS)
"""Names: the voxel network, and the baseline it is measured against."""


def create(name: str, min_score: float = 0.2, weights: Path | None = None) -> Lifter:
    """The lifter of that name.

    min_score: least 2D score of a keypoint that is used. weights: an exported network (.onnx) in place of the one that
    comes with the package.
    """
    if name not in _LIFTERS:
        raise UnderstudyError(f"method {name!r}: must be {one_of(METHODS)}")
    if weights is not None and name != DEFAULT:
        raise UnderstudyError(f"weights {weights}: method {name!r} has none; they go with {DEFAULT!r}")
    return _LIFTERS[name](min_score, weights)
