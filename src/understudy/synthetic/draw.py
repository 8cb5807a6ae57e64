"""Random numbers on one device from one generator, so that a batch is a function of its seed."""

from __future__ import annotations

import torch
from torch import Tensor


class Draw:
    """Draws of a batch. Every method takes the shape that it returns."""

    def __init__(self, seed: int, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self.generator = torch.Generator(self.device).manual_seed(seed)

    def uniform(self, low: float | Tensor, high: float | Tensor, *shape: int) -> Tensor:
        """Uniform between low and high."""
        return low + (high - low) * torch.rand(*shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal."""
        return torch.randn(*shape, generator=self.generator, device=self.device)

    def heavy(self, *shape: int) -> Tensor:
        """Of unit variance for most, with tails: Student's t with 4 degrees of freedom, scaled."""
        a, b, c, d = (self.normal(*shape) ** 2 for _ in range(4))
        chi = (a + b + c + d) / 4
        return self.normal(*shape) / (chi.sqrt() + 0.05) / 2**0.5

    def lognormal(self, sigma: float, *shape: int) -> Tensor:
        """exp of a normal: median 1."""
        return torch.exp(sigma * self.normal(*shape))

    def chance(self, p: float | Tensor, *shape: int) -> Tensor:
        """True with probability p."""
        return torch.rand(*shape, generator=self.generator, device=self.device) < p

    def beta(self, a: float, b: float, *shape: int) -> Tensor:
        """Roughly Beta(a, b), through Kumaraswamy's distribution (closed form, any device)."""
        u = torch.rand(*shape, generator=self.generator, device=self.device)
        return (1 - (1 - u) ** (1 / b)) ** (1 / a)

    def integers(self, high: int, *shape: int) -> Tensor:
        """0 .. high - 1."""
        return torch.randint(high, shape, generator=self.generator, device=self.device)
