"""Muon on kernels: what it does to matrices, whatever their layout; who goes to AdamW."""

from copy import deepcopy

import pytest

torch = pytest.importorskip("torch")

from torch import nn  # noqa: E402

from understudy.errors import UnderstudyError  # noqa: E402
from understudy.hands.training import HandTrainConfig  # noqa: E402
from understudy.voxelposenet.optimizers import KernelMuon, Optimizers  # noqa: E402
from understudy.voxelposenet.train_config import TrainConfig  # noqa: E402


def with_gradient(shape: tuple[int, ...], seed: int = 0) -> nn.Parameter:
    generator = torch.Generator().manual_seed(seed)
    kernel = nn.Parameter(torch.randn(shape, generator=generator))
    kernel.grad = torch.randn(shape, generator=generator)
    return kernel


def test_matrices_step_as_torchs_own_muon_does():
    ours, theirs = with_gradient((12, 30)), with_gradient((12, 30))
    muon = KernelMuon([ours], 0.01, 0.1)
    oracle = torch.optim.Muon([theirs], lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for _ in range(3):
        muon.step()
        oracle.step()
    torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(6, 5, 3, 3, 3), (6, 5, 3, 3), (40, 8, 1, 1), (4, 7)])
def test_steps_are_nearly_orthogonal_and_as_large_as_adamws(shape: tuple[int, ...]):
    kernel = with_gradient(shape)
    before = kernel.detach().clone()
    KernelMuon([kernel], 0.01, 0.0).step()
    step = ((before - kernel.detach()) / 0.01).flatten(1)
    sizes = torch.linalg.svdvals(step) / (0.2 * max(step.shape) ** 0.5)
    assert float(sizes.min()) > 0.6 and float(sizes.max()) < 1.3
    assert 0.1 < float(step.square().mean().sqrt()) < 0.3
    assert float((step * kernel.grad.flatten(1)).sum()) > 0  # downhill


@pytest.mark.parametrize(
    ("shape", "layout"), [((6, 5, 3, 3, 3), torch.channels_last_3d), ((6, 5, 3, 3), torch.channels_last)]
)
def test_the_order_in_memory_does_not_matter(shape: tuple[int, ...], layout: torch.memory_format):
    plain = with_gradient(shape)
    last = nn.Parameter(plain.detach().clone().to(memory_format=layout))
    last.grad = plain.grad.clone()  # gradients may be laid out otherwise
    for kernel in (plain, last):
        KernelMuon([kernel], 0.01, 0.1).step()
    assert not last.is_contiguous()
    torch.testing.assert_close(last, plain, rtol=0.02, atol=2e-4)  # bfloat16 inside


def test_kernels_that_would_be_copied_are_refused():
    with pytest.raises(ValueError, match="contiguous or channels-last"):
        KernelMuon([nn.Parameter(torch.zeros(4, 5, 6).transpose(0, 2))], 0.01, 0.1)


def test_who_goes_where():
    net = nn.ModuleDict({"body": nn.Conv2d(3, 4, 3), "read": nn.Linear(4, 2)})
    adamw, muon = Optimizers(net, "muon", 0.01, 0.1, readers=("read",)).each
    assert [k is net["body"].weight for k in muon.kernels] == [True]
    decayed, rest = (group["params"] for group in adamw.param_groups)
    assert decayed == [net["read"].weight] and rest == [net["body"].bias, net["read"].bias]
    (alone,) = Optimizers(net, "adamw", 0.01, 0.1, readers=("read",)).each
    assert sum(len(group["params"]) for group in alone.param_groups) == 4


def test_all_parameters_move_at_the_rate_that_is_asked():
    net = nn.ModuleDict({"body": nn.Conv2d(3, 4, 3), "read": nn.Linear(4, 2)})
    for p in net.parameters():
        p.grad = torch.ones_like(p)
    before = deepcopy(net.state_dict())
    optimizers = Optimizers(net, "muon", 1.0, 0.0, readers=("read",))
    optimizers.step(0.0)
    assert all(torch.equal(before[k], v) for k, v in net.state_dict().items())
    optimizers.step(0.01)
    assert all(not torch.equal(before[k], v) for k, v in net.state_dict().items())
    optimizers.zero_grad()
    assert all(p.grad is None for p in net.parameters())


@pytest.mark.parametrize("config", [TrainConfig, HandTrainConfig])
def test_other_optimizers_are_refused(config: type):
    with pytest.raises(UnderstudyError, match="optimizer 'sgd': must be one of 'adamw', 'muon'"):
        config(optimizer="sgd")
