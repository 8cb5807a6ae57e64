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
from understudy.files import read_json
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
    """also a run's folder"""
    paper_fast: Path | None = None


@dataclass(frozen=True)
class Method:
    """A method, ready to be made."""

    name: str
    make: Callable[[], Lifter]
    key: str
    """changes when its weights or its code change"""
    trained: str = ""
    """on what and how long, where its weights say so"""


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


def _mlp_trained(path: Path) -> str:
    from safetensors import safe_open

    with safe_open(str(path), "np") as f:
        words = f.metadata() or {}
    return f"{int(words['people']):,} simulated people" if "people" in words else ""


def _run_told(run: Path) -> str:
    """How long a run of `understudy train` took, and with what schedule; from its configuration and its log."""
    from understudy.voxelposenet import records
    from understudy.voxelposenet.training import CONFIG, read_config

    config, log = read_config(run / CONFIG), records.read(run / records.LOG)
    if not log:
        return ""
    steps, batch = int(log[-1]["step"]), config.batch * read_json(run / CONFIG).get("processes", 1)
    precision = "bfloat16" if config.bf16 else "float32"
    schedule = f", a tenth of it after every {config.decay_every:,} steps" if config.schedule == "steps" else ""
    return (
        f"{steps:,} steps of {batch} simulated people, {float(log[-1]['hours']):.1f} hours on {config.device} in "
        f"{precision}, learning rate {config.learning_rate:g}{schedule}"
    )


def _naive(name: str, weights: Weights) -> Method:
    return Method(name, NaiveLifter, fingerprint(()))


def _naive_offset(name: str, weights: Weights) -> Method:
    from understudy.baselines import NaiveOffsetLifter

    return Method(name, NaiveOffsetLifter, fingerprint(("baselines",)))


def _mlp(name: str, weights: Weights) -> Method:
    from understudy.baselines import MlpLifter

    path = weights.mlp or cache_dir() / "comparison" / "mlp.safetensors"
    _require(path, f"--mlp FILE, or train it: python -m understudy.voxelposenet.mlp {path}")
    return Method(name, lambda: MlpLifter(path), fingerprint((*_VOXELS, "baselines"), path), _mlp_trained(path))


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
        trained = ""
        if path.is_dir():
            trained = _run_told(path)
            path = path / "weights.safetensors"
        _require(path, f"{self.option} PATH: a run of `understudy train`, or what `understudy weights import` writes")
        return Method(name, lambda: PaperLifter(path), fingerprint(_PAPER, path), trained)


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
