"""What runs inside the servos several hundred times a second: profiles, control laws, limits and protections.

All servos of a rig at once, arrays `(n,)` in the robot's joint order, in the servos' own frame: angle 0 at the centre
tick, counting as the encoder does. Registers are the business of `servo`, physics that of `plant`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.faults import INPUT_VOLTAGE, OVERHEATING, OVERLOAD
from servoid.hw.robot.description import Servo
from servoid.sim.model import TIMESTEP

CURRENT, VELOCITY, POSITION, EXTENDED, CURRENT_POSITION, PWM = 0, 1, 3, 4, 5, 16

FULL_PWM = 885.0  # PWM counts of full duty
_SAMPLE = 0.001  # s, the firmware's own period, which its I and D gains are per
AMBIENT = 25.0  # degrees C
_WINDING_CAPACITY, _CASE_CAPACITY = 8.0, 70.0  # J/K: some 20 g of copper and iron; the rest of 82 g
_WINDING_TO_CASE, _CASE_TO_AIR = 3.5, 5.5  # K/W
_NO_RAMP = 1e9  # rad/s2: any speed within a step
_STALL_SECONDS = 1.0  # full output without motion for so long is an overload
_STALL_SPEED = 0.05  # of the no-load speed


@dataclass(frozen=True)
class _Pending:
    time_ns: int
    servo: int
    name: str
    value: float


class Firmware:
    """State and control laws of `n` servos. Angles rad, speeds rad/s, currents A, output as duty -1..1.

    Law (e-Manual, with the datasheet's gain replaced by the one identified for the servo): duty = Kp e + Ki integral
    of e + Kd de/dt + feed-forward of speed, limited by goal PWM, then by current, then by the supply. That of
    acceleration, the register `feedforward_2nd_gain`, has no effect.
    """

    def __init__(self, servos: tuple[Servo, ...], constant: Array, resistance: Array, delay: Array) -> None:
        """`constant` [V s/rad] and `resistance` [Ohm] are the motors'; `delay` [s] from each one's goal to torque."""
        n = self.n = len(servos)
        self._k, self._r, self._delay_ns = constant, resistance, np.round(delay * 1e9).astype(int).tolist()
        self.torque_per_ampere = np.array([servo.torque_per_ampere for servo in servos])
        self._no_load = np.array([servo.no_load_speed for servo in servos])
        self._stall = np.array([servo.stall_torque for servo in servos])
        nominal = np.array([servo.voltage for servo in servos])
        gain = np.array([servo.position_p_gain for servo in servos])
        self._nominal_unit = np.array([s.stiffness for s in servos]) * resistance / (constant * nominal * gain)
        self.unit = self._nominal_unit.copy()  # duty per rad and count of P gain
        # Ohm of the windings themselves: V / I at stall.
        self._winding = nominal / (self._stall / self.torque_per_ampere)

        def zeros() -> Array:
            return np.zeros(n)

        self.powered, self.mode = np.zeros(n, bool), np.full(n, POSITION)
        self.p, self.i, self.d, self.ff_velocity = (zeros() for _ in range(4))
        self.velocity_p, self.velocity_i = zeros(), zeros()  # duty per rad/s, duty per rad
        self.pwm_limit, self.goal_pwm = np.ones(n), np.ones(n)
        self.current_limit, self.goal_current = np.full(n, np.inf), zeros()
        self.goal_position, self.goal_velocity = zeros(), zeros()
        self.profile_velocity, self.profile_acceleration = np.full(n, np.inf), np.full(n, np.inf)
        self.profile_time, self.profile_ramp = np.full(n, np.nan), zeros()  # s; NaN: the profile is of velocity
        self.reference, self.reference_speed = zeros(), zeros()  # trajectories
        self.halted = np.zeros(n, bool)  # by the bus watchdog
        self.error, self.injected = np.zeros(n, int), np.zeros(n, int)
        self.temperature_limit = np.full(n, np.inf)
        self.voltage_range = np.tile([0.0, np.inf], (n, 1))
        self.duty, self.current = zeros(), zeros()  # outputs of the newest step
        self.winding, self.case = np.full(n, AMBIENT), np.full(n, AMBIENT)
        self._integral, self._velocity_integral, self._stalled = zeros(), zeros(), zeros()
        self._last_error = zeros()
        self._cruise, self._ramp = np.full(n, np.inf), np.full(n, np.inf)
        self._pending: deque[_Pending] = deque()

    def set_stiffness(self, factor: float) -> None:
        """Scale every servo's stiffness: how this robot differs from the nominal one."""
        self.unit = self._nominal_unit * factor

    def submit(self, servo: int, name: str, value: float, now_ns: int) -> None:
        """A goal that was written at `now_ns`: it drives the motor after the servo's own delay."""
        self._pending.append(_Pending(now_ns + self._delay_ns[servo], servo, name, value))

    def flush(self, servo: int, angle: float) -> None:
        """Forget what was underway: for torque-on and mode changes, from rest at `angle`."""
        for item in [item for item in self._pending if item.servo == servo]:
            getattr(self, item.name)[servo] = item.value
            self._pending.remove(item)
        self._integral[servo] = self._velocity_integral[servo] = self._stalled[servo] = 0.0
        self.reference[servo], self.reference_speed[servo] = angle, 0.0
        self._last_error[servo] = self.goal_position[servo] - angle
        self._plan(servo)

    def halt(self, servo: int, angle: float) -> None:
        """Stop a servo where it is, and drop what was underway: the bus watchdog's way."""
        self.halted[servo] = True
        self._pending = deque(item for item in self._pending if item.servo != servo)
        self.goal_position[servo] = self.reference[servo] = angle
        self.goal_velocity[servo] = self.reference_speed[servo] = 0.0

    def _plan(self, servo: int) -> None:
        """Cruise speed and acceleration of the profile toward the present goal."""
        seconds = self.profile_time[servo]
        if np.isnan(seconds):
            speed = self.profile_velocity[servo]
            self._cruise[servo] = speed
            self._ramp[servo] = self.profile_acceleration[servo]
        elif seconds <= 0:
            self._cruise[servo] = self._ramp[servo] = np.inf
        else:
            ramp = min(self.profile_ramp[servo], seconds / 2)
            way = abs(self.goal_position[servo] - self.reference[servo])
            speed = max(way / (seconds - ramp), 1e-6)
            self._cruise[servo], self._ramp[servo] = speed, speed / ramp if ramp > 0 else np.inf

    def step(self, now_ns: int, angle: Array, speed: Array, supply: float) -> Array:
        """Voltages `(n,)` for the physics step that begins at `now_ns`, at the true `angle` and `speed`."""
        due = [item for item in self._pending if item.time_ns <= now_ns + TIMESTEP * 5e8]  # to the nearest step
        for item in due:
            self._pending.remove(item)
            if not self.halted[item.servo]:
                getattr(self, item.name)[item.servo] = item.value
                self._plan(item.servo)
        velocity, before = self.mode == VELOCITY, self.reference_speed
        self._follow()
        position = (self.mode >= POSITION) & (self.mode <= CURRENT_POSITION)  # 3, 4 and 5
        limit = np.minimum(self.pwm_limit, np.where(self.mode == PWM, 1.0, np.abs(self.goal_pwm)))
        duty = np.where(position, self._position(angle), 0.0)
        if velocity.any():
            self._ramp_speed(velocity, before)
            duty = np.where(velocity, self._velocity(speed, limit), duty)
        duty = np.where(self.mode == PWM, self.goal_pwm, duty)
        limited = (self.mode == CURRENT) | (self.mode == CURRENT_POSITION)
        if limited.any():
            duty = self._limit_current(duty, speed, supply)
        duty = np.where(self.halted & ~position, 0.0, duty)
        self.duty = np.where(self.powered, np.clip(duty, -limit, limit), 0.0)
        return self.duty * supply

    def _follow(self) -> None:
        """Advance the position trajectories: trapezoids toward the goals, or the goals themselves."""
        free = np.isinf(self._cruise)
        if free.all():
            self.reference = self.goal_position.copy()
            self.reference_speed = np.zeros(self.n)
            return
        left = self.goal_position - self.reference
        ramp = np.where(np.isinf(self._ramp), _NO_RAMP, self._ramp)
        braking = np.sqrt(2 * ramp * np.abs(left))  # the speed from which there is still room to stop
        wanted = np.sign(left) * np.minimum(np.minimum(self._cruise, braking), np.abs(left) / TIMESTEP)
        change = np.clip(wanted - self.reference_speed, -ramp * TIMESTEP, ramp * TIMESTEP)
        speed = self.reference_speed + change
        step = speed * TIMESTEP
        arrived = free | (np.abs(left) <= np.abs(step))
        self.reference = np.where(arrived, self.goal_position, self.reference + step)
        self.reference_speed = np.where(arrived, 0.0, speed)

    def _position(self, angle: Array) -> Array:
        error = self.reference - angle
        counts = 128.0 * self.unit  # duty per rad at a gain of one
        duty = self.unit * self.p * error
        if self.i.any():
            rate = counts / 65536.0 / _SAMPLE * self.i
            self._integral = np.where(self.powered, np.clip(self._integral + rate * error * TIMESTEP, -1, 1), 0.0)
            duty = duty + self._integral
        if self.d.any():
            duty = duty + counts / 16.0 * _SAMPLE * self.d * (error - self._last_error) / TIMESTEP
        if self.ff_velocity.any():
            duty = duty + counts / 4.0 * _SAMPLE * self.ff_velocity * self.reference_speed
        self._last_error = error
        return duty

    def _ramp_speed(self, which: Array, before: Array) -> None:
        """Advance the speeds of `which` servos from those `before` toward their goals: they follow no position."""
        ramp = self.profile_acceleration * TIMESTEP
        speed = before + np.clip(self.goal_velocity - before, -ramp, ramp)
        self.reference_speed = np.where(which, speed, self.reference_speed)

    def _velocity(self, speed: Array, limit: Array) -> Array:
        error = self.reference_speed - speed
        integral = self._velocity_integral + self.velocity_i * error * TIMESTEP
        self._velocity_integral = np.where(self.powered, np.clip(integral, -limit, limit), 0.0)
        return self.velocity_p * error + self._velocity_integral

    def _limit_current(self, duty: Array, speed: Array, supply: float) -> Array:
        """Current modes: voltage that drives the goal current, or that keeps a position's current below it."""
        goal = np.clip(self.goal_current, -self.current_limit, self.current_limit)
        drop = self._r / self._k * self.torque_per_ampere  # V per A at the joint
        emf = self._k * speed
        held = np.abs(goal) * drop
        volts = np.where(
            self.mode == CURRENT,
            goal * drop + emf,
            np.clip(duty * supply, emf - held, emf + held),
        )
        either = (self.mode == CURRENT) | (self.mode == CURRENT_POSITION)
        return np.where(either, volts / max(supply, 1e-3), duty)

    def settle(self, torque: Array, speed: Array, supply: float) -> Array:
        """After the physics step: heat and protections. Returns the current that each servo draws [A]."""
        self.current = torque / self.torque_per_ampere
        loss = self.current**2 * self._winding
        flow = (self.winding - self.case) / _WINDING_TO_CASE
        self.winding += TIMESTEP * (loss - flow) / _WINDING_CAPACITY
        self.case += TIMESTEP * (flow - (self.case - AMBIENT) / _CASE_TO_AIR) / _CASE_CAPACITY
        full = self.powered & (np.abs(self.duty) >= 0.999) & (np.abs(speed) < _STALL_SPEED * self._no_load)
        self._stalled = np.where(full, self._stalled + TIMESTEP, 0.0)
        error = self.injected | np.where(self.winding > self.temperature_limit, OVERHEATING, 0)
        error |= np.where(self._stalled > _STALL_SECONDS, OVERLOAD, 0)
        outside = (supply < self.voltage_range[:, 0]) | (supply > self.voltage_range[:, 1])
        self.error |= error | np.where(outside, INPUT_VOLTAGE, 0)
        return np.maximum(self.duty * self.current, 0.0)
