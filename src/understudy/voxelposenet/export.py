"""Torch weights -> the exported file that the light runtime reads (torch, onnx)."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import torch

from understudy.files import write_atomically
from understudy.voxelposenet.net import VoxelPoseNet
from understudy.voxels import CELLS

INPUTS, OUTPUTS = ("depth", "keypoints", "root_z"), ("joints", "spread", "head")


def export_onnx(net: VoxelPoseNet, path: Path) -> None:
    """Writes the network as ONNX, for any number of people at once."""
    example = (torch.rand(2, 2, CELLS, CELLS), torch.rand(2, 18, 3), torch.full((2, 1), 3.0))
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecation and tracing notes
        torch.onnx.export(
            net.eval(), example, buffer, input_names=list(INPUTS), output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "people"} for name in (*INPUTS, *OUTPUTS)}, dynamo=False, opset_version=17,
        )  # fmt: skip
    write_atomically(path, buffer.getvalue())
