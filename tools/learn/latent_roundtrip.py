"""The expert's walk through latent actions: does what decoding loses make it fall?"""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.features import raw_row
from servoid.policy.latent.actions import LatentActions
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.safety.limits import limit
from servoid.tools.learn.survival import measured_fleet, survival_of


class RecodedExpert(ExpertPolicy):
    """The expert, each of whose targets is encoded and decoded with the state of its tick before it runs."""

    def __init__(self, robot: Robot, latents: LatentActions | None, shape: tuple[int, ...] = ()) -> None:
        """Without `latents` the expert as it is."""
        super().__init__(robot, shape=shape)
        self._robot, self._latents = robot, latents

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        # What is encoded is what was demonstrated: targets after the limits.
        target = limit(super().act(state, applied, instruction), applied, self._robot)
        if self._latents is None:
            return target
        row = raw_row(state)
        return self._latents.decode(row, self._latents.encode(row, target))


def recoded_survival(
    robot: Robot, latents: LatentActions | None, seconds: float, worlds: int, seed: int
) -> dict[str, float]:
    """`survival` and `velocity_error` [m/s] of the expert through `latents`; None: of the expert itself."""
    return survival_of(RecodedExpert(robot, latents, (worlds,)), measured_fleet(robot, worlds, seed), seconds)
