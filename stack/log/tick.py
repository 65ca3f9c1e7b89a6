"""Everything about one tick of the control loop, as listeners and the log get it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from servoid.hw.contracts.body import Array, Command, Observation
from servoid.hw.contracts.control import Adopted, Instruction, State
from servoid.hw.contracts.operator import Intent
from servoid.hw.contracts.world import Percept
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import Phase


@dataclass(frozen=True, slots=True)
class Proposal:
    """What a supervisor wants at a tick. Without a target the goal holds."""

    target: Array | None = None  # (n_joints,) rad
    instruction: Instruction | None = None
    percept: Percept | None = None
    plan: Adopted | None = None  # where one was adopted at this tick


@dataclass(frozen=True, slots=True)
class Timing:
    """How long a tick took, ns of the machine's own clock. `record` is that of the tick before."""

    late: int  # by the loop's clock
    missed: int  # ticks skipped before this one
    read: int
    estimate: int
    act: int
    guard: int
    write: int
    record: int


@dataclass(frozen=True, slots=True)
class TickRecord:
    """Everything about one tick. Arrays are never changed afterwards."""

    tick: int
    phase: Phase  # of the guard, after it decided
    observation: Observation  # as read
    state: State | None  # None until every sensor was read once
    command: Command
    proposal: Proposal
    events: tuple[Event, ...]
    timing: Timing
    intent: Intent | None = None  # what the person in control wants; None where there is nobody


Listener = Callable[[TickRecord], None]
