"""Training windows from a recording.

A window is an index: its rows are gathered, mirrored and brought into the canonical frame when a batch is drawn.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.features import Emphasis, Normaliser, raw_mirror, to_tokens
from servoid.policy.latent.actions import LatentActions
from servoid.policy.recording import DatasetError, Recording
from servoid.policy.text.encoder import load_encoder
from servoid.policy.text.told import Told, clock_code

HELD_OUT = 0.02  # share of the episodes, evenly spread and at least one, that is kept for validation


class Captions:
    """Encoded phrasings of what each tick is told, and how long it has lasted."""

    def __init__(self, told: Told, encoder: str, waves: int = 0) -> None:
        """`waves` of the clock: none without one."""
        self._label, self._mirrored = torch.from_numpy(told.label), torch.from_numpy(told.mirrored)
        self._count = torch.tensor([len(phrasings) for phrasings in told.phrasings])
        reader, longest = load_encoder(encoder), int(self._count.max())
        self.size = reader.size + 2 * waves
        self._text = torch.zeros(len(told.phrasings), longest, reader.size)
        for i, phrasings in enumerate(told.phrasings):
            self._text[i, : len(phrasings)] = torch.from_numpy(reader.encode(phrasings))
        self._clock = torch.from_numpy(clock_code(told.clock, waves))

    def of(self, rows: Tensor, mirrored: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Encoded captions `(batch, size)` of `rows` `(batch,)`: a phrasing drawn, or the first without `generator`."""
        label = self._label[rows]
        label = torch.where(mirrored, self._mirrored[label], label)
        share = torch.zeros(len(rows)) if generator is None else torch.rand(len(rows), generator=generator)
        return torch.cat([self._text[label, (share * self._count[label]).long()], self._clock[rows]], 1)


class Windows:
    """Windows over a recording, drawn as normalised batches."""

    def __init__(
        self,
        recording: Recording,
        robot: Robot,
        config: DenoiserConfig,
        told: Told | None = None,
        emphasis: float = 0.0,
        seed: int = 0,
        latents: LatentActions | None = None,
    ) -> None:
        """What rows were `told`; None: the motion of walking that was commanded.

        `emphasis` of global states, drawn from `seed`: see `features.Emphasis`; 0 for none. With `latents` actions are
        the posterior means of what was demonstrated, each given the state of its tick, instead of joint targets.
        """
        self.config = config
        self.n_joints = len(robot.joints)
        self.latents = latents
        self._mirror_raw = raw_mirror(robot)
        spans = recording.spans
        first, last = config.history - 1, config.horizon  # ticks needed before and after the present
        long = spans[spans[:, 1] - spans[:, 0] > first + last]
        if len(long) < 2:
            raise DatasetError(
                f"{len(long)} of {len(spans)} episodes are longer than the {first + last + 1} ticks of a window, "
                "and two are needed; record longer ones"
            )
        every = max(2, round(1 / HELD_OUT))
        kept = np.arange(len(long)) % every == 0
        # A window shows what one command does: one that changes on the way leads anywhere, and a robot that stands, and
        # may start at any tick to come, puts it off for ever. Starts and stops are where a command is new.
        told = told or Told.walks(recording.command, robot.walking.scale)
        change = np.r_[True, np.any(np.diff(recording.command, axis=0) != 0.0, axis=1)]
        segment = np.cumsum(change | told.changes)
        self.validation = self._presents(long[kept], first, last, segment)
        self.training = self._presents(long[~kept], first, last, segment)
        if not len(self.training) or not len(self.validation):
            raise DatasetError(f"no command lasts for the {last} ticks that a window looks ahead; use longer ones")
        self._raw = torch.from_numpy(recording.raw)
        self._action, self._applied = (
            self._both_sides(recording.raw, targets, Mirror.joints(robot))
            for targets in (recording.action, recording.applied)
        )
        self.captions = Captions(told, config.text, config.clock) if config.text else None
        self._has_image = torch.from_numpy((told.mirrored >= 0)[told.label])
        states, actions = self._fit()
        if emphasis:
            states = Emphasis.of(states, self.n_joints, emphasis, seed)
        self.states, self.actions = states.to_torch(), actions.to_torch()

    @staticmethod
    def _presents(spans: Array, before: int, after: int, segment: Array) -> Tensor:
        """Rows that can be the present of a window. `segment` `(rows,)` numbers the commands."""
        rows = np.concatenate([np.arange(a + before, b - after) for a, b in spans])
        return torch.from_numpy(rows[segment[rows] == segment[rows + after - 1]])

    def _both_sides(self, raw: Array, targets: Array, mirror: Mirror) -> Tensor:
        """Actions of all rows as they are and as a mirror shows them, `(2, rows, action size)` float32."""
        sides = [targets, mirror(targets)]
        if self.latents is not None:
            sides = [_encoded(self.latents, *side) for side in zip((raw, self._mirror_raw(raw)), sides, strict=True)]
        return torch.from_numpy(np.stack(sides))

    def _fit(self, samples: int = 20_000) -> tuple[Normaliser, Normaliser]:
        """Normalisation over a fixed draw of windows and their mirror images."""
        generator = torch.Generator().manual_seed(0)
        count = min(samples, len(self.training))
        pick = self.training[torch.randint(len(self.training), (count,), generator=generator)]
        drawn = [self._gather(pick, self._has_image[pick] & mirrored) for mirrored in (False, True)]
        states, actions = (torch.cat([part[i] for part in drawn]).flatten(0, 1).numpy() for i in (0, 1))
        return Normaliser.fit(states), Normaliser.fit(actions)

    def _gather(self, present: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens and actions of windows, not normalised; `mirrored` `(batch,)` bool."""
        state_rows = present[:, None] + torch.from_numpy(self.config.state_ticks)
        action_rows = present[:, None] + torch.from_numpy(self.config.action_ticks)
        raw = self._raw[state_rows]
        # The past is what really ran; the future is what the expert would do.
        past = self.config.history - 1
        side = mirrored.long()[:, None]
        ran, wanted = self._applied[side, action_rows[:, :past]], self._action[side, action_rows[:, past:]]
        actions = torch.cat([ran, wanted], 1)
        raw = torch.where(mirrored[:, None, None], self._mirror_raw(raw), raw)
        return to_tokens(raw, raw[:, past], self.n_joints), actions

    def draw(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor | None]:
        """A normalised training batch, each window that has a mirror image mirrored with probability one half.

        Shapes `(batch, state tokens, state size)`, `(batch, action tokens, action size)`, `(batch, text size)`;
        without an encoder the last is None.
        """
        present = self.training[torch.randint(len(self.training), (batch,), generator=generator)]
        mirrored = (torch.rand(batch, generator=generator) < 0.5) & self._has_image[present]
        text = self.captions.of(present, mirrored, generator) if self.captions else None
        return *self._encode(self._gather(present, mirrored)), text

    def held_out(self, count: int) -> tuple[Tensor, Tensor, Tensor | None]:
        """Up to `count` normalised validation windows, the same every time."""
        pick = torch.linspace(0, len(self.validation) - 1, min(count, len(self.validation))).long()
        present = self.validation[pick]
        mirrored = (torch.arange(len(present)) % 2 == 1) & self._has_image[present]
        text = self.captions.of(present, mirrored) if self.captions else None
        return *self._encode(self._gather(present, mirrored)), text

    def _encode(self, window: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        states, actions = window
        return self.states.encode(states), self.actions.encode(actions)


def _encoded(latents: LatentActions, raw: Array, targets: Array, chunk: int = 16_384) -> Array:
    """Latents `(rows, size)` float32 of all rows, so many at a time: hidden layers of all would fill the memory."""
    parts = np.arange(chunk, len(raw), chunk)
    pairs = zip(np.split(raw, parts), np.split(targets, parts), strict=True)
    return np.concatenate([latents.encode(*pair).astype(np.float32) for pair in pairs])
