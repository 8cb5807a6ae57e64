"""The default network and its loss: cells and centres, gradients, what may and may not flow, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from understudy.voxelposenet.loss import WITHIN, _share, loss, metric_error  # noqa: E402
from understudy.voxelposenet.net import NetConfig, Output, VoxelPoseNet, _Features  # noqa: E402
from understudy.voxels import CELLS, EMPTY, HALF, PersonView  # noqa: E402

TINY = NetConfig(channels=(8, 8, 8), channels_2d=8, lifted=2)
STEP = 2 * HALF / 32  # metres: edge of a cell of the scores


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def net() -> VoxelPoseNet:
    torch.manual_seed(0)
    return VoxelPoseNet(TINY).eval()


def people(b: int, seed: int = 0):
    """Depth, keypoints, root_z, floor (of the first one: none) of nobody in particular."""
    g = torch.Generator().manual_seed(seed)
    depth = torch.rand(b, 2, CELLS, CELLS, generator=g) - 0.5
    depth = torch.where(torch.rand(b, 1, CELLS, CELLS, generator=g) < 0.2, EMPTY, depth)
    xy = torch.rand(b, 18, 2, generator=g) * 1.6 - 0.8
    keypoints = torch.cat([xy, torch.rand(b, 18, 1, generator=g)], -1)
    keypoints[:, ::5] = 0
    root_z = 2 + 2 * torch.rand(b, 1, generator=g)
    up = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, -0.3]) + 0.1 * torch.randn(b, 3, generator=g), dim=1)
    floor = torch.cat([up, 1 + torch.rand(b, 1, generator=g)], 1)
    floor[0] = 0
    return depth, keypoints, root_z, floor


def said(joints, spread=0.05) -> Output:
    return Output(joints, torch.full_like(joints, spread), torch.zeros_like(joints))


# --- cells ---


def test_shares_of_the_cells_reproduce_the_point(net):
    points = (torch.rand(5, 18, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1) * (HALF - STEP)
    share = _share(points, net.centers)
    assert share.shape == (5, 18, 32**3)
    assert (share >= 0).all() and torch.allclose(share.sum(-1), torch.ones(5, 18))
    torch.testing.assert_close(share @ net.centers, points, atol=1e-5, rtol=0)
    away = (net.centers - points[:, :, None]).abs().amax(-1)
    assert away[share > 0].max() <= STEP + 1e-6  # the nearest ones
    on = net.centers[[5, 777, 32767]].reshape(1, 3, 3).repeat(1, 6, 1)
    share = _share(on, net.centers)
    assert share.argmax(-1)[0, :3].tolist() == [5, 777, 32767] and share.amax(-1).min() > 0.99


def test_centres_fill_the_grid_once(net):
    cells = torch.round((net.centers + HALF) / STEP - 0.5).long()
    assert len(torch.unique(cells, dim=0)) == 32**3
    assert cells.min() == 0 and cells.max() == 31


def test_mean_of_a_sharp_distribution_is_its_cells_centre(net):
    inputs = people(1)
    logits = torch.zeros(1, 18, 8 * 4096)
    chosen = torch.arange(18) * 1777 + 13
    logits[0, torch.arange(18), chosen] = 60.0
    c16, c8, _ = TINY.channels
    features = _Features(torch.zeros(1, c16, 4096), torch.zeros(1, c8, 512), torch.zeros(1, 32, 4096))
    out = net._read(logits.softmax(-1), features, *inputs)
    torch.testing.assert_close(out.joints[0], net.centers[chosen], atol=1e-5, rtol=0)
    assert out.spread.max() < 2e-3
    flat = net._read(torch.full_like(logits, 1 / 32**3), features, *inputs)
    torch.testing.assert_close(flat.joints, torch.zeros(1, 18, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(flat.spread, torch.full((1, 18, 3), 2 * HALF / 12**0.5), atol=1e-3, rtol=0)


def test_the_volume_holds_the_surface_where_the_depth_is(net):
    """One column with one depth: its two neighbouring cells share an occupancy of 1, nowhere else is any."""
    depth = torch.full((1, 2, CELLS, CELLS), EMPTY)
    depth[0, :, 37, 22] = 0.2
    volume = net._volume(depth, torch.full((1, 1), 3.0), torch.zeros(1, 4), torch.zeros(1, 2, 16, 16, 16))[:, :64]
    cells = volume.reshape(1, 4, 4, 4, 16, 16, 16).permute(0, 4, 1, 5, 2, 6, 3).reshape(64, 64, 64)  # z, y, x
    place = cells.nonzero()
    assert set(map(tuple, place[:, 1:].tolist())) == {(37, 22)}
    assert cells.sum() == pytest.approx(1, abs=1e-5)
    z = (cells[:, 37, 22] * net.fine).sum()
    assert z == pytest.approx(0.2, abs=1e-5)


# --- loss ---


def test_errors_are_metric():
    view = PersonView.towards(np.array([0.7, -0.2, 2.4]))
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-0.7, 0.7, (2, 18, 3))
    expected = np.linalg.norm(view.to_cam(a) - view.to_cam(b), axis=1)
    root_z = torch.tensor([[view.root_z]])
    got = metric_error(torch.tensor(a)[None], torch.tensor(b)[None], root_z)[0]
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-12)


def test_gradients_against_finite_differences(net):
    """The distribution learns from `cell` and `distance`; the judge from `sigma`, `within`, `seen`."""
    g = torch.Generator().manual_seed(4)
    logits = torch.randn(1, 18, 8 * 4096, generator=g, dtype=torch.float64).requires_grad_()
    head = torch.randn(1, 18, 3, generator=g, dtype=torch.float64).requires_grad_()
    truth = torch.rand(1, 18, 3, generator=g, dtype=torch.float64) * 2.4 - 1.2
    truth[0, 3] = 1.5  # outside of the grid
    seen = torch.rand(1, 18, generator=g) < 0.5
    root_z = torch.full((1, 1), 2.5, dtype=torch.float64)

    def parts(logits, head):
        centers = net.centers.double()
        joints = logits.softmax(-1) @ centers
        total, out = loss(logits.log_softmax(-1), centers, Output(joints, joints.detach(), head), truth, root_z, seen)
        return total, out["cell"] + 6 * out["distance"], out["sigma"] + out["within"] + 0.5 * out["seen"]

    total, of_place, of_judge = parts(logits, head)
    assert total.item() == pytest.approx((of_place + of_judge).item())
    by_logits, by_head = torch.autograd.grad(total, (logits, head))
    step = 1e-5
    for _ in range(3):
        d = torch.randn(logits.shape, generator=g, dtype=torch.float64)
        slope = (parts(logits + step * d, head)[1] - parts(logits - step * d, head)[1]) / (2 * step)
        assert slope.item() == pytest.approx((by_logits * d).sum().item(), rel=1e-5)
        d = torch.randn(head.shape, generator=g, dtype=torch.float64)
        wide = 1e-2  # the judge's loss is counted in float32
        slope = (parts(logits, head + wide * d)[2] - parts(logits, head - wide * d)[2]) / (2 * wide)
        assert slope.item() == pytest.approx((by_head * d).sum().item(), rel=2e-2)
    assert by_logits[0, 3].abs().max() == 0  # a joint outside of the grid teaches the judge only
    assert by_head[0, 3].abs().min() > 0


def test_best_sigma_holds_the_share_of_errors_that_it_should():
    """The quantile loss is least where 68 % of the errors are smaller."""
    g = torch.Generator().manual_seed(5)
    truth, scores, centers = torch.zeros(20, 18, 3), torch.zeros(20, 18, 8), torch.zeros(8, 3)
    joints = 0.1 * torch.randn(20, 18, 3, generator=g)
    root_z, seen = torch.full((20, 1), 3.0), torch.zeros(20, 18, dtype=torch.bool)
    errors = metric_error(joints, truth, root_z).flatten()
    where = torch.quantile(errors, 0.68)

    def value(sigma) -> float:
        out = said(joints)
        out.head[..., 0] = sigma.log()
        return float(loss(scores, centers, out, truth, root_z, seen)[1]["sigma"])

    assert value(where) < min(value(where * 1.15), value(where / 1.15))
    assert WITHIN == 0.1


# --- what may flow ---


def test_the_judge_does_not_bend_what_it_judges():
    torch.manual_seed(1)
    net = VoxelPoseNet(TINY).train()
    net(*people(2)).head.square().sum().backward()
    for name, parameter in net.named_parameters():
        judges = name.startswith(("judge", "embedding", "features"))  # these it has for itself
        flows = parameter.grad is not None and bool((parameter.grad != 0).any())
        assert flows == judges, name


def test_people_do_not_depend_on_their_company(net):
    inputs = people(5, seed=2)
    order = torch.tensor([3, 0, 4, 2, 1])
    with torch.inference_mode():
        together = net(*inputs)
        permuted = net(*(t[order] for t in inputs))
        alone = net(*(t[2:3] for t in inputs))
    for a, b, c in zip(together, permuted, alone, strict=True):
        torch.testing.assert_close(a[order], b, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(a[2:3], c, atol=1e-5, rtol=1e-5)


def test_what_was_not_found_does_not_matter(net):
    """A keypoint of score 0 says nothing by its place."""
    depth, keypoints, *rest = people(2)
    moved = torch.where(keypoints[..., 2:] == 0, torch.tensor([0.3, -0.4, 0.0]), keypoints)
    with torch.inference_mode():
        torch.testing.assert_close(net(depth, moved, *rest), net(depth, keypoints, *rest), atol=1e-6, rtol=1e-6)


def test_where_the_floor_is(net):
    """Heights of the cells and depths of the columns, against points that are told from the plane one by one."""
    depth, _, root_z, floor = people(4, seed=3)
    lifted = torch.zeros(4, TINY.lifted, 16, 16, 16)
    fine, coarse, known = net._volume(depth, root_z, floor, lifted)[:, -3:].unbind(1)
    assert known[0].abs().max() == 0 == fine[0].abs().max() and (known[1:] == 1).all()
    rng = np.random.default_rng(0)
    for person in (1, 2, 3):
        view = PersonView(np.eye(3), float(root_z[person]))
        for z, y, x in rng.integers(16, size=(200, 3)):
            cell = net.coarse[[x, y, z]].numpy()
            height = float(np.append(view.to_view_frame(cell[None])[0], 1) @ floor[person].numpy())
            assert fine[person, z, y, x] == pytest.approx(np.clip(height / 0.25, -1, 1), abs=1e-4)
            assert coarse[person, z, y, x] == pytest.approx(np.clip(height / 1.5, -1, 1), abs=1e-4)
    away, meets = net._flat_input(depth, torch.zeros(4, 18, 3), root_z, floor)[:, -2:].unbind(1)
    assert not meets[0].any() and 0 < meets[1:].mean() < 1
    for person, row, column in meets.nonzero().tolist():
        xyz = torch.stack([net.fine[column], net.fine[row], away[person, row, column]])
        on_it = PersonView(np.eye(3), float(root_z[person])).to_view_frame(xyz.numpy()[None])[0]
        assert np.append(on_it, 1) @ floor[person].numpy() == pytest.approx(0, abs=1e-4)


def test_the_floor_may_be_left_out():
    net = VoxelPoseNet(replace(TINY, floor=False)).eval()
    depth, keypoints, root_z, floor = people(3)
    for a, b in zip(net(depth, keypoints, root_z, floor), net(depth, keypoints, root_z, 0 * floor), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize("refinement", [0, 2])
def test_sizes(inside, floor, refinement):
    out = VoxelPoseNet(NetConfig((8, 12, 16), 8, 3, inside, floor, refinement)).eval()(*people(3))
    assert out.joints.shape == out.spread.shape == out.head.shape == (3, 18, 3)
    assert all(torch.isfinite(t).all() for t in out)


def test_learns_eight_people_by_heart():
    from understudy.synthetic.bodies import capsule_bank
    from understudy.synthetic.samples import Samples

    batch = Samples(capsule_bank(2, seed=3, points=2000), seed=5).batch(0, 8)
    torch.manual_seed(0)
    net = VoxelPoseNet(NetConfig(channels=(8, 16, 32), channels_2d=16, lifted=4))
    gently = [p for name, p in net.named_parameters() if name.startswith("refinement")]
    rest = [p for name, p in net.named_parameters() if not name.startswith("refinement")]
    optimizer = torch.optim.Adam([{"params": rest}, {"params": gently, "lr": 2e-3}], lr=3e-2)
    errors = []
    for _ in range(18):
        scores, out = net.scores(batch.depth, batch.keypoints, batch.root_z, batch.floor)
        seen = batch.in_view & ~batch.occluded
        total, parts = loss(scores, net.centers, out, batch.joints, batch.root_z, seen)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        errors.append(parts["error"].item())
    assert errors[0] > 0.4 and errors[-1] < 0.22, errors
