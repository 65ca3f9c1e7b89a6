"""The expert's walk through latent actions: does what decoding loses make it fall?"""

from __future__ import annotations

from hw.hal import Array
from hw.robot import Robot
from policy.diffusion.features import raw_row
from policy.latent.actions import LatentActions
from policy.mlp import Mlp
from stack.limits import limit
from tools.train.fleet import Fleet
from tools.train.survival import survival_of
from tools.train.walker import Walker, load_tracker


class RecodedWalker(Walker):
    """The expert, each of whose targets is encoded and decoded with the state of its tick before it runs."""

    def __init__(self, fleet: Fleet, tracker: Mlp, latents: LatentActions | None) -> None:
        """Without `latents` the expert as it is."""
        super().__init__(fleet, tracker)
        self._latents = latents

    def act(self, command: Array) -> Array:
        """See `Walker.act`."""
        # What is encoded is what was demonstrated: targets after the limits.
        target = limit(super().act(command), self.fleet.applied, self.fleet.robot)
        if self._latents is None:
            return target
        row = raw_row(self.fleet.state)
        return self._latents.decode(row, self._latents.encode(row, target))


def recoded_survival(
    robot: Robot, latents: LatentActions | None, seconds: float, worlds: int, seed: int
) -> dict[str, float]:
    """`survival` and `velocity_error` [m/s] of the expert through `latents`; None: of the expert itself."""
    tracker = load_tracker(robot)
    return survival_of(lambda fleet: RecodedWalker(fleet, tracker, latents), robot, seconds, worlds, seed)
