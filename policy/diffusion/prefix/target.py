"""Where body parts are to be at the last frame of a plan, and which way the body is to face: a planner's target.

Each of them has a bit that says whether it is asked for. Places are in the heading frame in which the plan begins: the
origin on the ground below the base, x along its heading, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.prefix.frames import Frames, turned, wrapped
from servoid.policy.diffusion.prefix.key_points import AnyArray

SCALE = 0.25  # m that count as one, both as an input and in the loss
PLACES = ("ground", "pelvis")  # of the base: over a point of the ground, at any height, or at a point
HEADING = "heading"


def names(frames: Frames) -> tuple[str, ...]:
    """What a target may ask for: places of the base and the ends of limbs, and the heading last."""
    return (*PLACES, *frames.key_points.ends, HEADING)


@dataclass(frozen=True)
class BodyTarget:
    """Targets of a batch, torch tensors."""

    places: AnyArray  # (batch, places, 3) m; z of "ground" is not read
    heading: AnyArray  # (batch,) rad
    asked: AnyArray  # (batch, places + 1) bool, the heading last

    def encode(self) -> AnyArray:
        """What a network is shown `(batch, size)`: zero where nothing is asked."""
        import torch

        bits = self.asked.to(self.places.dtype)
        level = self.places.new_ones(self.places.shape[-2:])
        level[PLACES.index("ground"), 2] = 0.0
        places = self.places * level / SCALE * bits[..., :-1, None]
        facing = torch.stack([torch.cos(self.heading), torch.sin(self.heading)], -1) * bits[..., -1:]
        return torch.cat([places.flatten(-2), facing, bits], -1)

    def moved(self, place: AnyArray, heading: AnyArray) -> BodyTarget:
        """The same target from a heading frame at `place` `(batch, 2)` m, turned by `heading` `(batch,)` rad."""
        import torch

        flat = torch.cat([place, torch.zeros_like(place[..., :1])], -1)
        places = turned(self.places - flat[..., None, :], -heading[..., None])
        return BodyTarget(places, self.heading - heading, self.asked)

    def error(self, frames: Frames, planned: AnyArray) -> tuple[AnyArray, AnyArray]:
        """By how much frames `(batch, frames, size)` miss at their end: `(batch, places)` m and `(batch,)` rad.

        Of the heading it is the wrapped angle: half a turn too many is the worst, and not nothing. Both count what is
        not asked, too.
        """
        places, heading = reached(frames, planned)
        apart = places - self.places
        squares = apart * apart
        level = squares.new_ones(squares.shape[-2:])
        level[PLACES.index("ground"), 2] = 0.0
        return ((squares * level).sum(-1) + 1e-12).sqrt(), wrapped(heading - self.heading)

    def loss(self, frames: Frames, planned: AnyArray) -> AnyArray:
        """Mean over what is asked of the squared error, in units of `SCALE` and of radians; 0 where nothing is."""
        import torch

        distance, angle = self.error(frames, planned)
        squares = torch.cat([(distance / SCALE) ** 2, angle[..., None] ** 2], -1)
        bits = self.asked.to(squares.dtype)
        return (squares * bits).sum() / bits.sum().clamp_min(1.0)


def size(frames: Frames) -> int:
    """Numbers in an encoded target."""
    return 4 * (len(names(frames)) - 1) + 3


def reached(frames: Frames, planned: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Places `(batch, places, 3)` m and heading `(batch,)` rad at the end of frames `(batch, frames, size)`."""
    import torch

    base, heading, points = frames.end_points(planned)
    ends = [frames.key_points.names.index(name) for name in frames.key_points.ends]
    return torch.cat([base[..., None, :].expand(*base.shape[:-1], len(PLACES), 3), points[..., ends, :]], -2), heading


def none(frames: Frames, batch: int) -> BodyTarget:
    """A target that asks for nothing."""
    import torch

    count = len(names(frames))
    return BodyTarget(torch.zeros(batch, count - 1, 3), torch.zeros(batch), torch.zeros(batch, count, dtype=torch.bool))


def drawn(frames: Frames, future: AnyArray, generator: Any) -> BodyTarget:
    """Where frames `(batch, frames, size)` do end, asked for up to two of its parts: each of two draws is none in half
    of the cases, as in the paper's code."""
    import torch

    places, heading = reached(frames, future)
    batch, count = len(future), len(names(frames))
    picks = torch.randint(count, (batch, 2), generator=generator)
    kept = torch.rand(batch, 2, generator=generator) < 0.5
    asked = torch.zeros(batch, count, dtype=torch.bool)
    for i in range(2):
        asked[torch.arange(batch), picks[:, i]] |= kept[:, i]
    return BodyTarget(places, heading, asked)


def of_points(frames: Frames, asked: Sequence[tuple[str, Sequence[float] | Array]]) -> BodyTarget:
    """One target from names of `names` and their places [m], or angle [rad] for the heading. Raises ConfigError."""
    import torch

    known, target = names(frames), none(frames, 1)
    for name, values in asked:
        if name not in known:
            raise ConfigError(f"no target can be set for '{name}': {nearest(name, known)}")
        given = torch.as_tensor(np.asarray(values, dtype=np.float32))
        if not given.isfinite().all():
            raise ConfigError(f"the target of '{name}' is not finite: was it seen?")
        if name == HEADING:
            target.heading[0] = given.reshape(())
        else:
            target.places[0, known.index(name), : given.numel()] = given
        target.asked[0, known.index(name)] = True
    return target
