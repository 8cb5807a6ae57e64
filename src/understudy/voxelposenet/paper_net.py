"""The paper's VoxelPoseNet in PyTorch, as published: variants `paper` and `paper-fast`.

The paper: Zimmermann et al., 3D Human Pose Estimation in RGBD Images for Robotic Task Learning, ICRA 2018.

For comparison and for the authors' weights; the network that is used by default is another one. Only code for training,
benchmarks and `PaperLifter` imports this module: it needs torch.

Layout here is [batch, channel, x, y, z], axes of the colour camera's frame (x right, y down, z forward); the authors'
is [batch, x, y, z, channel]. The z axis of the volumes is the fastest in memory in both.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import nn
from torch.nn import functional as F

from understudy.voxelposenet.tensorflow_weights import (
    SCOPE,
    UPCONV,
    VARIANTS,
    Layer,
    checked,
    paper_layers,
    read_paper_weights,
)

NEGATIVE_SLOPE: Final = 0.01
"""of the leaky ReLU"""
TARGET_WIDTH: Final = 3.0
"""Cells: the training target of a joint is exp(-d^2 / TARGET_WIDTH^2) at d cells from the truth.

The paper gives the height, 1, but not the width: the input's score maps have this one (standard deviation
3 / sqrt 2 = 2.1 cells = 8.8 cm).
"""

_FROM_TENSORFLOW = (4, 3, 0, 1, 2)  # [k, k, k, in, out] -> torch's [out, in, k, k, k], and likewise transposed ones
_TO_TENSORFLOW = (2, 3, 4, 1, 0)


class PaperNet(nn.ModuleDict):
    """Occupancy and score maps -> three score volumes: an encoder with dense blocks, a decoder with skip connections.

    The state has the names of the TensorFlow variables: `conv1_1.weight` is `VoxelPoseNet/conv1_1/weights`,
    `conv1_1.bias` is `VoxelPoseNet/conv1_1/biases`. TensorFlow's SAME padding is symmetric here: 1 cell for 3^3
    convolutions; for transposed ones of kernel 2 s and stride s, s / 2 cells are cut off at either end.
    """

    def __init__(self, variant: str):
        """variant: "paper" (13 266 522 parameters) or "paper-fast" (12 459 354)."""
        super().__init__({layer.name: _module(layer) for layer in paper_layers(variant)})
        self.variant = variant

    def forward(
        self, x: Float[torch.Tensor, "b 19 x y z"]
    ) -> tuple[Float[torch.Tensor, "b 18 x y z"], Float[torch.Tensor, "b 18 x y z"], Float[torch.Tensor, "b 18 x y z"]]:
        """The score volumes: running sums, coarse to fine; the last is the result.

        x, y, z: any multiples of 8; the paper's are 64.
        """
        skips = []
        for block, n in enumerate(VARIANTS[self.variant], 1):
            seen = [x]
            for i in range(n):
                seen.append(self._convolve(f"conv{block}_{i + 1}", seen))
            x = F.max_pool3d(seen[-1], 2)
            skips.append(x)
        coarse = self["scorevolume1"](self["det1"](x))
        x = self._convolve("conv_decoder1", [self["upconv1"](x), skips[1]])
        middle = coarse + self["scorevolume2"](self["det2"](x))
        x = self._convolve("conv_decoder2", [self["upconv2"](x), skips[0]])
        fine = middle + self["scorevolume_final"](self["upconv_final"](x))
        return coarse, middle, fine

    def _convolve(self, name: str, inputs: list[torch.Tensor]) -> torch.Tensor:
        joined = inputs[0] if len(inputs) == 1 else torch.cat(inputs, 1)
        return F.leaky_relu(self[name](joined), NEGATIVE_SLOPE, inplace=True)

    def variables(self) -> dict[str, np.ndarray]:
        """The weights under TensorFlow's names, in its layout: what `save_paper_weights` takes."""
        out = {}
        for name, tensor in self.state_dict().items():
            layer, part = name.rsplit(".", 1)
            array = tensor.detach().float().cpu().numpy()
            if part == "weight":
                out[f"{SCOPE}/{layer}/weights"] = np.ascontiguousarray(array.transpose(_TO_TENSORFLOW))
            else:
                out[f"{SCOPE}/{layer}/biases"] = array.copy()
        return out

    def load_variables(self, weights: Mapping[str, np.ndarray], where: str = "weights") -> None:
        """Takes weights under TensorFlow's names. Raises ModelFileError that begins with `where` unless all fit."""
        state = {}
        for name, array in checked(weights, self.variant, where).items():
            _, layer, part = name.split("/")
            if part == "weights":
                state[f"{layer}.weight"] = torch.from_numpy(np.ascontiguousarray(array.transpose(_FROM_TENSORFLOW)))
            else:
                state[f"{layer}.bias"] = torch.from_numpy(array.copy())
        self.load_state_dict(state)


def _module(layer: Layer) -> nn.Module:
    """A layer with the authors' initial weights: uniform with the variance 2 / (fan in + fan out), biases 0.0001;
    transposed convolutions begin as trilinear enlargement of each channel.
    """
    if layer.kind == UPCONV:
        cut = (layer.kernel - layer.stride) // 2  # TensorFlow's SAME: the rest, kernel - stride - cut, is equal here
        up = nn.ConvTranspose3d(layer.inputs, layer.outputs, layer.kernel, layer.stride, padding=cut)
        half = layer.kernel / 2
        hat = 1 - (torch.arange(layer.kernel) - (half - 0.5)).abs() / half
        with torch.no_grad():
            up.weight.zero_()
            index = torch.arange(layer.inputs)
            up.weight[index, index] = torch.einsum("x,y,z->xyz", hat, hat, hat)
            assert up.bias is not None
            up.bias.zero_()
        return up
    conv = nn.Conv3d(layer.inputs, layer.outputs, layer.kernel, padding=layer.kernel // 2)
    nn.init.xavier_uniform_(conv.weight)
    assert conv.bias is not None
    nn.init.constant_(conv.bias, 1e-4)
    return conv


def target_volumes(
    index: Float[torch.Tensor, "b 18 3"], size: tuple[int, int, int], width: float = TARGET_WIDTH
) -> Float[torch.Tensor, "b 18 x y z"]:
    """Gaussians of height 1, exp(-d^2 / width^2), about the joints.

    index: where the joints are, in cells: `PaperGrid.index` of the truth (integers are cell centres); NaN gives zeros.
    """
    line = []
    for axis, n in enumerate(size):
        d = torch.arange(n, dtype=index.dtype, device=index.device) - index[..., axis, None]
        line.append(torch.exp(-((d / width) ** 2)).nan_to_num(nan=0.0))
    return line[0][..., :, None, None] * line[1][..., None, :, None] * line[2][..., None, None, :]


def paper_loss(
    volumes: tuple[Float[torch.Tensor, "b 18 x y z"], ...],
    index: Float[torch.Tensor, "b 18 3"],
    width: float = TARGET_WIDTH,
) -> Float[torch.Tensor, ""]:
    """The paper's loss: squared L2 distance of each score volume to the Gaussians about the truth, summed over the
    volumes (and joints and cells), mean over the batch.

    index: the true joints in cells (`PaperGrid.index`); a joint whose row holds NaN is left out.
    """
    x, y, z = volumes[0].shape[2:]
    target = target_volumes(index, (x, y, z), width)
    known = torch.isfinite(index).all(-1)[..., None, None, None]
    total = torch.stack([((volume - target).square() * known).sum() for volume in volumes]).sum()
    return total / len(index)


def load_paper_net(path: Path) -> PaperNet:
    """The network with the weights of a file of `save_paper_weights`, in evaluation mode. Raises ModelFileError."""
    weights, metadata = read_paper_weights(path)
    net = PaperNet(metadata["variant"])
    net.load_variables(weights, str(path))
    return net.eval()


def score_volume(
    net: PaperNet, x: Float32[np.ndarray, "size size size 19"]
) -> Float32[np.ndarray, "18 size size size"]:
    """One person's input (`paper_grid.network_input`, the authors' axes) -> the last score volume [joint, x, y, z]."""
    with torch.inference_mode():
        batch = torch.from_numpy(np.ascontiguousarray(x.transpose(3, 0, 1, 2)))[None]
        return net(batch)[-1][0].numpy()
