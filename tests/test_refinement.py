"""The layers in which the joints look at each other: what they are told, that they begin as nothing and learn."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_voxel_net import TINY, people  # noqa: E402

from understudy.voxelposenet.kinds import _widened  # noqa: E402
from understudy.voxelposenet.net import VoxelPoseNet  # noqa: E402
from understudy.voxelposenet.refinement import TOLD, Refinement, told  # noqa: E402
from understudy.voxels import CELL, CELLS, EMPTY, HALF, PersonView  # noqa: E402


def rows(depth, keypoints, root_z, floor, mean):
    shape = mean.shape
    return told(mean, torch.full(shape, 0.05), torch.zeros(*shape[:2], 1), depth, keypoints, root_z, floor)


def places(b: int) -> torch.Tensor:
    return torch.rand(b, 18, 3, generator=torch.Generator().manual_seed(7)) * 1.6 - 0.8


def test_fresh_layers_correct_nothing():
    torch.manual_seed(0)
    without = VoxelPoseNet(replace(TINY, refinement=0)).eval()
    net = VoxelPoseNet(TINY).eval()
    net.load_state_dict(_widened(without.state_dict(), net.state_dict()))
    for a, b in zip(net(*people(3)), without(*people(3)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)


def test_what_a_joint_is_told_against_the_view():
    """Gaps, heights and surfaces, against points that are looked at one by one."""
    depth, keypoints, root_z, floor = people(4, seed=3)
    mean = places(4)
    said = rows(depth, keypoints, root_z, floor, mean)
    assert said.shape == (4, 18, TOLD) and torch.isfinite(said).all()
    gap, height, known = said[..., 11:13], said[..., 13], said[..., 14]
    behind, near, behind_keypoint, near_keypoint = said[..., 15:19].unbind(-1)
    assert not known[0].any() and not height[0].any() and known[1:].all()
    for i, j in np.ndindex(4, 18):
        view = PersonView(np.eye(3), float(root_z[i]))
        point = view.to_view_frame(mean[i, j][None].double().numpy())[0]
        if known[i, j]:
            expected = np.append(point, 1) @ floor[i].numpy()
            assert height[i, j] == pytest.approx(np.clip(expected, -1, 2.5), abs=1e-4)
        found = bool(keypoints[i, j, 2] > 0)
        expected = (keypoints[i, j, :2] - mean[i, j, :2]).clamp(-0.5, 0.5) / 0.1 * found
        torch.testing.assert_close(gap[i, j], expected)
        for xy, z, there, counts in (
            (mean[i, j, :2], behind, near, True),
            (keypoints[i, j, :2], behind_keypoint, near_keypoint, found),
        ):
            x, y = ((xy + HALF) / CELL).floor().clamp(0, CELLS - 1).long().tolist()
            surface = depth[i, 0, y, x]
            assert bool(there[i, j]) == (bool(surface < EMPTY / 2) and counts)
            if there[i, j]:
                assert z[i, j] == pytest.approx(float((surface - mean[i, j, 2]).clamp(-0.3, 0.3)) / 0.1, abs=1e-5)


def test_a_joint_that_was_not_found_says_nothing_by_its_place():
    depth, keypoints, root_z, floor = people(2)
    moved = torch.where(keypoints[..., 2:] == 0, torch.tensor([0.3, -0.4, 0.0]), keypoints)
    assert torch.equal(rows(depth, moved, root_z, floor, places(2)), rows(depth, keypoints, root_z, floor, places(2)))


def test_learns_where_a_joint_must_be_by_the_others():
    """A joint of which nothing is known, in the middle of two others, is found by looking at these."""
    torch.manual_seed(0)
    depth, keypoints, root_z, floor = (t.repeat(16, *[1] * (t.ndim - 1)) for t in people(4))
    layers = Refinement(0, 2)
    optimizer = torch.optim.Adam(layers.parameters(), lr=3e-3)
    errors = []
    for step in range(200):
        g = torch.Generator().manual_seed(step)
        truth = torch.rand(64, 18, 3, generator=g) * 1.2 - 0.6
        truth[:, 3] = (truth[:, 2] + truth[:, 4]) / 2
        mean = truth.clone()
        mean[:, 3] = 0
        correction, _ = layers(torch.zeros(64, 18, 0), rows(depth, keypoints, root_z, floor, mean))
        error = (mean + correction - truth).norm(dim=-1)
        optimizer.zero_grad()
        error[:, 3].mean().backward()
        optimizer.step()
        errors.append(error[:, 3].mean().item())
    assert errors[0] > 0.35 and np.mean(errors[-10:]) < 0.12, (errors[0], errors[-10:])
