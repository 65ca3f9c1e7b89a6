"""The conditional VAE behind latent actions, for training: a Gaussian posterior held to a learned Gaussian prior."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from servoid.hw.contracts.body import Array
from servoid.policy.features import Normaliser
from servoid.policy.latent.actions import LatentActions, LatentConfig, proprioception
from servoid.policy.mlp import Mlp

_LOG_VARIANCE = 10.0  # at most this far from 0: exp() of more than that is nothing to learn from


@dataclass(frozen=True)
class Gaussian:
    """Independent normal distributions, `(..., size)` each."""

    mean: Tensor
    log_variance: Tensor

    def draw(self, generator: torch.Generator) -> Tensor:
        """A sample of each, by the reparametrisation trick."""
        noise = torch.randn(self.mean.shape, generator=generator)
        return self.mean + (0.5 * self.log_variance).exp() * noise

    def kl(self, other: Gaussian) -> Tensor:
        """KL(self || other) in nats, summed over the last axis.

        0.5 (log v2 - log v1 + (v1 + (m1 - m2)^2) / v2 - 1): Kingma and Welling, arXiv:1312.6114, appendix B, for two
        normal distributions.
        """
        spread = self.log_variance - other.log_variance
        apart = (self.mean - other.mean).square() / other.log_variance.exp()
        return 0.5 * (spread.exp() + apart - 1.0 - spread).sum(-1)


@dataclass(frozen=True)
class LossTerms:
    """What a batch is scored by, each a mean over it."""

    reconstruction: Tensor  # squared error of normalised joint targets, mean over joints
    kl: Tensor  # nats
    change: Tensor  # squared change of the posterior mean from a tick to the next, mean over its numbers


class LatentNetwork(nn.Module):
    """Encoder, prior and decoder over normalised states and actions.

    An action is what it differs by from the mean pose of the data, over its deviation.
    """

    def __init__(self, config: LatentConfig, states: Normaliser, actions: Normaliser) -> None:
        """Normalisers hold torch tensors: of proprioception `(features,)` and of joint targets `(n_joints,)`."""
        super().__init__()
        self.config, self.states, self.actions = config, states, actions
        n_state, n_joints, z = len(states.mean), len(actions.mean), config.size
        self.encoder = _dense(config, n_state + n_joints, 2 * z)
        self.prior = _dense(config, n_state, 2 * z)
        self.decoder = _dense(config, n_state + z, n_joints)

    def posterior(self, state: Tensor, action: Tensor) -> Gaussian:
        """E(z | s, a) of normalised states and actions."""
        return _gaussian(self.encoder(torch.cat([state, action], -1)))

    def terms(self, rows: Tensor, targets: Tensor, generator: torch.Generator | None = None) -> LossTerms:
        """Terms of the loss over ticks that follow each other: raw rows `(batch, ticks, raw size)` and targets [rad].

        Latents are drawn with `generator`; without one, the posterior's means are decoded.
        """
        state, action = self.states.encode(proprioception(rows)), self.actions.encode(targets)
        posterior, prior = self.posterior(state, action), _gaussian(self.prior(state))
        latent = posterior.mean if generator is None else posterior.draw(generator)
        decoded = self.decoder(torch.cat([state, latent], -1))
        return LossTerms(
            reconstruction=(decoded - action).square().mean(),
            kl=posterior.kl(prior).mean(),
            change=posterior.mean.diff(dim=1).square().mean(),
        )

    def to_numpy(self) -> LatentActions:
        """The same three functions without torch, over physical units."""
        mean, std, z = self.actions.mean.numpy(), self.actions.std.numpy(), self.config.size
        nothing, unit = torch.zeros(z), torch.ones(z)

        def inputs(*more: tuple[Tensor, Tensor]) -> tuple[Array, Array]:
            parts = ((self.states.mean, self.states.std), *more)
            centre, spread = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
            return centre, spread

        *hidden, (weight, bias) = _layers(self.decoder)
        decoder = [*hidden, (weight * std, bias * std + mean)]
        return LatentActions(
            encoder=Mlp(_layers(self.encoder), *inputs((self.actions.mean, self.actions.std))),
            prior=Mlp(_layers(self.prior), *inputs()),
            decoder=Mlp(decoder, *inputs((nothing, unit))),
        )


def _dense(config: LatentConfig, inputs: int, outputs: int) -> nn.Sequential:
    sizes = [inputs, *[config.width] * config.layers]
    hidden = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*hidden, nn.Linear(config.width, outputs))


def _layers(network: nn.Sequential) -> list[tuple[Array, Array]]:
    dense = [m for m in network if isinstance(m, nn.Linear)]
    return [(m.weight.detach().numpy().T.copy(), m.bias.detach().numpy().copy()) for m in dense]


def _gaussian(output: Tensor) -> Gaussian:
    mean, log_variance = output.chunk(2, -1)
    return Gaussian(mean, log_variance.clamp(-_LOG_VARIANCE, _LOG_VARIANCE))
