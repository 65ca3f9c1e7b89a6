"""The person in control of a run: what is wanted is read once a tick, and whoever must be there is missed.

A dead man's switch: where a person has to be heard, as at a page whose network may break, the robot comes to rest when
nobody was heard for REST_SECONDS, and is lowered after LOST_SECONDS. Until the first word it stands, and is not
lowered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.operator import CommandSource, Halt, Intent
from servoid.hw.contracts.task import Behaviour
from servoid.hw.contracts.world import Percept
from servoid.stack.runtime.interrupt import OFF, Stop

REST_SECONDS = 0.3
LOST_SECONDS = 2.0
STOP = "a person asked to stop"
LOST = f"the person in control was not heard for {LOST_SECONDS:g} s"
SILENT = f"the person in control was not heard for {REST_SECONDS:g} s: resting"
HEARD = "the person in control is heard again"


class Operator:
    """Reads a source. `held`: the person has to be heard; otherwise only what is asked counts, such as a stop."""

    def __init__(self, source: CommandSource, *, held: bool = True) -> None:
        self.held = held
        self.intent = Intent()
        self._source, self._heard = source, False

    def read(self) -> Intent:
        """Read what is wanted now: once a tick."""
        self.intent = self._source.read()
        self._heard |= self.intent.age <= REST_SECONDS
        return self.intent

    def wanted(self) -> Intent:
        """What was read last."""
        return self.intent

    @property
    def silent(self) -> bool:
        """Whether the robot shall rest, since nobody is heard."""
        return self.held and not self.intent.age <= REST_SECONDS

    def stop(self) -> Stop | None:
        """Why the run shall end, by what was read last."""
        if self.intent.halt is Halt.AT_ONCE:
            return Stop("interrupt", OFF, at_once=True)
        if self.intent.halt is Halt.ORDERLY:
            return Stop("interrupt", STOP)
        if self.held and self._heard and self.intent.age > LOST_SECONDS:
            return Stop("operator", LOST)
        return None

    def close(self) -> None:
        self._source.close()


class Recorded:
    """The person of a recorded run, read tick by tick, and once more as at its last tick. A `CommandSource`."""

    def __init__(self, intents: Sequence[Intent]) -> None:
        self._intents, self._next = intents, 0

    def read(self) -> Intent:
        intent = self._intents[min(self._next, len(self._intents) - 1)]
        self._next += 1
        return intent

    def close(self) -> None:
        """There is nothing to let go of."""


class Held:
    """A behaviour whose robot rests while nobody in control is heard; the task does not notice. `note` hears of it."""

    def __init__(self, behaviour: Behaviour, operator: Operator, note: Callable[[str], None]) -> None:
        self._behaviour, self._operator, self._note = behaviour, operator, note
        self._silent = False

    @property
    def teammates(self) -> Sequence[Behaviour]:
        return self._behaviour.teammates

    def percept(self, state: State) -> Percept:
        return self._behaviour.percept(state)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        instruction, silent = self._behaviour.instruct(tick, state, percept), self._operator.silent
        if silent != self._silent:
            self._silent = silent
            self._note(SILENT if silent else HEARD)
        return Instruction(np.zeros(3)) if silent else instruction

    def done(self, state: State) -> bool:
        """Also when the person in control ends the task."""
        return self._behaviour.done(state) or self._operator.intent.ends

    def take_events(self) -> Sequence[str]:
        return self._behaviour.take_events()

    def lost(self) -> None:
        self._behaviour.lost()

    def close(self) -> None:
        self._behaviour.close()
