"""Noise schedules and denoising matrices.

Level 0 is clean and level `levels` is pure noise. A token at level k holds

    x_k = sqrt(a_k) x_0 + sqrt(1 - a_k) noise

with `a` the cumulative signal (alpha bar). A denoising matrix says which level every token has before and after each
network call, so that full-sequence, autoregressive, pyramid and rolling sampling differ in an array only (the seam of
Diffusion Forcing, arXiv:2407.01392).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array

PYRAMID = "pyramid"
TRAPEZOID = "trapezoid"


def cosine_signal(levels: int, offset: float = 0.008) -> Array:
    """Cumulative signal `(levels + 1,)` of the cosine schedule, from 1 at level 0 to almost 0 at `levels`.

    Nichol and Dhariwal, arXiv:2102.09672, eq. 17; a single level never removes more than 99.9 % of the variance.
    """
    if levels < 1:
        raise ValueError(f"a noise schedule needs at least one level, not {levels}")
    angle = (np.arange(levels + 1) / levels + offset) / (1 + offset) * np.pi / 2
    signal = np.cos(angle) ** 2
    keep = np.maximum(signal[1:] / signal[:-1], 1e-3)
    return np.concatenate([[1.0], np.cumprod(keep)])


def ddim_levels(levels: int, steps: int) -> Array:
    """Integer levels `(steps + 1,)` visited by a DDIM sampler, evenly spaced from `levels` down to 0."""
    if not 1 <= steps <= levels:
        raise ValueError(f"the number of denoising steps must be 1 to {levels} (the training levels), not {steps}")
    return np.round(np.linspace(levels, 0, steps + 1)).astype(np.int64)


@dataclass(frozen=True)
class DenoisingMatrix:
    """Noise level of each token before the first network call (row 0) and after each call (the rows below)."""

    states: Array  # (calls + 1, state tokens) int
    actions: Array  # (calls + 1, action tokens) int

    def __post_init__(self) -> None:
        if len(self.states) != len(self.actions) or len(self.states) < 2:
            raise ValueError(
                f"a denoising matrix needs as many rows for states as for actions, two or more, "
                f"not {len(self.states)} and {len(self.actions)}"
            )
        for name, rows in (("states", self.states), ("actions", self.actions)):
            if rows.min(initial=0) < 0 or (np.diff(rows, axis=0) > 0).any():
                raise ValueError(f"noise levels of {name} must be >= 0 and never rise from one call to the next")

    @property
    def calls(self) -> int:
        """Network calls that the sampler makes."""
        return len(self.states) - 1

    def hold(self, states: Array, actions: Array) -> DenoisingMatrix:
        """The same matrix with known tokens at level 0 throughout; masks `(state tokens,)`, `(action tokens,)` bool."""
        return DenoisingMatrix(np.where(states, 0, self.states), np.where(actions, 0, self.actions))

    def ignore(self, states: Array, actions: Array, levels: int) -> DenoisingMatrix:
        """The same matrix with tokens that stay pure noise (`levels`), which tells the network nothing; masks as above.

        Calls that would change nothing are left out.
        """
        state_rows, action_rows = np.where(states, levels, self.states), np.where(actions, levels, self.actions)
        change = (np.diff(state_rows, axis=0) != 0).any(1) | (np.diff(action_rows, axis=0) != 0).any(1)
        kept = np.r_[True, change if change.any() else np.ones_like(change)]
        return DenoisingMatrix(state_rows[kept], action_rows[kept])


def full_sequence(levels: int, steps: int, state_tokens: int, action_tokens: int, lead: int = 0) -> DenoisingMatrix:
    """All tokens go down together, in `steps` calls.

    With `lead` > 0 the states finish that many calls before the actions, which then see the finished states, at the
    price of as many extra calls.
    """
    states, actions = np.zeros(state_tokens, dtype=np.int64), np.zeros(action_tokens, dtype=np.int64)
    return _staggered(levels, levels, states, actions + lead, steps)


def autoregressive(
    levels: int, steps: int, state_frames: Array, action_frames: Array, block: int = 1, lead: int = 0
) -> DenoisingMatrix:
    """Frames are denoised one block after the other, each in `steps` calls, while all later ones stay pure noise.

    Frame f is the action of tick f and the state of tick f + 1 that it leads to, as a token of UniPhys is; `..._frames`
    gives the frame of each token, `(tokens,)`, negative in the past. `lead` is that of `full_sequence`, in each block.
    """
    if block < 1:
        raise ValueError(f"a block of frames must hold at least one, not {block}")
    states, actions = (np.maximum(frames, 0) // block * (steps + lead) for frames in (state_frames, action_frames))
    return _staggered(levels, levels, states, actions + lead, steps)


def pyramid(
    levels: int,
    steps: int,
    state_frames: Array,
    action_frames: Array,
    spread: int,
    shape: str = PYRAMID,
    lead: int = 0,
) -> DenoisingMatrix:
    """Near frames go down first: each frame begins later than the one before it, the last one `spread` calls late.

    "pyramid" is that of UniPhys and of Diffusion Forcing. In a "trapezoid" the latest are the frames in the middle, for
    a window whose far end is known as well, by a keyframe say. Frames are those of `autoregressive`.
    """
    if spread < 0:
        raise ValueError(f"the spread of a pyramid schedule must not be negative, not {spread}")
    if shape not in (PYRAMID, TRAPEZOID):
        raise ValueError(f"a pyramid schedule is '{PYRAMID}' or '{TRAPEZOID}', not '{shape}'")
    last = max(state_frames.max(), action_frames.max())

    def delays(frames: Array) -> Array:
        frames, latest = np.maximum(frames, 0), last
        if shape == TRAPEZOID:
            frames, latest = np.minimum(frames, last - frames), last // 2
        late: Array = np.round(spread * frames / max(latest, 1)).astype(np.int64)
        return late

    return _staggered(levels, levels, delays(state_frames), delays(action_frames) + lead, steps)


@dataclass(frozen=True)
class Rolling:
    """Where a rolling plan goes on from. Levels are those of a network with 20, as in Diffuse-CLoC."""

    state_level: int = 14
    action_level: int = 4
    ramp: int | None = None  # frames over which the level rises to pure noise; None: the whole window

    def __post_init__(self) -> None:
        if min(self.state_level, self.action_level, 1 if self.ramp is None else self.ramp) < 1:
            raise ValueError("state_level, action_level and ramp must be at least 1")


def rolling(
    levels: int, steps: int, state_frames: Array, action_frames: Array, start: Rolling, fresh: int = 1, lead: int = 0
) -> DenoisingMatrix:
    """A plan that goes on from an earlier one: the first-in, first-out buffer of Diffuse-CLoC (section 3.2).

    The last `fresh` frames were pushed in since and are pure noise. Of the others, states and actions go on from the
    levels of `start`; over the frames of its ramp before the fresh ones, or as many as there are, the level rises to
    pure noise. Frames are those of `autoregressive`.
    """
    for name, level in (("states", start.state_level), ("actions", start.action_level)):
        if level > levels:
            raise ValueError(f"rolling {name} must go on from a level of 1 to {levels}, not {level}")
    if fresh < 0:
        raise ValueError(f"fresh must not be negative, not {fresh}")

    def starts(frames: Array, level: int) -> Array:
        last = frames.max()  # of actions, there may be fewer
        kept = max(last + 1 - fresh, 1)
        ramp = kept if start.ramp is None else min(start.ramp, kept)
        risen = np.clip(1 - (last + 1 - fresh - frames) / ramp, 0.0, 1.0)  # 1 in the fresh frames
        risen_levels: Array = np.round(level + (levels - level) * risen).astype(np.int64)
        return risen_levels

    states, actions = np.zeros_like(state_frames), np.zeros_like(action_frames)
    starts_of = starts(state_frames, start.state_level), starts(action_frames, start.action_level)
    return _staggered(*starts_of, states, actions + lead, steps)


def _staggered(
    state_levels: Array | int, action_levels: Array | int, state_delays: Array, action_delays: Array, steps: int
) -> DenoisingMatrix:
    """Each token begins at its level and goes down evenly in `steps` calls, after a delay of so many calls."""
    calls = steps + int(max(state_delays.max(initial=0), action_delays.max(initial=0)))

    def rows(levels: Array | int, delays: Array) -> Array:
        ladder = np.linspace(np.broadcast_to(levels, delays.shape), 0.0, steps + 1)
        at = np.clip(np.arange(calls + 1)[:, None] - delays, 0, steps)
        return np.take_along_axis(np.round(ladder).astype(np.int64), at, 0)

    return DenoisingMatrix(rows(state_levels, state_delays), rows(action_levels, action_delays))
