"""What a person asks of a robot that runs, and where that comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from servoid.hw.contracts.body import Array


class Halt(IntEnum):
    """How urgently a person wants the robot to end."""

    NO = 0
    ORDERLY = 1  # brought to rest, lowered, torque off
    AT_ONCE = 2  # braked, torque off


@dataclass(frozen=True, slots=True)
class Intent:
    """What a person wants now: nothing of it reaches a motor but through task, policy and guard.

    Of way, goal, text and skill the one that was asked last counts; `way` is zero for the others. `age` is how long ago
    the person was last heard: 0 for a device of this machine, which is there or says that it is not.
    """

    sequence: int = 0  # of the message that changed it last; devices that send none leave it at 0
    age: float = 0.0  # s
    way: Array = field(default_factory=lambda: np.zeros(3))  # (3,) in -1..1: forward, to the left, turning left
    goal: Array | None = None  # (2,) m to go to, odometry frame
    text: str | None = None  # a sentence that says what to do
    skill: str | None = None  # name of a skill to perform,
    skills: int = 0  # and how many were asked for so far: the same one may be wanted again
    ends: bool = False  # the task is to end
    halt: Halt = Halt.NO


class CommandSource(Protocol):
    """A gamepad, keys of a terminal, the page in a browser, a recording, or a program."""

    def read(self) -> Intent:
        """What is wanted now. Never waits."""
        ...

    def close(self) -> None:
        """Let go of devices. May be called twice."""
        ...
