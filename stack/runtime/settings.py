"""What a run is asked for, and what a recorded one was told from outside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.operator import Intent
from servoid.stack.safety.event import Event

if TYPE_CHECKING:
    from servoid.stack.control.policies import PlannerSettings

MAX_GAIN = 2.0  # times the firmware's configured gain; above, a servo of this class rings


@dataclass(frozen=True)
class RunSettings:
    """What to run. Raises ConfigError for a gain that servos cannot have."""

    task: str
    backend: str = "sim"
    robot: str = "op3"
    policy: str = "diffusion"
    randomise: bool = False  # draw the simulated robot's mass, friction, delays and so on
    seconds: float | None = None  # instead of the task's own
    seed: int = 0
    gain: float = 1.0  # scales the servos' position gain: lower is softer
    set: Mapping[str, str] = field(default_factory=dict)  # the task's settings, by name
    start: bool = False  # move a real robot without asking
    record: Path | None = None  # flight log to write
    realtime: bool | None = None  # in step with the wall; None: only where there is hardware
    port: str | None = None
    recover: bool = False  # get up again after a fall, and go on

    def __post_init__(self) -> None:
        if not 0.0 < self.gain <= MAX_GAIN:
            raise ConfigError(f"gain: {self.gain:g} is outside 0 to {MAX_GAIN:g}: it scales the servos' position gain")
        if "gain" in self.set:
            raise ConfigError(
                f"--set gain={self.set['gain']}: gain is not a setting of the task: use --gain G (gain=G)"
            )


@dataclass(frozen=True)
class Script:
    """What came to a recorded run from outside, for a run that repeats it."""

    stops: tuple[Event, ...] = ()  # what ended it: Ctrl-C, a full disk
    # Ticks of plan requests, and when their plans were adopted, of each time that the policy began: it does so again
    # when the robot has got up. None: whatever comes in time.
    plans: Sequence[Mapping[int, int]] | None = None
    velocities: Array | None = None  # (ticks, 3) that a person steered by, in logs which do not say what was wanted,
    ended: bool = False  # and whether the person ended the run
    intents: Sequence[Intent] | None = None  # what a person wanted, tick by tick,
    held: bool = False  # and whether that person had to be heard
    planner: PlannerSettings | None = None  # what it planned with: the policy's file may have moved or changed
