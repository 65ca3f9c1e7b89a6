"""An engine with a gradient through the network: two passes that are written out, joined to torch's autograd.

So whatever is made of the engine's predictions, as of those with and without an instruction, is differentiated as ever.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.engines import Engine

# The call of a Denoiser -> clean states, clean actions, and what the way back needs, whatever it is
ForwardPass = Callable[..., "tuple[Tensor, Tensor, tuple[Any, ...]]"]
# The gradient on clean states, and what the forward pass kept -> that on noisy states
BackwardPass = Callable[[Tensor, "tuple[Any, ...]"], Tensor]


class Differentiable:
    """Called like a denoiser; where the states want a gradient, by the two passes, and else by the engine itself."""

    def __init__(self, engine: Engine, forward: ForwardPass, backward: BackwardPass) -> None:
        self.engine, self.passes = engine, (forward, backward)

    def __call__(self, states: Tensor, *others: Tensor | None, **text: Tensor | None) -> tuple[Tensor, Tensor]:
        """See `Denoiser.forward`. The gradient is on noisy states, by clean ones: actions have none."""
        if not (states.requires_grad and torch.is_grad_enabled()):
            return self.engine(states, *others, **text)
        clean: tuple[Tensor, Tensor] = _Passes.apply(states, self, others, text)  # type: ignore[no-untyped-call]
        return clean

    def differentiated(self, *inputs: Tensor, **text: Any) -> tuple[Tensor, Tensor, Callable[[Array], Array]]:
        """Clean states and actions, and what takes a gradient on clean states to that on noisy ones: without autograd,
        whose own work is a tenth of a plan."""
        states, actions, kept = self.passes[0](*inputs, **text)
        return states, actions, lambda pull: self.passes[1](torch.from_numpy(pull), kept).numpy()


class _Passes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, states: Tensor, engine: Differentiable, others: Any, text: Any) -> tuple[Tensor, Tensor]:
        clean_states, clean_actions, kept = engine.passes[0](states, *others, **text)
        ctx.backward_pass, ctx.kept = engine.passes[1], kept
        ctx.mark_non_differentiable(clean_actions)
        return clean_states, clean_actions

    @staticmethod
    def backward(ctx: Any, *pulled: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.backward_pass(pulled[0], ctx.kept), None, None, None
