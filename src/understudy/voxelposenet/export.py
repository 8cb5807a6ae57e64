"""Torch weights -> the exported file that the light runtime reads (torch, onnx)."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from understudy.files import write_atomically
from understudy.voxelposenet.net import VoxelPoseNet
from understudy.voxels import CELLS

INPUTS, OUTPUTS = ("depth", "keypoints", "root_z", "floor"), ("joints", "spread", "head")
_LARGE = 256  # numbers: what is stored in half precision


def export_onnx(net: VoxelPoseNet, path: Path, half: bool = True) -> None:
    """Writes the network as ONNX, for any number of people at once. half: see `write_onnx`."""
    floor = torch.tensor([[0.0, -1.0, 0.0, 1.5]]).expand(2, 4)
    example = (torch.rand(2, 2, CELLS, CELLS), torch.rand(2, 18, 3), torch.full((2, 1), 3.0), floor)
    inputs = INPUTS if net.config.floor else INPUTS[:-1]
    write_onnx(net, example, inputs, OUTPUTS, path, half)


def write_onnx(
    net: torch.nn.Module,
    example: tuple[torch.Tensor, ...],
    inputs: Sequence[str],
    outputs: Sequence[str],
    path: Path,
    half: bool = True,
) -> None:
    """Writes a network as ONNX; the first axis of every input and output may have any length.

    example: inputs. half: store the weights as float16 (half the size); runtimes compute in float32 all the same.
    """
    import onnx

    buffer: Any = io.BytesIO()  # the exporter's annotation knows paths only
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecation and tracing notes
        torch.onnx.export(
            net.eval(), example, buffer, input_names=list(inputs), output_names=list(outputs),
            dynamic_axes={name: {0: "rows"} for name in (*inputs, *outputs)}, dynamo=False, opset_version=17,
        )  # fmt: skip
    model = onnx.load_from_string(buffer.getvalue())
    if half:
        _halve(model.graph)
    onnx.checker.check_model(model)
    write_atomically(path, model.SerializeToString())


def _halve(graph: object) -> None:
    """Every large float32 constant becomes float16, followed by a cast back, which runtimes carry out when loading."""
    from onnx import TensorProto, helper, numpy_helper

    casts = []
    for tensor in graph.initializer:  # type: ignore[attr-defined]
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < _LARGE:
            continue
        name = tensor.name
        stored = numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float16), f"{name}.half")
        tensor.CopyFrom(stored)
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    for node in reversed(casts):
        graph.node.insert(0, node)  # type: ignore[attr-defined]
