"""The methods that the comparison knows, by name, made from whatever weights there are."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import understudy
from understudy.assets import cache_dir
from understudy.errors import UnderstudyError
from understudy.lifting import Lifter, NaiveLifter

OURS, NO_ASSEMBLY, PAPER_ASSEMBLY = "voxelposenet", "voxelposenet, no assembly", "voxelposenet, paper's assembly"

_COMMON = ("camera", "geometry", "lifting", "registration", "skeleton", "types")
_VOXELS = (
    "floor", "apparent_size", "standing", "roots", "voxels", "voxel_lifting", "assembly", "runtime",
    "voxelposenet/predictor",
)  # fmt: skip
_PAPER = ("voxelposenet/paper_grid", "voxelposenet/paper_net", "voxelposenet/paper_lifter")


@dataclass(frozen=True)
class Weights:
    """Files that methods are made from; None where the usual place is meant, or where there is none."""

    network: Path | None = None
    """exported (.onnx) or trained (.safetensors, or a run's folder); None: what comes with the package"""
    mlp: Path | None = None
    paper: Path | None = None
    paper_fast: Path | None = None


@dataclass(frozen=True)
class Method:
    """A method, ready to be made."""

    name: str
    make: Callable[[], Lifter]
    key: str
    """changes when its weights or its code change"""


def available(weights: Weights) -> tuple[dict[str, Method], list[str]]:
    """Methods by name, in the order of the tables; and a note for each that cannot be made."""
    found: dict[str, Method] = {}
    notes: list[str] = []
    for name, find in _REGISTRY.items():
        try:
            found[name] = find(name, weights)
        except (UnderstudyError, ImportError) as e:
            notes.append(f"{name}: left out. {e}")
    return found, notes


def of_network(name: str, weights: Path | None, assembly: str | None = None) -> Method:
    """The default method, perhaps with other weights or another assembly."""
    from understudy.voxel_lifting import VoxelLifter

    network = network_file(weights)
    options: dict[str, Any] = {} if assembly is None else {"assembly": assembly}
    return Method(name, lambda: VoxelLifter(weights=network, **options), fingerprint(_VOXELS, network))


def network_file(weights: Path | None) -> Path:
    """The exported file of a network: a trained one is exported into the cache first (needs torch)."""
    from understudy.voxelposenet.predictor import weights_path

    if weights is not None and weights.is_dir():
        weights = weights / "weights.safetensors"
    path = weights or weights_path()
    _require(path, "--weights FILE: an exported .onnx, a weights.safetensors, or the folder of a training run")
    if path.suffix != ".safetensors":
        return path
    exported = cache_dir() / "comparison" / "exported" / f"{_hash(path)}.onnx"
    if not exported.exists():
        from understudy.voxelposenet.checkpoint import load_net
        from understudy.voxelposenet.export import export_onnx

        export_onnx(load_net(path), exported)
    return exported


def fingerprint(code: Sequence[str], *files: Path) -> str:
    """Of a method's modules and weights."""
    root = Path(understudy.__file__).parent
    modules = [root / f"{m}.py" for m in (*_COMMON, *code)]
    return _hash(*(m for m in modules if m.exists()), *files)


def _hash(*files: Path) -> str:
    whole = hashlib.sha256()
    for path in files:
        whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:16]


def _require(path: Path, how: str) -> None:
    if not path.is_file():
        raise UnderstudyError(f"There is no file {path}. Give it with {how}")


def _naive(name: str, weights: Weights) -> Method:
    return Method(name, NaiveLifter, fingerprint(()))


def _naive_offset(name: str, weights: Weights) -> Method:
    from understudy.baselines import NaiveOffsetLifter

    return Method(name, NaiveOffsetLifter, fingerprint(("baselines",)))


def _mlp(name: str, weights: Weights) -> Method:
    from understudy.baselines import MlpLifter

    path = weights.mlp or cache_dir() / "comparison" / "mlp.safetensors"
    _require(path, f"--mlp FILE, or train it: python -m understudy.voxelposenet.mlp {path}")
    return Method(name, lambda: MlpLifter(path), fingerprint((*_VOXELS, "baselines"), path))


@dataclass(frozen=True)
class _Paper:
    which: str
    """field of Weights"""
    option: str

    def __call__(self, name: str, weights: Weights) -> Method:
        from understudy.voxelposenet.paper_lifter import PaperLifter

        path = getattr(weights, self.which)
        if path is None:
            raise UnderstudyError(f"No weights were given; with {self.option} FILE it is compared")
        _require(path, f"{self.option} FILE: the weights of `understudy train --preset` or `understudy weights import`")
        return Method(name, lambda: PaperLifter(path), fingerprint(_PAPER, path))


@dataclass(frozen=True)
class _Network:
    assembly: str | None
    """of assembly.ASSEMBLIES; None: the lifter's own choice"""

    def __call__(self, name: str, weights: Weights) -> Method:
        return of_network(name, weights.network, self.assembly)


_REGISTRY: Final = MappingProxyType[str, Callable[[str, Weights], Method]](
    {
        "naive": _naive,
        "naive-offset": _naive_offset,
        "mlp": _mlp,
        "paper-fast": _Paper("paper_fast", "--paper-fast"),
        "paper": _Paper("paper", "--paper"),
        OURS: _Network(None),
        NO_ASSEMBLY: _Network("network"),
        PAPER_ASSEMBLY: _Network("paper"),
    }
)
NAMES: Final = tuple(_REGISTRY)
NETWORK: Final = (OURS, NO_ASSEMBLY, PAPER_ASSEMBLY)
"""Variants of the default network."""
