"""Sigma and confidence put right."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from understudy.voxelposenet.calibration import Correction, apply, fit  # noqa: E402
from understudy.voxelposenet.net import NetConfig, VoxelPoseNet  # noqa: E402
from understudy.voxelposenet.validation import calibration_error  # noqa: E402


def test_sigma_of_a_boaster_becomes_honest():
    """Errors are 2.5 times what sigma says."""
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.normal(np.log(0.05), 0.6, 20_000))
    error = np.abs(rng.normal(size=sigma.size)) * 2.5 * sigma
    offset, slope = fit(error, sigma, np.full(sigma.size, 0.5)).sigma
    right = np.exp(offset + slope * np.log(sigma))
    for low, high in ((0, 0.03), (0.03, 0.07), (0.07, 1), (0, 1)):  # at every size
        some = (sigma > low) & (sigma < high)
        assert (error < right)[some].mean() == pytest.approx(0.68, abs=0.03)


def test_confidence_of_a_boaster_becomes_honest():
    rng = np.random.default_rng(1)
    logit = rng.normal(0.5, 1.5, 20_000)
    error = np.where(rng.uniform(size=logit.size) < 1 / (1 + np.exp(-logit)), 0.05, 0.2)
    boast = 1 / (1 + np.exp(-(2 * logit + 1.5)))
    offset, slope = fit(error, np.full(logit.size, 0.1), boast).confidence
    assert slope == pytest.approx(0.5, abs=0.03) and offset == pytest.approx(-0.75, abs=0.06)
    honest = 1 / (1 + np.exp(-(offset + slope * (2 * logit + 1.5))))
    assert calibration_error(honest, error < 0.1) < 0.02 < 0.1 < calibration_error(boast, error < 0.1)


def test_the_correction_is_folded_into_the_network():
    torch.manual_seed(0)
    net = VoxelPoseNet(NetConfig(channels=(8, 8, 8), channels_2d=8, lifted=2)).eval()
    given = torch.rand(2, 2, 64, 64) - 0.5, torch.rand(2, 18, 3) - 0.3, torch.full((2, 1), 3.0), torch.zeros(2, 4)
    with torch.inference_mode():
        before = net(*given)
        apply(net, Correction((0.3, 0.8), (-0.5, 1.7)))
        after = net(*given)
    torch.testing.assert_close(after.joints, before.joints)
    torch.testing.assert_close(after.head[..., 0], 0.3 + 0.8 * before.head[..., 0])
    torch.testing.assert_close(after.head[..., 1], -0.5 + 1.7 * before.head[..., 1])
    torch.testing.assert_close(after.head[..., 2], before.head[..., 2])
