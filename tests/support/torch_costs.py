"""Costs of normalised states that tests write with torch, as guidance takes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.guidance import CostSlope


def by_torch(cost: Callable[[Tensor], Tensor]) -> CostSlope:
    """A cost of states `(batch, tokens, features)`, with its gradient."""

    def slope(states: Array) -> tuple[Array, Array]:
        with torch.enable_grad():
            leaf = torch.from_numpy(states).clone().requires_grad_()
            value = cost(leaf)
            (gradient,) = torch.autograd.grad(value.sum(), leaf)
        return value.detach().numpy(), gradient.numpy()

    return slope
