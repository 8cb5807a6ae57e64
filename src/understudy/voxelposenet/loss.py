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
    logits: Float[Tensor, "b 18 8 4096"],
    output: Output,
    joints: Float[Tensor, "b 18 3"],
    root_z: Float[Tensor, "b 1"],
    seen: Bool[Tensor, "b 18"],
) -> tuple[Tensor, dict[str, Tensor]]:
    """One number to minimise, and its parts.

    Cross-entropy with the true cell (spread over the 8 nearest), plus the L1 distance of the mean from the truth in
    metres; for the judge, the quantile loss that makes sigma hold 68 % of the errors, and cross-entropies of 'within
    10 cm' and 'seen'. Joints outside of the grid only teach the judge.
    """
    inside = (joints.abs() < HALF - 0.5 * _STEP).all(-1)
    weight = inside.float() / inside.sum().clamp_min(1)
    index, share = _cells(joints)
    flat = logits.reshape(*logits.shape[:2], -1)
    cell = flat.logsumexp(-1) - (flat.gather(2, index) * share).sum(-1)
    error = metric_error(output.joints, joints, root_z)
    where = _distance(output.joints, joints, root_z)
    distance = error.detach()
    judged = output.head.float()
    surprise = distance.clamp_min(1e-3).log() - judged[..., 0]
    parts = {
        "cell": (cell * weight).sum(),
        "distance": (where * weight).sum() / 0.1,
        "sigma": torch.maximum(COVERED * surprise, (COVERED - 1) * surprise).mean(),
        "within": F.binary_cross_entropy_with_logits(judged[..., 1], (distance < WITHIN).float()),
        "seen": F.binary_cross_entropy_with_logits(judged[..., 2], seen.float()),
    }
    total = parts["cell"] + 2.0 * parts["distance"] + parts["sigma"] + parts["within"] + 0.5 * parts["seen"]
    return total, {**parts, "error": (error * weight).sum()}


def metric_error(
    estimate: Float[Tensor, "b n 3"], truth: Float[Tensor, "b n 3"], root_z: Float[Tensor, "b 1"]
) -> Tensor:
    """Euclidean distance in metres of two places in view coordinates; (b, n)."""
    return (_metric(estimate, root_z) - _metric(truth, root_z)).norm(dim=-1)


def _distance(estimate: Tensor, truth: Tensor, root_z: Tensor) -> Tensor:
    """L1 distance in metres, per joint."""
    return (_metric(estimate, root_z) - _metric(truth, root_z)).abs().sum(-1)


def _metric(view: Tensor, root_z: Tensor) -> Tensor:
    """View coordinates -> the view's frame with its origin at the root."""
    scale = 1 + view[..., 2:] / root_z[:, None]
    return torch.cat([view[..., :2] * scale.clamp_min(0.1), view[..., 2:]], -1)


def _cells(joints: Float[Tensor, "b 18 3"]) -> tuple[Tensor, Tensor]:
    """Index (in the order of the logits) and trilinear share of the 8 cells around each joint; (b, 18, 8) both."""
    place = ((joints + HALF) / _STEP - 0.5).clamp(0, _FINE - 1.001)
    low = place.floor()
    part = place - low
    corner = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], device=joints.device)
    cell = low.long()[:, :, None] + corner  # x, y, z
    share = torch.where(corner.bool(), part[:, :, None], 1 - part[:, :, None]).prod(-1)
    x, y, z = cell.unbind(-1)
    sub = (z % 2) * 4 + (y % 2) * 2 + x % 2
    index = ((sub * COARSE + z // 2) * COARSE + y // 2) * COARSE + x // 2
    return index, share
