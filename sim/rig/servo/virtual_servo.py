"""A virtual servo: what its registers mean to the motor, and what the motor's state means to its registers."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from servoid.hw.dynamixel.protocol.codec import StatusError
from servoid.hw.dynamixel.protocol.tables import Item, table
from servoid.sim.rig.servo.device import VirtualDevice
from servoid.sim.rig.servo.factory_state import ticks_per_turn
from servoid.sim.rig.servo.firmware import CURRENT, CURRENT_POSITION, EXTENDED, FULL_PWM, POSITION, PWM
from servoid.sim.rig.servo.motor_bank import MotorBank

FIRMWARE = 52  # the newest that changed anything in the tables
_HOMING_RANGE = 1024  # ticks that count in position mode
_TURNS_RANGE = 1_048_575  # ticks of the modes that count turns
_REVERSE, _TIME_BASED, _TORQUE_BY_GOAL = 1, 4, 8  # bits of the drive mode
_STEP, _RECTANGLE, _TRAPEZOID = 0x00, 0x10, 0x30  # profile bits of the moving status
_STARTUP_TORQUE = 1  # bit of the startup configuration
_PROTOCOLS = (1, 2, 20, 21, 22)  # 1.0, 2.0 and those of remote controls, which fall back to 2.0 where they hear none
_TRIPPED = 255  # what an expired bus watchdog reads
_GOALS = ("goal_position", "goal_velocity", "goal_current", "goal_pwm")
_MEASURED = struct.Struct("<HBBhhiiiiHB")  # registers 120 to 146, laid out alike in every model
_MEASURED_AT = 120
_ARRIVED = 20  # ticks from the reference
_RECORDED = (*_GOALS, "torque_enable", "position_p_gain")
_MODE_RESETS = (  # registers that go back to their defaults with a new operating mode
    "velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain",
    "feedforward_2nd_gain", "feedforward_1st_gain", "profile_acceleration", "profile_velocity",
)  # fmt: skip


OnAccepted = Callable[[int, str, int, float, int], None]  # joint, register, value, goal angle [rad] or NaN, time [ns]


class VirtualServo(VirtualDevice):
    """Servo `index` of the rig's motors."""

    def __init__(
        self,
        motors: MotorBank,
        index: int,
        model: int | str,
        eeprom: dict[str, int],
        accepted: OnAccepted | None = None,
    ) -> None:
        """`accepted` is told of every write to a goal, the torque or the P gain that the servo took, and of the 255
        that an expired watchdog writes to its register."""
        self.motors, self.index, self._accepted = motors, index, accepted
        self.stuffed = False  # a fault: current and velocity that need byte stuffing on the wire
        self._base = 0  # ticks of whole turns that do not count
        self._watch_ns: int | None = None  # when the bus was last heard, with torque on and the watchdog set
        self._locked_out = False  # by a shutdown, until reboot
        self._started_ns = 0
        self._starts_torque = False  # once it has booted
        super().__init__(table(model), {"firmware_version": FIRMWARE, **eeprom})
        items = self.table
        self._tick = items.item("present_position").scale
        self._turn = ticks_per_turn(items)
        self._centre = self._turn // 2  # tick of angle 0
        self._speed = items.item("present_velocity").scale
        self._acceleration = items.item("profile_acceleration").scale
        self._voltage = items.item("present_input_voltage").scale
        self._has_current = "goal_current" in items
        self._seen = -1  # physics step that the measuring registers show
        self._ampere = items.item("present_current").scale if self._has_current else 1.0
        self.restarted(0)

    # From registers to the motor

    @property
    def torque(self) -> bool:
        return bool(self.get("torque_enable"))

    @property
    def mode(self) -> int:
        return self.get("operating_mode")

    @property
    def tripped(self) -> bool:
        """Whether the bus watchdog has expired."""
        return self.get("bus_watchdog") == _TRIPPED

    def angle_of(self, ticks: int) -> float:
        """Encoder angle [rad] of a position in the servo's own count."""
        return (self._sign * (ticks - self._homing - self._centre) + self._base) * self._tick

    def ticks_of(self, angle: float) -> int:
        """The servo's count of an encoder angle [rad]."""
        return self._sign * (round(angle / self._tick) - self._base) + self._centre + self._homing

    def allowed(self, item: Item, value: int) -> StatusError:
        if item.eeprom and self.torque:
            return StatusError.ACCESS
        if item.name == "operating_mode" and value not in self.table.modes:
            return StatusError.DATA_RANGE
        if item.name == "protocol_type" and value not in _PROTOCOLS:
            return StatusError.DATA_RANGE
        if item.name in _GOALS and self.tripped:
            return StatusError.DATA_RANGE
        if item.name == "bus_watchdog" and self.tripped and value:
            return StatusError.DATA_RANGE
        if item.name == "torque_enable" and value and self._locked_out:
            return StatusError.ACCESS
        if item.name == "goal_position" and self.mode != POSITION:
            return StatusError.NONE if abs(value) <= _TURNS_RANGE else StatusError.DATA_LIMIT
        return self.in_range(item, value)

    def changed(self, item: Item, value: int, now_ns: int) -> None:
        name = item.name
        if self._accepted is not None and name in _RECORDED:
            angle = self.angle_of(value) if name == "goal_position" else math.nan
            self._accepted(self.index, name, value, angle, now_ns)
        if name == "torque_enable":
            self._torque(bool(value), now_ns)
        elif name == "bus_watchdog":
            self.motors.firmware.halted[self.index] = False
            self._watch_ns = now_ns if value and self.torque else None
        elif name == "operating_mode":
            self._new_mode()
        elif name in _GOALS:
            if self.get("drive_mode") & _TORQUE_BY_GOAL and not self.torque and not self._locked_out:
                self.put("torque_enable", 1)
                self._torque(True, now_ns)
            self._submit(name, value, now_ns)
        elif not name.startswith("indirect"):
            self._configure()

    def _submit(self, name: str, value: int, now_ns: int) -> None:
        if name == "goal_position":
            goal = self.angle_of(value)
        elif name == "goal_velocity":
            goal = self._sign * value * self._speed
        elif name == "goal_current":
            goal = self._sign * value * self._ampere
        else:
            goal = self._sign * value / FULL_PWM
        self.motors.firmware.submit(self.index, name, goal, now_ns)

    def _torque(self, on: bool, now_ns: int) -> None:
        firmware, i = self.motors.firmware, self.index
        if on and not firmware.powered[i]:
            self._collapse()
            firmware.flush(i, float(self.motors.angle[i]))
        firmware.powered[i] = on
        self._watch_ns = now_ns if on and 0 < self.get("bus_watchdog") < _TRIPPED else None
        self._configure()

    def _collapse(self) -> None:
        """In position mode only a position within the turn is known."""
        if self.mode == POSITION and (whole := self._whole_turns()) != self._base:
            self._base, self._seen = whole, -1
            self._goals_from_registers()

    def _whole_turns(self) -> int:
        """Ticks of the turns that the motor has made."""
        ticks = round(float(self.motors.angle[self.index]) / self._tick) + self._centre
        return math.floor(ticks / self._turn) * self._turn

    def _new_mode(self) -> None:
        for name in _MODE_RESETS:
            self.put(name, self.table.item(name).default or 0)
        self._configure()
        self._collapse()
        self._default_goals()

    def _default_goals(self) -> None:
        """Goals that move nothing: what drives the motor is zero or where it is, what limits it is at its limit."""
        self.put("goal_pwm", 0 if self.mode == PWM else self.get("pwm_limit"))
        self.put("goal_velocity", 0)
        if self._has_current:
            self.put("goal_current", 0 if self.mode == CURRENT else self.get("current_limit"))
        self.put("goal_position", self.ticks_of(float(self.motors.angle[self.index])))
        self._goals_from_registers()

    def _goals_from_registers(self) -> None:
        """Take the goals over at once: nothing is underway after a restart or a change of mode."""
        for name in _GOALS:
            if name in self.table:
                self._submit(name, self.get(name), 0)
        self.motors.firmware.flush(self.index, float(self.motors.angle[self.index]))

    def _configure(self) -> None:
        """Hand gains, limits and profile to the firmware."""
        f, i = self.motors.firmware, self.index
        self._seen = -1
        self._threshold = self.get("moving_threshold")
        self._sign = -1 if self.get("drive_mode") & _REVERSE else 1
        offset = self.get("homing_offset")
        self._homing = max(-_HOMING_RANGE, min(_HOMING_RANGE, offset)) if self.mode == POSITION else offset
        f.mode[i] = self.mode
        f.p[i], f.i[i], f.d[i] = (self.get(f"position_{gain}_gain") for gain in "pid")
        f.ff_velocity[i] = self.get("feedforward_1st_gain")
        f.velocity_p[i] = self.get("velocity_p_gain") / 128 / FULL_PWM / self._speed
        f.velocity_i[i] = self.get("velocity_i_gain") / 65536 / FULL_PWM / self._speed / 0.001
        f.pwm_limit[i] = self.get("pwm_limit") / FULL_PWM
        if self._has_current:
            f.current_limit[i] = self.get("current_limit") * self._ampere
        f.temperature_limit[i] = self.get("temperature_limit")
        limits = self.get("min_voltage_limit"), self.get("max_voltage_limit")
        f.voltage_range[i] = [limit * self._voltage for limit in limits]
        velocity, acceleration = self.get("profile_velocity"), self.get("profile_acceleration")
        self._profile = _STEP if not velocity else _TRAPEZOID if acceleration else _RECTANGLE
        if self.get("drive_mode") & _TIME_BASED:
            f.profile_time[i], f.profile_ramp[i] = velocity / 1000, acceleration / 1000
            f.profile_velocity[i] = f.profile_acceleration[i] = math.inf
        else:
            f.profile_time[i] = math.nan
            capped = min(velocity, self.get("velocity_limit"))
            f.profile_velocity[i] = capped * self._speed if velocity else math.inf
            f.profile_acceleration[i] = acceleration * self._acceleration if acceleration else math.inf

    # From the motor to registers

    def refresh(self, now_ns: int) -> None:
        steps = self.motors.steps
        if steps == self._seen:
            return
        self._seen = steps
        now = self.motors.samples[self.index]
        sign = self._sign
        speed = sign * round(now.speed / self._speed)
        if not self._has_current:
            current = sign * round(now.duty * 1000)
        elif self.table.motor_current:
            current = sign * round(now.current / self._ampere)
        else:  # of the supply
            current = sign * round(now.duty * abs(now.current) / self._ampere)
        if self.stuffed and self._has_current:
            current, speed = -1, -3
        position, reference = self.ticks_of(now.angle), self.ticks_of(now.reference)
        moving = abs(speed) > self._threshold
        arrived = abs(position - reference) <= _ARRIVED and not moving
        _MEASURED.pack_into(
            self.memory,
            _MEASURED_AT,
            (now_ns - self._started_ns) // 1_000_000 % 32768,
            moving,
            int(arrived) | int(now.underway) << 1 | self._profile,
            sign * round(now.duty * FULL_PWM),
            max(-32768, min(32767, current)),
            speed,
            position,
            sign * round(now.reference_speed / self._speed),
            reference,
            round(self.motors.supply / self._voltage),
            min(round(now.temperature), 255),
        )

    # Protections and restarts

    def alert(self) -> bool:
        return self.get("hardware_error_status") != 0

    def heard(self, now_ns: int) -> None:
        if self._watch_ns is not None:
            self._watch_ns = now_ns

    def guard(self, now_ns: int) -> None:
        """What the firmware checks between packets: the bus watchdog, errors, and the shutdown that they cause."""
        if self._starts_torque and self.online(now_ns):
            self._starts_torque = False
            self._default_goals()
            self.put("torque_enable", 1)
            self._torque(True, now_ns)
        error = int(self.motors.firmware.error[self.index])
        if error:
            error |= self.get("hardware_error_status")
            self.put("hardware_error_status", error)
            if error & self.get("shutdown"):
                self._locked_out = True
                if self.torque:
                    self.torque_off()
        if self._watch_ns is not None and now_ns - self._watch_ns > self.get("bus_watchdog") * 20_000_000:
            self.trip()
            if self._accepted is not None:
                self._accepted(self.index, "bus_watchdog", _TRIPPED, math.nan, now_ns)

    def trip(self) -> None:
        """The bus watchdog expires: the motor stops, the profile is gone, goals are refused."""
        self._watch_ns = None
        self.put("bus_watchdog", _TRIPPED)
        self.put("profile_velocity", 0)
        self.put("profile_acceleration", 0)
        self._configure()
        self.motors.firmware.halt(self.index, float(self.motors.angle[self.index]))

    def kill(self, dead: bool, now_ns: int) -> None:
        """Die, or come back as from a power cycle."""
        self.power(not dead, now_ns)
        self.dead = dead

    def torque_off(self) -> None:
        """Lose torque without having been asked to."""
        self.put("torque_enable", 0)
        self._torque(False, 0)

    def clear(self, now_ns: int) -> StatusError:
        """Forget whole turns. A servo that moves refuses."""
        self.refresh(now_ns)
        if self.get("moving"):
            return StatusError.RESULT
        self._base, self._seen = self._whole_turns(), -1
        if self.mode in (EXTENDED, CURRENT_POSITION):
            self._default_goals()
        return StatusError.NONE

    def restarted(self, now_ns: int) -> None:
        firmware, i = self.motors.firmware, self.index
        firmware.powered[i] = firmware.halted[i] = False
        firmware.error[i] = 0
        self._watch_ns, self._locked_out, self._started_ns = None, False, now_ns
        self._starts_torque = bool(self.startup & _STARTUP_TORQUE)
        self._base = self._whole_turns()
        self._configure()
        self._default_goals()
