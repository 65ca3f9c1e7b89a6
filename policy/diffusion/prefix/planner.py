"""Plans: the frames that follow a prefix, by the diffusion core's sampler with ancestral (DDPM) steps.

The prefix is a known part of the window, clean throughout; what is to come goes down together. A plan depends on what
it is given and on the generators alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from servoid.policy.diffusion.guidance import classifier_free
from servoid.policy.diffusion.prefix.frames import Anchor, Frames
from servoid.policy.diffusion.prefix.model import PlannerModel
from servoid.policy.diffusion.prefix.target import BodyTarget
from servoid.policy.diffusion.sampler import Known, Sampler
from servoid.policy.diffusion.schedule import cosine_signal, full_sequence

ANCESTRAL = 1.0  # eta of the sampler: DDPM


class PrefixPlanner:
    """Plans with a trained network, for one robot or many at once."""

    def __init__(self, model: PlannerModel, frames: Frames, *, steps: int = 0, text_weight: float = 2.5) -> None:
        """`steps` of denoising, 0 for as many as the network has noise levels; `text_weight` of classifier-free
        guidance by the sentence: 0 leaves it unread, 1 is as trained. Raises ValueError for steps that cannot be."""
        config = model.config
        self.model, self.frames, self._text_weight = model, frames, text_weight
        self._matrix = full_sequence(config.levels, steps or config.levels, config.prefix + config.frames, 0)
        self._signal = cosine_signal(config.levels)
        self._known = torch.arange(config.prefix + config.frames) < config.prefix
        self._unsaid = torch.full((1, 1, config.text_size), torch.nan)

    def plan(
        self,
        prefix: Tensor,
        text: Tensor | None,
        target: BodyTarget,
        generators: Sequence[torch.Generator],
        count: int | None = None,
    ) -> Tensor:
        """Frames `(batch, count, size)` that follow frames `prefix` `(batch, prefix, size)`, in physical units.

        `text` `(batch, words, text size)` is an encoded sentence, None where nothing is said; `target` is seen from the
        last frame of the prefix, and is for the last frame of the plan. A plan of more frames than the network gives at
        once goes on from its own prediction.
        """
        config, parts = self.model.config, list[Tensor]()
        left = config.frames if count is None else count
        with torch.inference_mode():
            while True:
                future = self._one(prefix, text, target, generators)
                parts.append(future[:, :left])
                left -= config.frames
                if left <= 0:
                    return torch.cat(parts, 1)
                end = self.frames.to_global(future)
                before = Anchor.before(end, -1)
                target = target.moved(before.place, before.heading)
                prefix = torch.cat([prefix, future], 1)[:, -config.prefix :]

    def _one(
        self, prefix: Tensor, text: Tensor | None, target: BodyTarget, generators: Sequence[torch.Generator]
    ) -> Tensor:
        config, normaliser = self.model.config, self.model.normaliser
        batch, code = len(prefix), target.encode()
        filled = torch.zeros(batch, config.prefix + config.frames, config.size)
        filled[:, : config.prefix] = normaliser.encode(prefix)

        def denoise(
            states: Tensor,
            actions: Tensor,
            state_levels: Tensor,
            action_levels: Tensor,
            text: Tensor = self._unsaid,
            text_mask: Tensor | None = None,
        ) -> tuple[Tensor, Tensor]:
            count = len(states)
            words = text.expand(count, -1, -1)
            level = state_levels[-1].expand(count)
            clean = self.model.network(states, level, code.repeat(count // batch, 1), words, text_mask)
            return torch.cat([states[:, : config.prefix], clean], 1), actions

        nothing = torch.zeros(batch, 0, 1)
        known = Known(filled, nothing, self._known, torch.zeros(0, dtype=torch.bool))
        sampler = Sampler(classifier_free(denoise, text, self._text_weight), self._signal, ANCESTRAL)
        window, _ = sampler.sample(self._matrix, known, generators)
        planned: Tensor = normaliser.decode(window[:, config.prefix :])
        return planned
