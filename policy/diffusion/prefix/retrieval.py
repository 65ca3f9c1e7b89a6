"""An encoder of motions and of sentences into one space, by which plans are compared with what they were told.

Trained by contrast: of a batch's sentences a motion is to be nearest to its own, and the other way round. Two windows
of the same label are no contrast, and are left out of it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

SIZE = 32  # numbers of an embedding
TEMPERATURE = 0.1


class RetrievalNetwork(nn.Module):
    """Embeds frames `(batch, frames, size)`, normalised, and words `(batch, words, text size)`, NaN where there is
    none: both as unit vectors `(batch, SIZE)`."""

    def __init__(self, size: int, text_size: int, width: int = 96) -> None:
        super().__init__()
        self.inner = nn.Sequential(
            nn.Conv1d(size, width, 5, stride=2, padding=2), nn.SiLU(), nn.Conv1d(width, width, 5, stride=2, padding=2),
            nn.SiLU(),
        )  # fmt: skip
        self.motion_head = nn.Linear(2 * width, SIZE)
        self.text_inner = nn.Sequential(nn.Linear(text_size, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
        self.text_head = nn.Linear(width, SIZE)

    def motion(self, frames: Tensor) -> Tensor:
        inner = self.inner(frames.transpose(1, 2))
        out: Tensor = self.motion_head(torch.cat([inner.mean(-1), inner.amax(-1)], -1))
        return nn.functional.normalize(out, dim=-1)

    def text(self, words: Tensor) -> Tensor:
        there = ~words.isnan().any(-1, keepdim=True)
        inner = (self.text_inner(words.nan_to_num()) * there).sum(1) / there.sum(1).clamp_min(1)
        out: Tensor = self.text_head(inner)
        return nn.functional.normalize(out, dim=-1)

    def loss(self, frames: Tensor, words: Tensor, label: Tensor) -> Tensor:
        """Of a batch of pairs, `label` `(batch,)` telling which are the same."""
        near = self.motion(frames) @ self.text(words).T / TEMPERATURE
        same = (label[:, None] == label[None]) & ~torch.eye(len(label), dtype=torch.bool)
        near = near.masked_fill(same, -torch.inf)
        own = torch.arange(len(label))
        return 0.5 * (nn.functional.cross_entropy(near, own) + nn.functional.cross_entropy(near.T, own))
