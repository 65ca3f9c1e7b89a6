"""A virtual rig: servos and board on a wire, moved by physics, under faults; its time advances when it is told to.

Events happen in order of time, physics before the bus at the same instant, so that two runs of the same bytes at the
same times are the same.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from servoid.hw.config import nearest
from servoid.hw.contracts.body import Array
from servoid.hw.imu.mounting import Mounting
from servoid.hw.robot.description import Robot
from servoid.sim.rig.servo.board import VirtualBoard
from servoid.sim.rig.servo.duplicate_id import DuplicateId
from servoid.sim.rig.servo.factory_state import FactoryState
from servoid.sim.rig.servo.motor_bank import STEP_NS, MotorBank
from servoid.sim.rig.servo.plant import Plant
from servoid.sim.rig.servo.virtual_servo import VirtualServo
from servoid.sim.rig.wire.dispatcher import Dispatcher
from servoid.sim.rig.wire.faults import ALERTS, Fault, FaultInjector, Scenario
from servoid.sim.rig.wire.half_duplex import Wire

BROWN_OUT, BOARD_BROWN_OUT = 0.5, 0.375  # of its servo's nominal voltage, below which a servo or the board is dead
_BROWN_OUT_FAULT = 5.5 / 12.0  # of the nominal voltage, where the scenario does not say
_LONGEST_BROWN_OUT = 0.05  # s, when the scenario does not say
_REMEMBERED = 200_000  # accepted writes that are kept for whoever asks: 200 s of 20 goals 50 times a second
_BABBLE = 0.8  # share of the line that a babbling device fills


@dataclass(frozen=True, slots=True)
class Accepted:
    """A write that a servo took: a goal, torque or P gain. `position` is a goal position's joint angle [rad]."""

    time_ns: int
    joint: int
    register: str
    value: int
    position: float


class Rig:
    """The rig of `robot`. Time begins at 0; the robot is held in its home pose until all servos have torque.

    Raises ConfigError for a servo that is no known Dynamixel, and for a fault or factory state of an unknown one.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        seed: int = 0,
        randomise: bool = False,
        scenario: Scenario | None = None,
        factory_state: FactoryState | None = None,
    ) -> None:
        self.factory_state, self.scenario = factory_state or FactoryState(), scenario or Scenario()
        if robot.bus.board == "none":
            self.factory_state = replace(self.factory_state, board=False)
        self.factory_state.check(robot)
        robot = self.robot = self.factory_state.assembled(robot, seed)
        self.plant = Plant(robot)
        self.motors = MotorBank(robot, self.plant)
        self.now_ns = 0
        self.wire = Wire()
        self.reset(seed, randomise=randomise)

    def reset(self, seed: int, *, randomise: bool = False) -> None:
        """A rig as delivered, its power off, held at home; time goes on, faults begin anew."""
        self.plant.reset(seed, randomise=randomise)
        self.motors.reset()
        self.auto_release = True  # onto its feet as soon as all servos have torque
        baud, self.wire = self.wire.host_baud, Wire()
        self.wire.host_baud = baud
        self.injector = FaultInjector(self.robot, self.scenario, self.now_ns)
        self.dispatcher = Dispatcher(self.wire, self.injector)
        self.port_open, self.stalled, self.skew_ns = True, False, 0
        self._echo = self._babbles = self._cut = False
        self._next_step_ns = (self.now_ns // STEP_NS + 1) * STEP_NS
        self._held_back: list[tuple[int, bytes]] = []
        self.accepted: deque[Accepted] = deque(maxlen=_REMEMBERED)
        self.forgotten = 0  # accepted writes that nobody asked for in time
        self.servos = [
            VirtualServo(self.motors, i, servo.model_number, eeprom, self._record)
            for i, (servo, eeprom) in enumerate(
                zip(self.robot.servos, self.factory_state.eeprom(self.robot), strict=True)
            )
        ]
        unplugged = self.factory_state.unplugged(self.robot.names)
        for servo, name in zip(self.servos, self.robot.names, strict=True):
            servo.dead = name in unplugged
        self._least = [BROWN_OUT * servo.voltage for servo in self.robot.servos]
        self._board_least = BOARD_BROWN_OUT * self.robot.servos[0].voltage
        codes = self.servos[0].table.bauds
        board = {"id": self.robot.bus.board_id, "baud_rate": codes.index(self.factory_state.bus_baud(self.robot))}
        mounting = Mounting(self.robot.imu.signs, self.robot.imu.mounting)
        self.board = VirtualBoard(self.motors, board, self._switch, mounting)
        self._switch(False)
        self.dispatcher.devices = [*self.servos, self.board] if self.factory_state.board else [*self.servos]
        if self.factory_state.powered or not self.factory_state.board:
            self.board.put("dynamixel_power", 1)
            self._switch(True)

    def _record(self, joint: int, register: str, value: int, angle: float, now_ns: int) -> None:
        if math.isfinite(angle):
            angles = np.zeros(len(self.servos))
            angles[joint] = angle
            angle = float(self.motors.joint_of(angles)[joint])
        self.forgotten += len(self.accepted) == _REMEMBERED
        self.accepted.append(Accepted(now_ns, joint, register, value, angle))

    def _switch(self, on: bool) -> None:
        for servo in self.servos:
            if not servo.dead:
                servo.power(on, self.now_ns)

    @property
    def seconds(self) -> float:
        """Time since the rig began or was reset."""
        return self.injector.seconds(self.now_ns)

    # Time

    def host_sends(self, data: bytes) -> None:
        """Bytes that the host's program wrote now."""
        if data:
            self.wire.host_sends(data, self.now_ns)

    def next_delivery(self) -> int | None:
        """When the host will next hear something, as far as is known."""
        times = [at for at, _ in self._held_back[:1]]
        wire = self.wire.next_delivery()
        return min([*times, wire]) if wire is not None else min(times, default=None)

    def next_event(self) -> int:
        """When something happens next."""
        others = (self.wire.next_instruction(), self.next_delivery())
        return min([self._next_step_ns, *(at for at in others if at is not None)])

    def advance(self, to_ns: int) -> bytes:
        """Live until `to_ns`. Returns what the adapter handed to the host meanwhile."""
        heard = bytearray()
        while (at := self.next_event()) <= to_ns:
            self.now_ns = max(at, self.now_ns)
            instruction = self.wire.next_instruction()
            if self._next_step_ns <= at:
                self._step()
            elif instruction is not None and instruction <= at:
                sent = self.wire.take_instruction()
                if self._echo:
                    self._held_back.append((self.now_ns, bytes(sent.data)))
                self.dispatcher.receive(bytes(sent.data), sent.baud, self.now_ns)
            else:
                for data in self._deliver():
                    heard += data
        self.now_ns = max(to_ns, self.now_ns)
        return bytes(heard)

    def _step(self) -> None:
        begins = self._next_step_ns - STEP_NS
        self._next_step_ns += STEP_NS
        self.motors.step(begins)
        for servo in self.servos:
            servo.guard(self.now_ns)
        self._supply()
        for begins_now, fault, id in self.injector.due(self.now_ns):
            self._fault(begins_now, fault, id)
        if self._babbles:
            count = round(_BABBLE * STEP_NS * 1e-9 * self.wire.host_baud / 10)
            self.wire.device_sends(self.injector.noise(count), self.now_ns, self.wire.host_baud, self.now_ns)
        if self.plant.held and self.auto_release and self.motors.firmware.powered.all():
            self.plant.release()

    def _supply(self) -> None:
        """Devices lose power when the battery's voltage breaks down, each below its own limit."""
        supply = self.motors.supply
        if supply >= min(self._least):
            self.board.power(True, self.now_ns)
        elif supply < self._board_least and self.factory_state.board:
            self.board.power(False, self.now_ns)
        on = bool(self.board.get("dynamixel_power"))
        for servo, least in zip(self.servos, self._least, strict=True):
            if not servo.dead and (on or supply < least):
                servo.power(supply >= least, self.now_ns)

    def _deliver(self) -> Iterator[bytes]:
        data, fresh = b"", self.wire.take_delivery(self.now_ns)
        while self._held_back and self._held_back[0][0] <= self.now_ns:
            data += self._held_back.pop(0)[1]
        if len(fresh) > 1 and self.injector.strikes(("split",), 0, self.now_ns) is not None:
            middle = len(fresh) // 2
            self._held_back.append((self.now_ns + 1_000_000, fresh[middle:]))
            fresh = fresh[:middle]
        data += fresh
        if self._cut and data:
            data, self.port_open = data[: len(data) // 2], False
        if not self.stalled:
            yield data

    # Faults

    def inject(self, fault: Fault) -> None:
        """Add a fault to the scenario; its times count from the rig's beginning or reset. Raises ConfigError."""
        self.injector.add(fault)

    def _fault(self, begins: bool, fault: Fault, id: int) -> None:
        """Begin or end a fault that is a state."""
        kind = fault.kind
        servo = next((s for s, joint in zip(self.servos, self.robot.joints, strict=True) if joint.id == id), None)
        if servo is not None:
            self._servo_fault(begins, fault, servo)
        elif kind == "stuffed":
            for each in self.servos:
                each.stuffed = begins
        elif kind == "echo":
            self._echo = begins
        elif kind == "babble":
            self._babbles = begins
        elif kind == "batching":
            self.wire.adapter_ns = round(fault.amount * 1e9) if begins else 0
        elif kind == "imu_dead":
            self.board.imu_dead = begins
        elif kind == "imu_frozen":
            self.board.imu_frozen = begins
        elif kind == "button":
            self.board.buttons = int(fault.amount) if begins else 0
        elif kind == "vanish":
            self.port_open = not begins
        elif kind == "vanish_in_read":
            self._cut, self.port_open = begins, self.port_open or not begins
        elif kind == "stall":
            self.stalled = begins
        elif kind == "clock_step" and begins:
            self.skew_ns += round(fault.amount * 1e9)
        elif kind == "brown_out":
            volts = _BROWN_OUT_FAULT * self.robot.servos[0].voltage if fault.value is None else fault.value
            self.motors.sag = self.motors.open_circuit - volts if begins else 0.0
            if begins and fault.until is None:
                end = self.seconds + _LONGEST_BROWN_OUT
                self.injector.pending = [(end, False, fault, id), *self.injector.pending]

    def _servo_fault(self, begins: bool, fault: Fault, servo: VirtualServo) -> None:
        kind, i, firmware = fault.kind, servo.index, self.motors.firmware
        if kind in ALERTS:
            if not begins:
                firmware.injected[i] &= ~ALERTS[kind]
            elif fault.until is None:
                firmware.error[i] |= ALERTS[kind]
            else:
                firmware.injected[i] |= ALERTS[kind]
        elif kind == "stuffed":
            servo.stuffed = begins
        elif kind == "dead":
            servo.kill(begins, self.now_ns)
        elif kind == "baud_mismatch":
            other = next(c for c, baud in enumerate(servo.table.bauds) if baud != self.robot.bus.baud and baud >= 57600)
            servo.put("baud_rate", other if begins else servo.table.bauds.index(self.robot.bus.baud))
        elif kind == "id_conflict":
            self.dispatcher.devices = [
                device for device in self.dispatcher.devices if not isinstance(device, DuplicateId)
            ]
            if begins:
                eeprom = {name: servo.get(name) for name in ("id", "baud_rate", "return_delay_time")}
                self.dispatcher.devices.append(DuplicateId(servo.table.number, eeprom))
        elif begins and kind == "heat":
            firmware.winding[i] = firmware.case[i] = fault.amount
        elif begins and kind == "reboot":
            servo.reboot(self.now_ns)
        elif begins and kind == "torque_off":
            servo.torque_off()
        elif begins and kind == "watchdog":
            servo.trip()

    # What tests and evaluation may know

    def move(self, pose: dict[str, float]) -> None:
        """Move limp joints of the held robot by hand, to angles [rad]. Raises ValueError for a robot that stands on its
        own, and for joints that it has not or that have torque."""
        if not self.plant.held:
            raise ValueError("the robot is not held: it is again 3 s after all torque went off, or after a reset")
        for name in pose:
            if name not in self.robot.names:
                raise ValueError(f"{self.robot.name} has no joint '{name}'; {nearest(name, self.robot.names)}")
        stiff = [name for name, on in zip(self.robot.names, self.motors.firmware.powered, strict=True) if on]
        if held := [name for name in pose if name in stiff]:
            raise ValueError(f"{', '.join(held)}: the servo has torque and cannot be moved by hand")
        joints = self.plant.joints.copy()
        for name, angle in pose.items():
            joints[self.robot.names.index(name)] = angle
        self.place(joints)

    def place(self, pose: Array) -> None:
        """Pick the robot up and hold it at `pose` `(n_joints,)` rad."""
        self.plant.place(pose)
        self.motors.sense()

    def servo_states(self) -> list[dict[str, Any]]:
        """Each servo's torque, error, watchdog, gain and reachability, in the robot's joint order."""
        f = self.motors.firmware
        return [
            {
                "id": servo.id,
                "torque": servo.torque,
                "error": servo.get("hardware_error_status"),
                "tripped": servo.tripped,
                "position_p_gain": servo.get("position_p_gain"),
                "online": servo.online(self.now_ns),
                "temperature": float(f.winding[servo.index]),
                "speed": float(self.plant.joint_speed[servo.index]),
            }
            for servo in self.servos
        ]

    def take_accepted(self) -> list[dict[str, Any]]:
        """Writes that servos took since this was last asked or the rig reset, oldest first; `forgotten` begins anew."""
        taken = [asdict(entry) for entry in self.accepted]
        self.accepted.clear()
        self.forgotten = 0
        return taken
