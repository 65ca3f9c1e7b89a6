"""Training windows from a recorded dataset (LeRobot v3.0 layout), all in memory.

Row i holds the state of tick i, the action decided on it (clean label) and the action that really ran (noisy). A window
is an index: its rows are gathered, mirrored and brought into the canonical frame when a batch is drawn.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.checkpoint import difference
from servoid.policy.diffusion.features import Emphasis, Normaliser, raw_mirror, recorded_names, to_tokens
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.latent.actions import LatentActions
from servoid.policy.text.captions import MOTIONS, mirrored, motion_of
from servoid.policy.text.encoder import load_encoder

COLUMNS = ("observation.state", "action", "action_applied", "command", "episode_index", "frame_index")


class DatasetError(ConfigError):
    """A dataset that cannot be trained on: exit code 2."""


@dataclass(frozen=True)
class Recording:
    """Rows of all episodes, one after the other."""

    raw: Array  # (rows, raw size) float32
    action: Array  # (rows, n_joints) rad, what the expert decided
    applied: Array  # (rows, n_joints) rad, what really ran
    command: Array  # (rows, 3) m/s forward, m/s left, rad/s that were asked
    episode: Array  # (rows,) int
    info: dict[str, Any]  # meta/info.json

    @cached_property
    def spans(self) -> Array:
        """First and one past the last row of each episode, `(episodes, 2)`."""
        starts = np.flatnonzero(np.r_[True, np.diff(self.episode) != 0])
        return np.stack([starts, np.r_[starts[1:], len(self.episode)]], 1)


def read_recording(folder: Path, robot: Robot) -> Recording:
    """Read a dataset folder. Raises DatasetError naming the file and what is wrong with it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted(folder.glob("data/chunk-*/file-*.parquet"))
    if not files:
        raise DatasetError(f"{folder}: no data/chunk-*/file-*.parquet here; record a dataset with `servoid collect`")
    described = folder / "meta" / "info.json"
    try:
        info = json.loads(described.read_text())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{described}: cannot be read ({error})") from error
    if info.get("fps", robot.rate) != robot.rate:
        raise DatasetError(f"{folder}: recorded at {info['fps']} ticks a second, and {robot.name} runs at {robot.rate}")
    names = recorded_names(robot)
    for name, ours in names.items():
        theirs = tuple(info.get("features", {}).get(name, {}).get("names") or ())
        if theirs != ours:
            what = difference(theirs, ours)
            raise DatasetError(
                f"{described}: '{name}' is not that of {robot.name}: {what}; give --robot that of the recording, or "
                "record another one with `servoid collect`"
            )
    sizes = {name: len(ours) for name, ours in names.items()}
    parts: dict[str, list[Array]] = {name: [] for name in COLUMNS}
    for file in files:
        try:
            table = pq.read_table(file)
        except (pa.ArrowInvalid, OSError) as error:
            raise DatasetError(f"{file}: not a parquet file, or a truncated one ({error})") from error
        for name in COLUMNS:
            if name not in table.column_names:
                raise DatasetError(f"{file}: no column '{name}'; it has {', '.join(table.column_names)}")
            column = table.column(name).combine_chunks()
            if name not in sizes:
                parts[name].append(column.to_numpy(zero_copy_only=False))
                continue
            flat = column.flatten().to_numpy(zero_copy_only=False)
            if flat.size != sizes[name] * table.num_rows:
                raise DatasetError(f"{file}: '{name}' does not have {sizes[name]} numbers a row")
            parts[name].append(flat.reshape(-1, sizes[name]).astype(np.float32))
    columns = {name: np.concatenate(part) for name, part in parts.items()}
    order = np.lexsort((columns["frame_index"], columns["episode_index"]))
    columns = {name: np.ascontiguousarray(value[order]) for name, value in columns.items()}
    for name in sizes:
        bad = np.flatnonzero(~np.isfinite(columns[name]).all(1))
        if bad.size:
            where = f"episode {columns['episode_index'][bad[0]]}, frame {columns['frame_index'][bad[0]]}"
            raise DatasetError(f"{folder}: '{name}' is not finite in {bad.size} rows, first in {where}")
    gaps = (np.diff(columns["episode_index"]) == 0) & (np.diff(columns["frame_index"]) != 1)
    if gaps.any():
        where = np.flatnonzero(gaps)[0]
        episode, frame = columns["episode_index"][where], columns["frame_index"][where]
        raise DatasetError(f"{folder}: episode {episode} does not go on by one after frame {frame}")
    return Recording(
        raw=columns["observation.state"],
        action=columns["action"],
        applied=columns["action_applied"],
        command=columns["command"],
        episode=columns["episode_index"],
        info=info,
    )


class Captions:
    """Encoded phrasings of each tick's command: what the windows are told."""

    def __init__(self, command: Array, encoder: str, top: Array) -> None:
        """`command` is `(rows, 3)`, `top` `(3,)` the robot's top speeds."""
        self._motion = torch.from_numpy(motion_of(command, top))
        self._mirrored = torch.from_numpy(mirrored(np.arange(len(MOTIONS))))
        self._count = torch.tensor([len(motion.phrasings) for motion in MOTIONS])
        reader, longest = load_encoder(encoder), int(self._count.max())
        self.size = reader.size
        self._text = torch.zeros(len(MOTIONS), longest, reader.size)
        for i, motion in enumerate(MOTIONS):
            self._text[i, : len(motion.phrasings)] = torch.from_numpy(reader.encode(motion.phrasings))

    def of(self, rows: Tensor, mirrored: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Encoded captions `(batch, size)` of `rows` `(batch,)`: a phrasing drawn, or the first without `generator`."""
        motion = self._motion[rows]
        motion = torch.where(mirrored, self._mirrored[motion], motion)
        if generator is None:
            return self._text[motion, 0]
        share = torch.rand(len(rows), generator=generator)
        return self._text[motion, (share * self._count[motion]).long()]


class Windows:
    """Windows over a recording, drawn as normalised batches."""

    def __init__(
        self,
        recording: Recording,
        robot: Robot,
        config: DenoiserConfig,
        held_out: float = 0.02,
        emphasis: float = 0.0,
        seed: int = 0,
        latents: LatentActions | None = None,
    ) -> None:
        """A share `held_out` of the episodes, evenly spread and at least one, is kept for validation.

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
        every = max(2, round(1 / held_out))
        kept = np.arange(len(long)) % every == 0
        # A window shows what one command does: one that changes on the way leads anywhere.
        change = np.r_[True, np.any(np.diff(recording.command, axis=0) != 0.0, axis=1)]
        segment = np.cumsum(change)
        self.validation = self._presents(long[kept], first, last, segment)
        self.training = self._presents(long[~kept], first, last, segment)
        if not len(self.training) or not len(self.validation):
            raise DatasetError(f"no command lasts for the {last} ticks that a window looks ahead; use longer ones")
        self._raw = torch.from_numpy(recording.raw)
        self._action, self._applied = (
            self._both_sides(recording.raw, targets, Mirror.joints(robot))
            for targets in (recording.action, recording.applied)
        )
        self.captions = Captions(recording.command, config.text, robot.walking.scale) if config.text else None
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
        drawn = [self._gather(pick, torch.full((len(pick),), mirrored)) for mirrored in (False, True)]
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
        """A normalised training batch, each window mirrored with probability one half.

        Shapes `(batch, state tokens, state size)`, `(batch, action tokens, action size)`, `(batch, text size)`;
        without an encoder the last is None.
        """
        present = self.training[torch.randint(len(self.training), (batch,), generator=generator)]
        mirrored = torch.rand(batch, generator=generator) < 0.5
        text = self.captions.of(present, mirrored, generator) if self.captions else None
        return *self._encode(self._gather(present, mirrored)), text

    def held_out(self, count: int) -> tuple[Tensor, Tensor, Tensor | None]:
        """Up to `count` normalised validation windows, the same every time."""
        pick = torch.linspace(0, len(self.validation) - 1, min(count, len(self.validation))).long()
        present = self.validation[pick]
        mirrored = torch.arange(len(present)) % 2 == 1
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
