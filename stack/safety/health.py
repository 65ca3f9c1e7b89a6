"""What an observation says about the robot's health: what ends a run at once, what lowers it, what lowers gains first.

Gains go down before a servo's own protections act, which would let the leg go that the robot stands on. They never
come up again within a run: a limit that a robot works at would make it swing.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from servoid.hw.contracts.body import Array, Observation
from servoid.hw.contracts.control import State
from servoid.hw.faults import IMU, INPUT_VOLTAGE, LATE, ROBOT, STOP_BUTTON, STOP_BUTTON_AGAIN, describe, remedy
from servoid.hw.robot.description import Robot
from servoid.stack.estimation.sample_hold import complete

DERATED = 0.6  # of the gain, at a limit: 5.6 N m/rad on an XM430, within what policies are trained for
STEP = 0.05  # gains change in steps, so that they are not written at every tick
LOW_TICKS = 5  # that the supply must be low for: a stumble's current pulls it down for a moment
BLOCKED_SECONDS = 0.5  # at full output without moving: a servo shuts itself down after about twice as long
SOFT_SECONDS = 0.25  # the same, until its gain goes down
FULL = 0.9  # of the position error that saturates a servo's output
STILL = 0.05  # of the no-load speed
BLOCKED = "overload"  # kind of the event of a joint that pushes against something


class Finding(NamedTuple):
    """Something found. `kind` is that of the event; `ends` what to do: "now", "lowered" or nothing but say it."""

    ends: str
    kind: str
    text: str
    joint: str | None = None


class Load(NamedTuple):
    """For how long [s] a joint may push with all it has without moving: until its gain goes down, and until it counts
    as blocked."""

    soft: float = SOFT_SECONDS
    blocked: float = BLOCKED_SECONDS


WALKING = Load()


class Health:
    """Examines observations, tick after tick. `factor` `(n_joints,)` is what gains are to be multiplied by."""

    def __init__(self, robot: Robot, gain: Array) -> None:
        """`gain` `(n_joints,)` scales the servos' position gain."""
        self.factor: Array = np.ones(len(robot.names))
        self._robot, self._limits, self._names = robot, robot.limits, robot.names
        servos = robot.servos
        full = np.array([servo.stall_torque / servo.stiffness for servo in servos])
        self._full = full / np.maximum(gain, 1e-6)  # rad of error at full output
        self._still = STILL * np.array([servo.no_load_speed for servo in servos])
        self._weak: Array = np.ones(len(servos))  # the part of `factor` that heat and supply account for
        self._blocked = np.zeros(len(servos))  # s
        self._supply: deque[float] = deque(maxlen=LOW_TICKS)  # V, the median of the servos' at the last ticks
        self._low = False  # whether the supply was ever too low

    def examine(
        self,
        observation: Observation,
        state: State | None,
        applied: Array,
        *,
        upright: bool,
        load: Load | None = WALKING,
    ) -> list[Finding]:
        """Everything wrong at this tick, the worst first.

        `observation` is the newest sample of each joint, `applied` `(n_joints,)` rad the last accepted goal. `upright`:
        whether the robot is expected to be. `load` None: joints follow no goal, and none can be blocked.
        """
        found = [*self._samples(observation, state), *self._servos(observation)]
        if state is not None and upright and (tilt := tilt_of(observation, state)) > self._limits.tilt:
            found.append(Finding("now", "fall", f"tilted by {math.degrees(tilt):.0f} degrees"))
        found += [*self._bus(observation), *self._buttons(observation)]
        found += [*self._heat(observation), *self._voltage(observation)]
        if load is None:
            self._blocked[:] = 0.0
        else:
            found += self._load(observation, applied, load)
        return sorted(found, key=lambda finding: ("now", "lowered", "").index(finding.ends))

    def eased(self, goal: Array, position: Array) -> Array:
        """A goal `(n_joints,)` rad towards `goal` that asks of no joint, at `position`, more than DERATED of all it
        has."""
        most = DERATED * self._full / self._weak
        return position + np.clip(goal - position, -most, most)

    def _samples(self, observation: Observation, state: State | None) -> list[Finding]:
        stale = self._limits.stale
        oldest = stale * self._robot.dt + 1e-9
        joints = np.isfinite(observation.position) & np.isfinite(observation.velocity) & (observation.age <= oldest)
        if not joints.all():
            if not joints.any():
                text = f"no fresh sample from any joint for {stale} ticks: check the adapter, its cable and the supply"
                return [Finding("now", "stale", text)]
            name = self._names[int(np.flatnonzero(~joints)[0])]
            return [Finding("now", "stale", f"no fresh sample from {name} for {stale} ticks: check its cable", name)]
        tilt = tilt_of(observation, state)
        if complete(observation) and not float(observation.imu_age) > oldest and math.isfinite(tilt):
            return []
        why = describe(int(np.bitwise_or.reduce(observation.fault)) & IMU)
        reason = f" ({', '.join(why)})" if why else ""
        return [Finding("now", "stale", f"no fresh sample from the IMU for {stale} ticks{reason}: check its cable")]

    def _servos(self, observation: Observation) -> list[Finding]:
        """What servos report, one finding for each. An input voltage error shuts no servo down: it leaves time."""
        own = observation.fault & ~ROBOT
        found = []
        for i in np.flatnonzero(own).tolist():
            fault, name = int(own[i]), self._names[i]
            text = f"{name} reports {', '.join(describe(fault))}: {remedy(fault)}"
            if fault == INPUT_VOLTAGE:
                found.append(Finding("lowered", "voltage", text, name))
            else:
                found.append(Finding("now", "servo", text, name))
        return found

    def _buttons(self, observation: Observation) -> list[Finding]:
        pressed = int(np.bitwise_or.reduce(observation.fault))
        if pressed & STOP_BUTTON_AGAIN:
            return [Finding("now", "button", "the stop button was pressed twice")]
        if pressed & STOP_BUTTON:
            return [Finding("lowered", "button", "the stop button was pressed: stopping; once more to damp at once")]
        return []

    def _bus(self, observation: Observation) -> list[Finding]:
        """An adapter that gathers bytes for longer than the bus waits: some ticks have their samples, by luck."""
        if not int(np.bitwise_or.reduce(observation.fault)) & LATE:
            return []
        text = (
            "answers come too late or not at all: set the adapter's latency timer to 1 ms (`servoid doctor` tells how) "
            "and check its cable"
        )
        return [Finding("now", "late", text)]

    def _heat(self, observation: Observation) -> list[Finding]:
        limits = self._limits
        temperature = np.nan_to_num(observation.temperature, nan=-np.inf)
        found = []
        for i in np.flatnonzero(temperature > limits.temperature).tolist():
            text = f"{self._names[i]} is at {temperature[i]:.0f} C: let it cool"
            found.append(Finding("lowered", "temperature", text, self._names[i]))
        if found:
            return found  # a leg that goes soft in mid-step would let the robot fall that is being lowered
        if limits.derate_temperature is not None:
            span = limits.temperature - limits.derate_temperature
            for i in self._weaken(_ramp((temperature - limits.derate_temperature) / span)):
                text = f"{self._names[i]} is at {temperature[i]:.0f} C: its gain goes down to {self.factor[i]:.2f}"
                found.append(Finding("", "derated", text, self._names[i]))
        return found

    def _voltage(self, observation: Observation) -> list[Finding]:
        limits, known = self._limits, np.isfinite(observation.voltage)
        if not known.any():
            return []
        self._supply.append(float(np.median(observation.voltage[known])))
        lowest = int(np.nanargmin(observation.voltage))
        name, at = self._names[lowest], f"{observation.voltage[lowest]:.1f} V at {self._names[lowest]}"
        if len(self._supply) < LOW_TICKS:
            return []
        supply = max(self._supply)
        low = limits.voltage is not None and supply < limits.voltage
        self._low |= low
        if self._low:  # it keeps its strength from now on: one that goes soft while it is brought to rest would fall
            text = f"the supply is down to {supply:.1f} V, {at}: charge the battery"
            return [Finding("lowered", "voltage", text, name)] if low else []
        found = []
        if limits.derate_voltage is not None:
            span = limits.derate_voltage - (limits.voltage or 0.0)
            if self._weaken(np.full_like(self.factor, _ramp((limits.derate_voltage - supply) / span))):
                text = f"the supply is down to {supply:.1f} V, {at}: gains go down to {self.factor.max():.2f}"
                found.append(Finding("", "derated", text, name))
        return found

    def _load(self, observation: Observation, applied: Array, load: Load) -> list[Finding]:
        """Joints that push with all they have and do not move."""
        error = np.abs(applied - observation.position)
        full = self._full / self._weak  # a weakened servo sags further before it gives all it has
        blocked = (error >= FULL * full) & (np.abs(observation.velocity) < self._still)
        self._blocked = np.where(blocked, self._blocked + self._robot.dt, 0.0)
        if not (self._blocked > min(load)).any():
            return []
        soft = self._blocked > load.soft
        found = []
        share = np.where(soft, DERATED * self._full / np.maximum(error, 1e-6), 1.0)
        for i in self._derate(share):
            text = f"{self._names[i]} pushes and does not move: its gain goes down to {self.factor[i]:.2f}"
            found.append(Finding("", "derated", text, self._names[i]))
        for i in np.flatnonzero(self._blocked > load.blocked).tolist():
            text = f"{self._names[i]} pushes with all it has and does not move: is it blocked?"
            found.append(Finding("lowered", BLOCKED, text, self._names[i]))
        return found

    def _weaken(self, factor: Array) -> list[int]:
        """`_derate` for heat or supply, which say nothing about what the joint pushes against."""
        self._weak = np.minimum(self._weak, _steps(factor))
        return self._derate(factor)

    def _derate(self, factor: Array) -> list[int]:
        """Take gains down to `factor` `(n_joints,)`, in steps; returns the joints that went lower."""
        stepped = _steps(factor)
        lower = np.flatnonzero(stepped < self.factor - 1e-9)
        self.factor = np.minimum(self.factor, stepped)
        return lower.tolist()


def _steps(factor: Array) -> Array:
    return np.maximum(np.floor(factor / STEP + 1e-9) * STEP, STEP)


def _ramp(share: Array | float) -> Array:
    """Gain factor for how far `share` of the way to a limit is gone, 0..1."""
    return 1.0 - (1.0 - DERATED) * np.clip(share, 0.0, 1.0)


def tilt_of(observation: Observation, state: State | None) -> float:
    """Angle [rad] of the base from upright: the estimate's, or that of the IMU's own fusion where that is larger."""
    if state is None:
        return math.nan
    tilt = math.acos(min(1.0, max(-1.0, -float(state.gravity[2]))))
    if np.isfinite(observation.orientation).all():
        _, x, y, _ = observation.orientation / np.linalg.norm(observation.orientation)
        tilt = max(tilt, math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * float(x * x + y * y)))))
    return tilt
