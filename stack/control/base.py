"""What most policies share: they make no plans, have nothing to tell, and hold nothing open."""

from __future__ import annotations

from collections.abc import Mapping

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, State


class BasePolicy:
    """A controller that has to say no more than how it acts. Implements the Policy protocol."""

    @property
    def adopted(self) -> Adopted | None:
        """The plan that was taken over in the last call of `act`."""
        return None

    def reset(self, where: Array | None, seeds: Array) -> None:
        """Begin an episode in the worlds `where` `(...,)` bool, None being all, with random numbers from `seeds`."""

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(..., n_joints)` rad for the next tick; `applied` are those that the guard sent last."""
        raise NotImplementedError(f"{type(self).__name__} does not act")

    def take_events(self) -> tuple[str, ...]:
        """What a person should know of, since the last call."""
        return ()

    def repeat(self, plans: Mapping[int, int]) -> None:
        """Take over the plans of a recorded run and no others: ticks of their requests, and of their adoption."""

    def close(self) -> None:
        """Let go of processes and devices."""
