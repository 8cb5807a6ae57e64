"""`understudy weights`: files of trained networks."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from understudy.cli.common import command, needs_extra
from understudy.errors import ModelFileError, UnderstudyError, one_of
from understudy.files import read_json


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "weights",
        "export, import or describe the weights of a network",
        "  understudy weights export runs/first --out weights\n"
        "  understudy weights import authors_checkpoint/ paper.safetensors --variant paper\n"
        "  understudy weights info weights/voxelposenet.safetensors",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    export = actions.add_parser("export", help="make the files for use from a training run, with a model card")
    export.add_argument("source", type=Path, metavar="RUN", help="folder of `understudy train`")
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    export.set_defaults(run=_export)

    take = actions.add_parser("import", help="take the paper's authors' weights over into a file of ours")
    take.add_argument(
        "source",
        type=Path,
        metavar="SRC",
        help="TensorFlow checkpoint, folder of .npy, .npz, or .pkl",
    )
    take.add_argument("target", type=Path, metavar="DST", help="file to write, .safetensors")
    take.add_argument("--variant", metavar="NAME", help="paper or paper-fast (default: whichever the variables are of)")
    take.set_defaults(run=_import)

    info = actions.add_parser("info", help="say what a file of weights holds")
    info.add_argument("file", type=Path, metavar="FILE", help=".safetensors or .onnx")
    info.set_defaults(run=_info)


def _export(arguments: argparse.Namespace) -> None:
    with needs_extra("exporting weights", "train"):
        from understudy.hands.publish import publish as publish_hands
        from understudy.voxelposenet.publish import publish
    path = arguments.source / "config.json"
    of_hands = path.exists() and read_json(path).get("kind") == "hands"
    made = publish_hands if of_hands else publish
    for path in made(arguments.source, arguments.out, progress=True):
        print(f"  {path}")


def _import(arguments: argparse.Namespace) -> None:
    with needs_extra("weights in safetensors", "train"):
        import safetensors  # noqa: F401
    from understudy.voxelposenet.tensorflow_weights import (
        VARIANTS,
        guess_variant,
        import_weights,
        save_paper_weights,
    )

    if arguments.target.suffix != ".safetensors":
        raise UnderstudyError(f"{arguments.target}: the name must end in .safetensors")
    if arguments.variant is not None and arguments.variant not in VARIANTS:
        raise UnderstudyError(f"--variant {arguments.variant!r}: must be {one_of(VARIANTS)}")
    found = import_weights(arguments.source, arguments.variant)
    save_paper_weights(found, arguments.target, {"source": str(arguments.source)})
    numbers = sum(array.size for array in found.values())
    print(f"variant {guess_variant(found)}: {len(found)} variables, {numbers:,} parameters\n  {arguments.target}")


def _info(arguments: argparse.Namespace) -> None:
    path = arguments.file
    if path.suffix == ".onnx":
        from understudy import runtime

        network = runtime.load(path)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        print(f"inputs      {', '.join(network.inputs)}\noutputs     {', '.join(network.outputs)}")
        return
    with needs_extra("weights in safetensors", "train"):
        from safetensors import SafetensorError, safe_open
    try:
        with safe_open(str(path), "numpy") as f:
            words = f.metadata() or {}
            sizes = [math.prod(f.get_slice(name).get_shape()) for name in f.keys()]  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as e:
        raise ModelFileError(f"{path}: not a readable safetensors file: {e}") from e
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {len(sizes)} tensors, {sum(sizes):,} numbers")
    for name, word in sorted(words.items(), key=lambda item: (item[0] != "format", item[0])):
        print(f"{name:11} {word}")
