"""Goals, gains and torque to the servos. Torque comes on only where the servo already is, and off until it says so."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

import numpy as np

from servoid.hw.contracts.body import Array, BackendError, Command, Mode
from servoid.hw.dynamixel.guardian_client import Lifeline
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import SyncWriter
from servoid.hw.dynamixel.protocol.units import EXTENDED_MAX, Units
from servoid.hw.dynamixel.servos import arming
from servoid.hw.dynamixel.servos.register_check import Found
from servoid.hw.dynamixel.servos.servo_monitor import ServoMonitor
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.faults import describe

WATCHDOG = 4  # of 20 ms: a servo that hears nothing for so long stops by itself
TRIES = 4  # to switch torque, at least, before it is an error
OFF_SECONDS, ON_SECONDS = 0.25, 0.1  # and for how long: a host or an adapter may be held up meanwhile
OUTSIDE = 12  # ticks (1 degree) that a joint may be beyond its servo's limits when torque comes on
AWAY = 68  # ticks (6 degrees) that a joint may have moved since it was read, for its first goal is gone to at once
_GAINS = struct.Struct("<HHH")  # D, I, P in the order of their registers


class TorqueUnproven(BackendError):
    """Servos did not say in time that their torque is off. They may say it later, before a person reads of it."""

    def __init__(self, names: str) -> None:
        super().__init__(f"{names} did not report that torque is off: hold the robot and switch its power off")
        self._names = names

    def settle(self, how: str) -> None:
        """They did."""
        self.args = (f"{self._names} were late to say that torque is off: it is off now, {how}",)


class DynamixelMotors:
    """The writing half of the backend."""

    def __init__(
        self,
        bus: Bus,
        found: Sequence[Found],
        units: Units,
        monitor: ServoMonitor,
        present: GroupRead,
        lifeline: Lifeline | None = None,
    ) -> None:
        """`present` is the group of the control cycle, at whose positions torque comes on. `lifeline` is told of
        torque; without one nothing but the servos' watchdog stops them when this process is killed."""
        table = found[0].table
        self._bus, self._found, self._units, self._monitor, self._present = bus, found, units, monitor, present
        self._lifeline = lifeline
        self._ids = [servo.joint.id for servo in found]
        self._goal = table.item("goal_position")
        self._torque, self._watchdog = table.item("torque_enable"), table.item("bus_watchdog")
        self._d_gain = table.item("position_d_gain")
        self._goals = SyncWriter(self._ids, self._goal.address, self._goal.width, signed=True)
        self._default_d = [servo.table.item("position_d_gain").default or 0 for servo in found]
        self._default_i = [servo.table.item("position_i_gain").default or 0 for servo in found]
        self._unproven: list[TorqueUnproven] = []
        self._gain: Array | None = None  # P gains that were sent last
        self.on = any(servo.get("torque_enable") for servo in found)  # torque may be on
        if self.on and lifeline is not None:
            lifeline.hold()

    @property
    def armed(self) -> bool:
        """Whether torque was switched on by this program."""
        return self._monitor.armed

    def write(self, command: Command) -> None:
        """Send a command. Raises BackendError, naming the joints, where torque does not go on or off, and where a joint
        was moved between the reading that a first command goes out from and torque."""
        if command.mode is Mode.OFF:
            self.off()
        elif command.mode is Mode.DAMP:
            if self.armed:  # a limp robot is not made stiff to be damped
                self._send_gains(np.zeros(len(self._ids), dtype=int), damped=True)
        else:
            gain, goals = self._units.gain(command.gain), self._units.goal(command.position)
            if not self.armed:
                self._arm(gain, goals)
            elif self._lifeline is not None:
                self._lifeline.check()
            if self._gain is None or not np.array_equal(gain, self._gain):
                self._send_gains(gain)
            self._bus.send(self._goals.packet(goals.tolist()))

    def off(self) -> None:
        """Torque off, asked again of those that do not say that it is. Raises BackendError naming them."""
        left = list(range(len(self._ids)))
        for _ in self._attempts(OFF_SECONDS):
            self._write(self._watchdog.address, left, [b"\0"] * len(left))
            self._write(self._torque.address, left, [b"\0"] * len(left))
            left = self._unconfirmed(left, b"\0")
            if not left:
                self.proven("acknowledged")
                self._gain = None
                self._monitor.expect(False)
                if self._lifeline is not None:
                    self._lifeline.let_go()
                return
        self._unproven.append(TorqueUnproven(self._names(left)))
        raise self._unproven[-1]

    def proven(self, how: str) -> None:
        """Every servo has said that its torque is off, and errors that were raised before must not say otherwise."""
        self.on = False
        while self._unproven:
            self._unproven.pop().settle(how)

    def _arm(self, gain: Array, wanted: Array) -> None:
        """Torque on without a jump: goal at the present position, then gains, all checked before torque.

        `wanted` `(n_joints,)` are the goal ticks that will be sent next.
        """
        everyone = list(range(len(self._ids)))
        if broken := [i for i in everyone if self._monitor.fault[i] & 0xFF]:
            reasons = ", ".join(describe(int(self._monitor.fault[broken[0]]) & 0xFF))
            raise BackendError(f"{self._names(broken)} reports {reasons}: let it cool, then switch it off and on")
        if self._lifeline is not None:
            self._lifeline.hold()  # first, as it may wait for seconds, in which a limp robot moves
        self.on = True
        goals = self._goals_here()
        if moved := np.flatnonzero(np.abs(goals - wanted) > AWAY).tolist():
            raise BackendError(
                f"{self._names(moved)} moved before torque was on: support the robot, hold it still and start again"
            )
        self._monitor.expect(False)
        self._gain = None
        self._prepare(goals, gain)
        left = everyone
        for _ in self._attempts(ON_SECONDS):
            self._write(self._torque.address, left, [b"\1"] * len(left))
            self._write(self._watchdog.address, left, [bytes([WATCHDOG])] * len(left))
            left = self._unconfirmed(left, b"\1", bytes([WATCHDOG]))
            if not left:
                self._monitor.expect(True)
                return
        names = self._names(left)
        self.off()
        raise BackendError(f"{names} did not switch torque on: does it report an error? Switch its power off and on")

    def _prepare(self, goals: Array, gain: Array) -> None:
        """Write what RAM must hold before torque, and read it back. Raises BackendError naming what was not taken."""
        motion = [arming.motion(goal) for goal in goals.tolist()]
        strength = [arming.strength(servo, each) for servo, each in zip(self._found, gain.tolist(), strict=True)]
        both = [{**first, **then} for first, then in zip(motion, strength, strict=True)]
        places = [{"goal_position": goal} for goal in goals.tolist()]
        for _ in self._attempts(ON_SECONDS):
            self._set(motion)
            wrong = self._differing(places, (self._goal.address, self._goal.width))
            if not any(wrong):  # with torque on already, gains would pull at once to a goal that is not from here
                self._set(strength)
                wrong = self._differing(both, arming.span(self._found[0].table))
            if not any(wrong):
                self._gain = gain
                return
        unready = [i for i, registers in enumerate(wrong) if registers]
        raise BackendError(
            f"{self._names(unready)} did not take {', '.join(wrong[unready[0]])}: torque stays off; switch its power "
            "off and on"
        )

    def _set(self, values: Sequence[arming.Values]) -> None:
        for packet in arming.packets(self._found, values):
            self._bus.send(packet)

    def _differing(self, values: Sequence[arming.Values], place: tuple[int, int]) -> list[list[str]]:
        """Of each joint, the registers that do not read back; `place` is the address and length of what is read."""
        group = GroupRead([(id, *place) for id in self._ids])
        self._bus.sync_read(group)
        return [
            arming.differing(servo, wanted, data, place[0])
            for servo, wanted, data in zip(self._found, values, group.data, strict=True)
        ]

    def _attempts(self, seconds: float) -> Iterator[int]:
        """Counts attempts: TRIES at least, and for at least so long."""
        clock = self._bus.clock
        end = clock.now_ns() + round(seconds * 1e9)
        attempt = 0
        while attempt < TRIES or clock.now_ns() < end:
            yield attempt
            attempt += 1

    def _goals_here(self) -> Array:
        """Goal ticks `(n_joints,)` at the position of now, within a turn and the servo's own limits."""
        for _ in self._attempts(ON_SECONDS):
            self._bus.sync_read(self._present)
            if all(self._present.fresh):
                break
        if lost := [i for i, fresh in enumerate(self._present.fresh) if not fresh]:
            raise BackendError(f"{self._names(lost)} did not report its position: torque stays off")
        turned = [int.from_bytes((data or b"")[-4:], "little", signed=True) for data in self._present.data]
        here = self._units.within_turn(np.array(turned))
        lower = np.array([servo.get("min_position_limit") for servo in self._found])
        upper = np.array([servo.get("max_position_limit") for servo in self._found])
        lower = np.where(self._units.extended, -EXTENDED_MAX, lower)
        upper = np.where(self._units.extended, EXTENDED_MAX, upper)
        outside = np.flatnonzero((here < lower - OUTSIDE) | (here > upper + OUTSIDE))
        if outside.size:
            raise BackendError(f"{self._names(outside.tolist())} is beyond its servo's limits: move it by hand")
        goals: Array = np.clip(here, lower, upper)
        return goals

    def _send_gains(self, gain: Array, *, damped: bool = False) -> None:
        d = [0] * len(self._ids) if damped else self._default_d
        i = [0] * len(self._ids) if damped else self._default_i
        values = [_GAINS.pack(*each) for each in zip(d, i, gain.tolist(), strict=True)]
        self._write(self._d_gain.address, range(len(self._ids)), values)
        self._gain = None if damped else gain

    def _write(self, address: int, joints: Sequence[int], values: Sequence[bytes]) -> None:
        data = {self._ids[i]: value for i, value in zip(joints, values, strict=True)}
        self._bus.send(codec.sync_write(address, len(values[0]), data))

    def _unconfirmed(self, joints: Sequence[int], torque: bytes, watchdog: bytes | None = None) -> list[int]:
        """Of `joints`, those whose torque enable (and watchdog) does not read back."""
        start = self._torque.address
        end = self._watchdog.end if watchdog else self._torque.end
        group = GroupRead([(self._ids[i], start, end - start) for i in joints])
        self._bus.sync_read(group)
        return [
            i
            for i, data in zip(joints, group.data, strict=True)
            if data is None or data[:1] != torque or (watchdog is not None and data[-1:] != watchdog)
        ]

    def _names(self, joints: Sequence[int]) -> str:
        return ", ".join(f"{self._found[i].joint.name} (ID {self._ids[i]})" for i in joints)
