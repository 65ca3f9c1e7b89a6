"""Faults of a rig, injected by time, servo and probability from a YAML scenario.

seed: 3
faults:
  - {kind: corrupt, probability: 0.01}                # of status packets, all the time
  - {kind: overheating, servo: l_knee, at: 2.0}       # once, 2 s after the rig began
  - {kind: dead, servo: 14, at: 2.0, until: 2.06}
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Literal, get_args

from servoid.hw.config import ConfigError, load_yaml, nearest
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.faults import ENCODER, INPUT_VOLTAGE, OVERHEATING, OVERLOAD, SHOCK
from servoid.hw.robot.description import Robot
from servoid.hw.seeds import Stream, generator

Kind = Literal[
    "drop", "late", "truncate", "duplicate", "wrong_id", "corrupt", "error_status", "stuffed",
    "garbage", "babble", "echo", "split", "batching",
    "reboot", "voltage", "overheating", "encoder", "shock", "overload", "torque_off", "id_conflict", "dead", "heat",
    "baud_mismatch", "watchdog", "imu_dead", "imu_frozen", "button", "vanish", "vanish_in_read", "stall", "brown_out",
    "clock_step",
]  # fmt: skip
KINDS: tuple[str, ...] = get_args(Kind)
MISSPOKEN = ("wrong_id", "error_status")  # whole packets that say something wrong
STATUS_KINDS = ("drop", "late", "truncate", "duplicate", "wrong_id", "corrupt", "error_status")
ALERTS = {
    "voltage": INPUT_VOLTAGE, "overheating": OVERHEATING, "encoder": ENCODER, "shock": SHOCK, "overload": OVERLOAD,
}  # fmt: skip


class Outcome(Enum):
    """What is expected of the controller."""

    ABSORBED = "absorbed"  # no effect but a counter
    NAMED = "named"  # in the log, with the servo; the run goes on, or ends in order
    FATAL = "fatal"  # named, and the robot made safe


# An encoder error leaves a joint without a position; batching leaves the loop without samples for most of its ticks;
# after a step of the clock nobody knows how old a sample is. None of them can be walked on with.
EXPECTED: dict[str, Outcome] = {
    **dict.fromkeys(STATUS_KINDS, Outcome.ABSORBED),
    **dict.fromkeys(("stuffed", "garbage", "echo", "split"), Outcome.ABSORBED),
    **dict.fromkeys(("voltage", "button", "heat"), Outcome.NAMED),
    **dict.fromkeys(("reboot", "overheating", "encoder", "shock", "overload", "torque_off"), Outcome.FATAL),
    **dict.fromkeys(("batching", "watchdog", "clock_step"), Outcome.FATAL),
    **dict.fromkeys(("id_conflict", "dead", "baud_mismatch", "babble", "imu_dead", "imu_frozen"), Outcome.FATAL),
    **dict.fromkeys(("vanish", "vanish_in_read", "stall", "brown_out"), Outcome.FATAL),
}
NEEDS_SERVO = (*ALERTS, "reboot", "torque_off", "id_conflict", "dead", "baud_mismatch", "watchdog", "heat")
# s of lateness, s of the step, s of the adapter's batch, error number, bits of the buttons, C
_VALUES = {
    "late": 0.003, "clock_step": 0.5, "batching": 0.016, "error_status": 1.0, "button": 1.0,
    "heat": 72.0,
}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One fault. Times s since the rig began or was reset; what lasts goes on to `until`, for ever if there is none.

    `probability` is of each status packet or burst that the fault can strike; for what happens once, of its happening.
    `value` is the lateness or step [s], the voltage [V], the error number, the bits of the buttons that are down or the
    temperature [C]; `expect` replaces the usual outcome.
    """

    kind: Kind
    servo: int | str | None = None  # ID or joint; none: every one
    at: float = 0.0
    until: float | None = None
    probability: float = 1.0
    value: float | None = None
    expect: Literal["absorbed", "named", "fatal"] | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"unknown fault '{self.kind}'; {nearest(self.kind, KINDS)}")
        if not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"probability {self.probability} is not within 0 and 1")
        if self.at < 0 or (self.until is not None and self.until <= self.at):
            raise ValueError(f"fault {self.kind}: from {self.at} to {self.until} s is no span of time")
        if self.kind in NEEDS_SERVO and self.servo is None:
            raise ValueError(f"fault {self.kind} needs a servo: its ID or its joint")

    @property
    def outcome(self) -> Outcome:
        return EXPECTED[self.kind] if self.expect is None else Outcome(self.expect)

    @property
    def amount(self) -> float:
        """`value`, or what is usual for the kind."""
        return _VALUES.get(self.kind, 0.0) if self.value is None else self.value


@dataclass(frozen=True)
class Scenario:
    """Faults and the seed of their dice."""

    faults: tuple[Fault, ...] = ()
    seed: int = 0


def load_scenario(path: str | Path) -> Scenario:
    """Load a scenario. Raises ConfigError naming file, line and key."""
    return load_yaml(Path(path), Scenario)


def servo_id(robot: Robot, servo: int | str) -> int:
    """ID of a servo that a fault names by ID or by joint. Raises ConfigError."""
    if isinstance(servo, int):
        known = [joint.id for joint in robot.joints]
        if servo not in known:
            raise ConfigError(f"fault: no servo of {robot.name} has ID {servo}; known: {sorted(known)}")
        return servo
    for joint in robot.joints:
        if joint.name == servo:
            return joint.id
    raise ConfigError(f"fault: {robot.name} has no joint '{servo}'; {nearest(servo, robot.names)}")


@dataclass
class Chunk:
    """Bytes that one device sends, with the silence before them [s]."""

    data: bytes
    wait: float = 0.0


@dataclass
class FaultInjector:
    """Which faults strike when. `struck` counts by kind and servo ID (0 where no servo is concerned)."""

    robot: Robot
    scenario: Scenario
    origin_ns: int = 0  # rig time at which the scenario's time begins
    struck: dict[tuple[str, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._faults: list[tuple[Fault, int]] = []
        self._rng = generator(self.scenario.seed, Stream.FAULTS)
        self.pending: list[tuple[float, bool, Fault, int]] = []  # time, whether it begins, of what has yet to happen
        for fault in self.scenario.faults:
            self.add(fault)

    def add(self, fault: Fault) -> None:
        """Schedule a fault. Raises ConfigError for an unknown servo."""
        id = 0 if fault.servo is None else servo_id(self.robot, fault.servo)
        if fault.kind in STATUS_KINDS or fault.kind in ("garbage", "split"):
            self._faults.append((fault, id))
        elif self._rng.random() < fault.probability:
            self.pending.append((fault.at, True, fault, id))
            if fault.until is not None:
                self.pending.append((fault.until, False, fault, id))
            self.pending.sort(key=lambda entry: entry[0])

    def seconds(self, now_ns: int) -> float:
        """Time of the scenario."""
        return (now_ns - self.origin_ns) * 1e-9

    def due(self, now_ns: int) -> list[tuple[bool, Fault, int]]:
        """Faults that begin (True) or end (False) by now."""
        seconds = self.seconds(now_ns)
        due = [(begins, fault, id) for at, begins, fault, id in self.pending if at <= seconds]
        self.pending = [entry for entry in self.pending if entry[0] > seconds]
        for begins, fault, id in due:
            if begins:
                self.count(fault.kind, id)
        return due

    def count(self, kind: str, id: int) -> None:
        self.struck[kind, id] = self.struck.get((kind, id), 0) + 1

    def strikes(self, kinds: tuple[str, ...], id: int, now_ns: int) -> Fault | None:
        """The first fault of these kinds that strikes servo `id` now, if any; dice are rolled."""
        seconds = self.seconds(now_ns) if self._faults else 0.0
        for fault, servo in self._faults:
            if fault.kind not in kinds or servo not in (0, id):
                continue
            active = fault.at <= seconds < (math.inf if fault.until is None else fault.until)
            if active and self._rng.random() < fault.probability:
                self.count(fault.kind, id)
                return fault
        return None

    def noise(self, count: int) -> bytes:
        """Random bytes."""
        return self._rng.bytes(count)

    def misspeak(self, fault: Fault, status: codec.Status) -> codec.Status:
        """What a servo says instead of `status`, with a good checksum; by another fault it is left as it is."""
        if fault.kind == "wrong_id":
            return status._replace(id=(status.id + 1) % codec.MAX_ID)
        if fault.kind == "error_status":
            return status._replace(error=int(fault.amount), data=b"")
        return status

    def spoil(self, fault: Fault, frame: bytes) -> list[Chunk]:
        """What goes over the wire instead of `frame`, the status of a servo or its part of a fast frame."""
        spot = int(self._rng.integers(0, max(len(frame), 1)))
        if fault.kind == "drop":
            return []
        if fault.kind == "late":
            return [Chunk(frame, fault.amount)]
        if fault.kind == "truncate":
            return [Chunk(frame[:spot])]
        if fault.kind == "duplicate":
            return [Chunk(frame), Chunk(frame)]
        flipped = bytearray(frame)
        flipped[spot] ^= 1 << int(self._rng.integers(0, 8))
        return [Chunk(bytes(flipped))]
