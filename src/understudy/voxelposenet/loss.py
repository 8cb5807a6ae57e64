"""What the default network is trained to do, and how its errors are counted (torch)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.voxelposenet.net import COARSE, Output
from understudy.voxels import HALF

WITHIN = 0.10
"""metres: what confidence speaks of"""
COVERED = 0.68
"""share of errors that are smaller than sigma"""
_FINE = 2 * COARSE  # cells along an edge of the scores
_STEP = 2 * HALF / _FINE


def loss(
    scores: Float[Tensor, "b 18 cells"],
    centers: Float[Tensor, "cells 3"],
    output: Output,
    joints: Float[Tensor, "b 18 3"],
    root_z: Float[Tensor, "b 1"],
    seen: Bool[Tensor, "b 18"],
) -> tuple[Tensor, dict[str, Tensor]]:
    """One number to minimise, and its parts.

    Cross-entropy with the true cell (spread over the 8 nearest), plus the distance of the joint from the truth in
    metres; for the judge, the quantile loss that makes sigma hold 68 % of the errors, and cross-entropies of 'within
    10 cm' and 'seen'. Joints outside of the grid only teach the judge.
    """
    inside = (joints.abs() < HALF - 0.5 * _STEP).all(-1)
    weight = inside.float() / inside.sum().clamp_min(1)
    cell = -(scores * _share(joints, centers)).sum(-1)
    error = metric_error(output.joints, joints, root_z)
    distance = error.detach()
    judged = output.head.float()
    surprise = distance.clamp_min(1e-3).log() - judged[..., 0]
    parts = {
        "cell": (cell * weight).sum(),
        "distance": (error * weight).sum() / 0.1,
        "sigma": torch.maximum(COVERED * surprise, (COVERED - 1) * surprise).mean(),
        "within": F.binary_cross_entropy_with_logits(judged[..., 1], (distance < WITHIN).float()),
        "seen": F.binary_cross_entropy_with_logits(judged[..., 2], seen.float()),
    }
    total = parts["cell"] + 6.0 * parts["distance"] + parts["sigma"] + parts["within"] + 0.5 * parts["seen"]
    return total, {**parts, "error": (error * weight).sum()}


def metric_error(
    estimate: Float[Tensor, "b n 3"], truth: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b 1"]
) -> Tensor:
    """Euclidean distance in metres of two places in view coordinates; (b, n)."""
    return (to_metric(estimate, root_z) - to_metric(truth, root_z)).norm(dim=-1)


def to_metric(view: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b 1"]) -> Float[Tensor, "b n 3"]:
    """View coordinates -> the view's frame with its origin at the root."""
    scale = 1 + view[..., 2:] / root_z[:, None]
    return torch.cat([view[..., :2] * scale.clamp_min(0.1), view[..., 2:]], -1)


def _share(joints: Float[Tensor, "b 18 3"], centers: Float[Tensor, "cells 3"]) -> Float[Tensor, "b 18 cells"]:
    """Trilinear share of each cell in a joint: 1 in all, in the 8 cells around it."""
    rim = HALF - 0.5 * _STEP
    x, y, z = joints.clamp(-rim, rim)[..., None].unbind(2)
    cx, cy, cz = centers.T.contiguous()
    return _hat(cx - x) * _hat(cy - y) * _hat(cz - z)


def _hat(distance: Tensor) -> Tensor:
    return (1 - distance.abs() / _STEP).clamp_min(0)
