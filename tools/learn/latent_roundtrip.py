"""The expert's walk through latent actions: does what decoding loses make it fall?"""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.features import raw_row
from servoid.policy.latent.actions import LatentActions
from servoid.policy.mlp import Mlp
from servoid.stack.control.fleet import Fleet
from servoid.stack.safety.limits import limit
from servoid.tools.learn.envs.walker import Walker, load_tracker
from servoid.tools.learn.survival import survival_of


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
