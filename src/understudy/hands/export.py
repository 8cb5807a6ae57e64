"""HandNormalNet -> the file that the light runtime reads (torch, onnx)."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import torch

from understudy.hands.crop import CELLS, CONTEXT, PIXELS, UNSURE
from understudy.hands.net import COLOR_SIZE, HandNormalNet
from understudy.voxelposenet.export import write_onnx

INPUTS: Final = ("depth", "context", "distance", "color", "sigma", "image")
OUTPUTS: Final = ("normal", "direction", "log_kappa", "landmarks", "sure")


def export_onnx(net: HandNormalNet, path: Path) -> None:
    """Writes the network as ONNX, for any number of hands at once; weights in half precision, computed in float32."""
    joints, color = torch.rand(2, len(CONTEXT), 3), torch.rand(2, COLOR_SIZE)
    image = 255 * torch.rand(2, 3, PIXELS, PIXELS)
    example = (torch.rand(2, 2, CELLS, CELLS), joints, torch.ones(2, 1), color, torch.rand(2, len(UNSURE)), image)
    write_onnx(net, example, INPUTS, OUTPUTS, path)
