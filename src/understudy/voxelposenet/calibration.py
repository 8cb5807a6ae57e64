"""Sigma and confidence put right on people that the training never saw (torch).

Two straight lines, log sigma -> log sigma and logit -> logit, fitted on held-out simulation and then folded into the
network's last layer, so that the exported network needs no further step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize

from understudy.voxelposenet.loss import COVERED, WITHIN
from understudy.voxelposenet.net import VoxelPoseNet

_LEAST = 1e-3  # metres: smaller errors are all the same


@dataclass(frozen=True)
class Correction:
    """new = offset + slope * old."""

    sigma: tuple[float, float]
    """offset and slope of log sigma (sigma in metres)"""
    confidence: tuple[float, float]
    """offset and slope of the logit"""


def fit(
    error: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"], confidence: Float[np.ndarray, " n"]
) -> Correction:
    """The lines that make sigma hold 68 % of the errors (metres) and confidence the share within 10 cm.

    sigma by quantile regression, confidence by logistic regression.
    """
    log_error, log_sigma = np.log(np.maximum(error, _LEAST)), np.log(sigma)
    p = np.clip(confidence, 1e-6, 1 - 1e-6)
    logit, right = np.log(p / (1 - p)), (error < WITHIN).astype(float)

    def pinball(line: np.ndarray) -> float:
        gap = log_error - line[0] - line[1] * log_sigma
        return float(np.maximum(COVERED * gap, (COVERED - 1) * gap).mean())

    def surprise(line: np.ndarray) -> float:
        z = line[0] + line[1] * logit
        return float((np.logaddexp(0, z) - right * z).mean())

    start = np.array([0.0, 1.0])
    s = minimize(pinball, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7}).x
    c = minimize(surprise, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-7}).x
    return Correction((float(s[0]), float(s[1])), (float(c[0]), float(c[1])))


@torch.no_grad()
def apply(net: VoxelPoseNet, correction: Correction) -> None:
    """Folds the correction into the last layer of the network's judge."""
    last = net.judge[-1]
    assert isinstance(last, torch.nn.Linear)
    for row, (offset, slope) in ((0, correction.sigma), (1, correction.confidence)):
        last.weight[row] *= slope
        last.bias[row] = offset + slope * last.bias[row]
