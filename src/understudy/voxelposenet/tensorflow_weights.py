"""Weights of the paper's network: the authors' TensorFlow variables, and our safetensors files of the same names.

A dictionary {TensorFlow variable name: float32 array in TensorFlow's layout} is the common form:
`VoxelPoseNet/conv1_1/weights` of shape [kx, ky, kz, in, out]; transposed convolutions [kx, ky, kz, out, in]; biases
[out]. numpy only; safetensors (files of ours) and TensorFlow (its checkpoints) are imported when they are needed.

What comes from elsewhere is data, not program: arrays are read without pickle; pickle files are read by an unpickler
that can build numbers, text, containers and arrays of numbers, and calls nothing of what the file names.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from understudy.errors import MissingExtraError, ModelFileError, UnderstudyError, one_of
from understudy.files import write_atomically
from understudy.skeleton import N_JOINTS
from understudy.voxelposenet.array_pickle import read_pickle

SCOPE: Final = "VoxelPoseNet"
"""first part of every variable's name"""
INPUT_CHANNELS: Final = 1 + N_JOINTS
"""occupancy and a score map per joint"""
CHANNELS: Final = (64, 128, 256)
"""of the three encoder blocks"""
VARIANTS: Final = MappingProxyType({"paper": (2, 2, 2), "paper-fast": (1, 1, 2)})
"""Variant -> convolutions per encoder block."""
FORMAT: Final = "understudy.paper_net/1"
"""in the metadata of our files"""

CONV, UPCONV = "conv", "upconv"
_OPTIMISER = re.compile(r"(^|/)(Adam(_\d+)?|ExponentialMovingAverage|global_step|beta[12]_power)$")
_LARGEST_FILE = 1 << 30  # bytes; the network has 53 MB, with the optimiser's state 160
_LISTED = 8  # names in an error message


@dataclass(frozen=True)
class Layer:
    """One layer with weights."""

    name: str
    kind: str
    """CONV or UPCONV (a transposed convolution)"""
    kernel: int
    """cells, along each axis"""
    stride: int
    """1 for convolutions; the enlargement of transposed ones"""
    inputs: int
    outputs: int

    def variables(self) -> dict[str, tuple[int, ...]]:
        """TensorFlow's names and shapes."""
        channels = (self.outputs, self.inputs) if self.kind == UPCONV else (self.inputs, self.outputs)
        return {
            f"{SCOPE}/{self.name}/weights": (self.kernel,) * 3 + channels,
            f"{SCOPE}/{self.name}/biases": (self.outputs,),
        }


def check_variant(variant: str) -> None:
    """Raises UnderstudyError unless there is such a variant."""
    if variant not in VARIANTS:
        raise UnderstudyError(f"variant {variant!r}: must be {one_of(VARIANTS)}")


def paper_layers(variant: str) -> tuple[Layer, ...]:
    """All layers with weights of a variant of the paper's network, in order."""
    check_variant(variant)
    layers = []
    inputs = INPUT_CHANNELS
    for block, (n, channels) in enumerate(zip(VARIANTS[variant], CHANNELS, strict=True), 1):
        for i in range(n):  # dense: the block's input and the block's earlier convolutions
            layers.append(Layer(f"conv{block}_{i + 1}", CONV, 3, 1, inputs + i * channels, channels))
        inputs = channels
    for level, (stride, channels) in enumerate(((8, CHANNELS[1]), (4, CHANNELS[0])), 1):
        layers += [
            Layer(f"det{level}", CONV, 1, 1, inputs, N_JOINTS),
            Layer(f"scorevolume{level}", UPCONV, 2 * stride, stride, N_JOINTS, N_JOINTS),
            Layer(f"upconv{level}", UPCONV, 4, 2, inputs, inputs),
            Layer(f"conv_decoder{level}", CONV, 3, 1, inputs + channels, channels),
        ]
        inputs = channels
    layers += [
        Layer("upconv_final", UPCONV, 4, 2, inputs, inputs),
        Layer("scorevolume_final", CONV, 1, 1, inputs, N_JOINTS),
    ]
    return tuple(layers)


def expected_shapes(variant: str) -> dict[str, tuple[int, ...]]:
    """Every variable of a variant: TensorFlow's name -> shape in TensorFlow's layout."""
    return {name: shape for layer in paper_layers(variant) for name, shape in layer.variables().items()}


# --- the authors' weights ---


def import_weights(source: Path, variant: str | None = None) -> dict[str, np.ndarray]:
    """The paper's weights from a file or folder, complete and of the right shapes: {variable: float32 array}.

    source: a folder of .npy files (`VoxelPoseNet/conv1_1/weights.npy`, or the `/` replaced by `.` or `__`); an .npz
    with the variables' names; a pickle (.pkl, .pickle) of a dictionary of arrays, also a nested one; or, where
    TensorFlow is installed, a checkpoint: its prefix, one of its files, or its folder (the newest one counts). The
    first part of the names, `VoxelPoseNet`, may be missing. What an optimiser has left is passed over.
    variant: None takes the one that has these variables.
    Raises ModelFileError that names the file, the variable, and the shapes.
    """
    if variant is not None:
        check_variant(variant)
    source = Path(source)
    found: dict[str, np.ndarray] = {}
    for name, array in _read(source).items():
        name = _variable_name(name)
        if _OPTIMISER.search(name):
            continue
        if name in found:
            raise ModelFileError(f"{source}: variable {name!r} is there twice")
        found[name] = array
    return checked(found, variant or guess_variant(found), str(source))


def guess_variant(names: Mapping[str, object]) -> str:
    """`paper` where a second convolution of block 1 or 2 is present, else `paper-fast`."""
    second = (f"{SCOPE}/conv{block}_2/{part}" for block in (1, 2) for part in ("weights", "biases"))
    return "paper" if any(name in names for name in second) else "paper-fast"


def checked(weights: Mapping[str, np.ndarray], variant: str, where: str) -> dict[str, np.ndarray]:
    """The weights as float32 in the order of the network. Raises ModelFileError that begins with `where`."""
    shapes = expected_shapes(variant)
    wrong = []
    missing, unexpected = [n for n in shapes if n not in weights], [n for n in weights if n not in shapes]
    if missing:
        wrong.append(f"missing variables: {_listed(missing)}")
    if unexpected:
        wrong.append(f"unexpected variables: {_listed(unexpected)}")
    for name, shape in shapes.items():
        array = weights.get(name)
        if array is None:
            continue
        if array.shape != shape:
            wrong.append(f"variable {name!r}: expected shape {list(shape)}, found {list(array.shape)}")
        elif array.dtype.kind != "f":
            wrong.append(f"variable {name!r}: expected floating-point numbers, found {array.dtype}")
        elif not np.isfinite(array).all():
            wrong.append(f"variable {name!r}: holds NaN or infinite values")
    if wrong:
        more = [f"and {len(wrong) - _LISTED} more"] if len(wrong) > _LISTED else []
        raise ModelFileError(f"{where}: not the weights of variant {variant!r}: " + "; ".join(wrong[:_LISTED] + more))
    return {name: np.ascontiguousarray(weights[name], dtype=np.float32) for name in shapes}


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(repr(n) for n in names[:_LISTED]) + more


def _variable_name(name: str) -> str:
    """`VoxelPoseNet/conv1_1/weights` from what a file calls it."""
    name = name.removesuffix(":0").replace("__", "/").replace(".", "/").strip("/")
    return name if name.startswith(f"{SCOPE}/") else f"{SCOPE}/{name}"


def _read(source: Path) -> dict[str, np.ndarray]:
    """All arrays of a source by the names that they have there."""
    if source.is_dir():
        files = sorted(source.rglob("*.npy"))
        if files:
            return {str(f.relative_to(source).with_suffix("").as_posix()): _load_numpy(f) for f in files}
        return _read_checkpoint(_checkpoint_in(source))
    suffix = source.suffix.lower()
    if suffix in (".npz", ".pkl", ".pickle"):
        if not source.is_file():
            raise ModelFileError(f"{source}: no such file")
        if source.stat().st_size > _LARGEST_FILE:
            raise ModelFileError(f"{source}: {source.stat().st_size} bytes are too many for this network")
        return _load_numpy(source) if suffix == ".npz" else read_pickle(source)
    prefix = Path(re.sub(r"\.(index|meta|data-\d{5}-of-\d{5})$", "", str(source)))
    if prefix.is_file() or Path(f"{prefix}.index").is_file():
        return _read_checkpoint(prefix)
    raise ModelFileError(
        f"{source}: no such weights; expected a folder of .npy files, an .npz, a .pkl, or a TensorFlow checkpoint"
    )


def _load_numpy(path: Path) -> Any:
    """The array of an .npy, or the dictionary of an .npz. Never by pickle."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except (OSError, ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile) as e:
        raise ModelFileError(f"{path}: not readable as numpy arrays of numbers: {e}") from e


# --- TensorFlow checkpoints ---


def _checkpoint_in(folder: Path) -> Path:
    """The prefix of the newest checkpoint (largest number at the end of its name) in a folder."""
    prefixes = [p.with_suffix("") for p in folder.glob("*.index")] or [p.with_suffix("") for p in folder.glob("*.meta")]
    if not prefixes:
        raise ModelFileError(f"{folder}: holds neither .npy files nor a TensorFlow checkpoint (.index, .meta)")

    def step(prefix: Path) -> tuple[int, str]:
        number = re.search(r"(\d+)$", prefix.name)
        return (int(number[1]) if number else -1, prefix.name)

    return max(prefixes, key=step)


def _read_checkpoint(prefix: Path) -> dict[str, np.ndarray]:
    try:
        import tensorflow
    except ImportError as e:
        convert = (
            f"import numpy, tensorflow; r = tensorflow.train.load_checkpoint('{prefix.name}'); "
            f"names = [n for n in r.get_variable_to_shape_map() if n.startswith('{SCOPE}/')]; "
            "numpy.savez('weights.npz', **{n: r.get_tensor(n) for n in names})"
        )
        raise ModelFileError(
            f"{prefix}: reading a TensorFlow checkpoint needs TensorFlow, which is not installed. Either `pip install "
            f'tensorflow`, or make an .npz where it is installed and import that: python -c "{convert}"'
        ) from e
    try:
        reader = tensorflow.train.load_checkpoint(str(prefix))
        return {name: np.asarray(reader.get_tensor(name)) for name in reader.get_variable_to_shape_map()}
    except Exception as e:  # TensorFlow's errors have no common base
        raise ModelFileError(f"{prefix}: not readable as a TensorFlow checkpoint: {e}") from e


# --- our files ---


def save_paper_weights(
    weights: Mapping[str, np.ndarray], path: Path, metadata: Mapping[str, str] | None = None
) -> None:
    """Writes weights (as `import_weights` gives them) as safetensors, whole or not at all.

    metadata: words about them (source, licence, training) that are kept in the file; `format` and `variant` are set.
    """
    try:
        from safetensors.numpy import save
    except ImportError as e:
        raise MissingExtraError("weights in safetensors", "train") from e
    variant = guess_variant(weights)
    complete = checked(weights, variant, str(path))
    words = {key: str(value) for key, value in (metadata or {}).items()}
    write_atomically(Path(path), save(complete, {**words, "format": FORMAT, "variant": variant}))


def read_paper_weights(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Weights and metadata (`variant` among them) of a file of `save_paper_weights`, checked."""
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as e:
        raise MissingExtraError("weights in safetensors", "train") from e
    path = Path(path)
    if not path.is_file():
        raise ModelFileError(f"{path}: no such file")
    try:
        with safe_open(str(path), framework="numpy") as f:
            metadata = f.metadata() or {}
            found = metadata.get("format")
            if found != FORMAT:
                raise ModelFileError(
                    f"{path}: metadata 'format' must be {FORMAT!r} (the paper's network), got {found!r}"
                )
            weights = {name: f.get_tensor(name) for name in f.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError, ValueError) as e:
        if isinstance(e, ModelFileError):
            raise
        raise ModelFileError(f"{path}: not readable as safetensors: {e}") from e
    variant = metadata.get("variant", "")
    if variant not in VARIANTS:
        raise ModelFileError(f"{path}: metadata 'variant' is {variant!r}: must be {one_of(VARIANTS)}")
    return checked(weights, variant, str(path)), metadata
