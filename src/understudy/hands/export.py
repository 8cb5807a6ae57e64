"""HandNormalNet -> the file that the light runtime reads (torch, onnx)."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any, Final

import torch

from understudy.files import write_atomically
from understudy.hands.crop import CELLS, CONTEXT
from understudy.hands.net import COLOR_SIZE, HandNormalNet
from understudy.voxelposenet.export import halve

INPUTS: Final = ("depth", "context", "distance", "color")
OUTPUTS: Final = ("normal", "direction", "log_kappa", "landmarks", "sure")


def export_onnx(net: HandNormalNet, path: Path) -> None:
    """Writes the network as ONNX, for any number of hands at once; weights in half precision, computed in float32."""
    import onnx

    example = (
        torch.rand(2, 2, CELLS, CELLS),
        torch.rand(2, len(CONTEXT), 3),
        torch.ones(2, 1),
        torch.rand(2, COLOR_SIZE),
    )
    buffer: Any = io.BytesIO()  # the exporter's annotation knows paths only
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecation and tracing notes
        torch.onnx.export(
            net.eval(), example, buffer, input_names=list(INPUTS), output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "hands"} for name in (*INPUTS, *OUTPUTS)}, dynamo=False, opset_version=17,
        )  # fmt: skip
    model = onnx.load_from_string(buffer.getvalue())
    halve(model.graph)
    onnx.checker.check_model(model)
    write_atomically(path, model.SerializeToString())
