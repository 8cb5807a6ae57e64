"""Names of a package that are imported when they are first asked for, because they need heavy optional packages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from typing import Any

from understudy.errors import MissingExtraError


def late_names(
    package: str, modules: Mapping[str, str], needed: Collection[str], feature: str, extra: str
) -> Callable[[str], Any]:
    """A package's `__getattr__`. modules: name -> the module below `package` that has it. needed: packages of `extra`;
    if one of them is absent, MissingExtraError names `feature` and `extra`.
    """

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(import_module(f"{package}.{modules[name]}"), name)
        except ModuleNotFoundError as e:
            if e.name in needed:
                raise MissingExtraError(feature, extra) from e
            raise

    return get
