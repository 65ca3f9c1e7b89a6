"""Checks of a robot's or servo's file that need more than types: each failure names the file, the line and the key."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError, Marks, available, nearest

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot, Servo

MAX_ID = 252  # protocol 2.0: 253 is reserved and 254 is broadcast


def check_robot(robot: Robot, marks: Marks) -> None:
    """Raise ConfigError for the first thing in a robot's file that cannot be true."""
    if not robot.joints:
        raise marks.error("joints", "a robot needs at least one joint")
    _check_numbers(robot, marks)
    _check_identity(robot, marks)
    _check_angles(robot, marks)
    _check_mirror(robot, marks)
    _check_feet(robot, marks)


def check_bus_port(robot: Robot, port: str) -> None:
    """Raise ConfigError where the port of the servos is the one that the IMU has to itself."""
    if robot.imu.port is not None and Path(port).resolve() == Path(robot.imu.port).resolve():
        raise ConfigError(f"--port {port}: {robot.name}'s IMU is on this port: give the port of the servos' adapter")


def check_servo(servo: Servo, marks: Marks) -> None:
    """Raise ConfigError for the first thing in a servo's file that cannot be true."""
    positive = (
        *("ticks_per_turn", "velocity_unit", "current_unit", "torque_per_ampere", "voltage_unit", "position_p_gain"),
        *("voltage", "stiffness", "stall_torque", "no_load_speed", "braking_torque", "max_temperature"),
        "stribeck_speed",
    )
    for key in positive:
        _require_positive(getattr(servo, key), key, marks)
    resisting = ("damping", "friction", "stribeck_friction", "load_friction", "armature")
    for key in (*resisting, "command_delay", "position_latency"):
        _require_not_negative(getattr(servo, key), key, marks)
    if not 0 <= servo.center_tick < servo.ticks_per_turn:
        raise marks.error("center_tick", f"{servo.center_tick} is outside 0..{servo.ticks_per_turn - 1}")
    low, high = servo.voltage_range
    if low >= high:
        raise marks.error("voltage_range", f"upside down: {low:g} is not below {high:g}; write [lowest, highest]")
    if not low <= servo.voltage <= high:
        raise marks.error("voltage", f"{servo.voltage:g} V is outside voltage_range {low:g}..{high:g} V")


def _check_numbers(robot: Robot, marks: Marks) -> None:
    _require_positive(robot.rate, "rate", marks)
    if robot.standing_height <= 0:  # not so if it is left out
        raise marks.error("standing_height", f"must be positive, not {robot.standing_height:g}")
    _require_positive(robot.bus.baud, "bus.baud", marks)
    _require_id(robot.bus.board_id, "bus.board_id", marks)
    for key in ("joint_speed", "homing_speed", "tilt", "stale", "temperature"):
        _require_positive(getattr(robot.limits, key), f"limits.{key}", marks)
    _require_not_negative(robot.limits.margin, "limits.margin", marks)
    _require_radians(robot.limits.tilt, "limits.tilt", marks)
    for key in ("forward", "backward", "sideways", "turning", "height"):
        _require_positive(getattr(robot.walking, key), f"walking.{key}", marks)
    if robot.weight is not None:
        _require_positive(robot.weight, "weight", marks)
    for body, load in robot.loads.items():
        _require_positive(load.mass, f"loads.{body}.mass", marks)
    _require_not_negative(robot.bus.supply_resistance, "bus.supply_resistance", marks)
    if robot.bus.supply_voltage is not None:
        _require_positive(robot.bus.supply_voltage, "bus.supply_voltage", marks)
    _require_positive(robot.floor_friction, "floor_friction", marks)
    _check_derating(robot, marks)
    _check_imu(robot, marks)


def _check_derating(robot: Robot, marks: Marks) -> None:
    """Gains go down before the limit is reached, from the right side."""
    limits = robot.limits
    if limits.derate_temperature is not None and not 0 < limits.derate_temperature < limits.temperature:
        raise marks.error(
            "limits.derate_temperature",
            f"{limits.derate_temperature:g} is not between 0 and limits.temperature ({limits.temperature:g})",
        )
    if limits.voltage is not None:
        _require_positive(limits.voltage, "limits.voltage", marks)
    if limits.derate_voltage is not None and limits.derate_voltage <= (limits.voltage or 0.0):
        raise marks.error(
            "limits.derate_voltage", f"{limits.derate_voltage:g} V is not above limits.voltage: gains go down first"
        )


def _check_imu(robot: Robot, marks: Marks) -> None:
    imu = robot.imu
    for key in ("gyro_noise", "gyro_bias", "accelerometer_noise", "accelerometer_bias", "average", "latency"):
        _require_not_negative(getattr(imu, key), f"imu.{key}", marks)
    _require_positive(imu.baud, "imu.baud", marks)
    for i, sign in enumerate((*imu.signs, imu.yaw_sign)):
        if sign not in (1.0, -1.0):
            raise marks.error(f"imu.signs[{i}]" if i < 3 else "imu.yaw_sign", f"must be 1 or -1, not {sign:g}")
    for i, angle in enumerate(imu.mounting):
        _require_radians(angle, f"imu.mounting[{i}]", marks)
    if imu.kind == "opencr" and robot.bus.board == "none":
        raise marks.error("imu.kind", "the board's IMU, but bus.board is none: name another kind, or none")
    if imu.kind in ("opencr", "none"):
        if imu.port is not None:
            where = "the board's IMU is on the servo bus" if imu.kind == "opencr" else "imu.kind is none"
            raise marks.error("imu.port", f"{where}: drop the port, or name another imu.kind")
        return
    if not imu.port:
        raise marks.error("imu.kind", f"a {imu.kind} has a serial port of its own: name it as imu.port")
    if math.prod(imu.signs) < 0:
        raise marks.error("imu.signs", f"a {imu.kind} has right-handed axes: negate two of them or none")


def _check_identity(robot: Robot, marks: Marks) -> None:
    """Names and servo IDs are unique, IDs exist on the bus, servo models are known."""
    names: dict[str, int] = {}
    ids = {robot.bus.board_id: "the board (bus.board_id)"} if robot.bus.board != "none" else {}
    for i, joint in enumerate(robot.joints):
        if joint.name in names:
            first = marks.lines.get(f"joints[{names[joint.name]}]")
            raise marks.error(f"joints[{i}].name", f"duplicate joint name '{joint.name}', first on line {first}")
        names[joint.name] = i
        _require_id(joint.id, f"joints[{i}].id", marks)
        if joint.id in ids:
            raise marks.error(
                f"joints[{i}].id", f"duplicate servo ID {joint.id}: {joint.name} and {ids[joint.id]} have it"
            )
        ids[joint.id] = joint.name
        known = available("servos")
        if joint.servo.endswith((".yaml", ".yml")):
            if not (marks.path.parent / joint.servo).is_file():
                raise marks.error(f"joints[{i}].servo", f"no file {joint.servo} in {marks.path.parent}")
        elif joint.servo not in known:
            raise marks.error(f"joints[{i}].servo", f"unknown servo '{joint.servo}'; {nearest(joint.servo, known)}")


def _check_angles(robot: Robot, marks: Marks) -> None:
    for i, joint in enumerate(robot.joints):
        key = f"joints[{i}]"
        if joint.direction not in (1, -1):
            raise marks.error(f"{key}.direction", f"{joint.name}: must be 1 or -1, not {joint.direction}")
        for end, value in enumerate(joint.range):
            _require_radians(value, f"{key}.range[{end}]", marks, joint.name)
        _require_positive(joint.gear, f"{key}.gear", marks)
        _require_radians(joint.home, f"{key}.home", marks, joint.name)
        _require_radians(joint.zero, f"{key}.zero", marks, joint.name)
        low, high = joint.range
        if low >= high:
            raise marks.error(
                f"{key}.range", f"{joint.name}: upside down: {low:g} is not below {high:g}; write [lowest, highest]"
            )
        if 2.0 * robot.limits.margin >= high - low:
            raise marks.error(f"{key}.range", f"{joint.name}: narrower than twice limits.margin")
        if not low <= joint.home <= high:
            raise marks.error(f"{key}.home", f"{joint.name}: {joint.home:g} is outside the range {low:g}..{high:g}")


def _check_mirror(robot: Robot, marks: Marks) -> None:
    """Mirroring twice must give the pose back."""
    joints = {joint.name: joint for joint in robot.joints}
    for i, joint in enumerate(robot.joints):
        key = f"joints[{i}].mirror"
        if joint.mirror_sign not in (1, -1):
            raise marks.error(f"{key}_sign", f"{joint.name}: must be 1 or -1, not {joint.mirror_sign}")
        if joint.mirror not in joints:
            raise marks.error(key, f"{joint.name}: unknown joint '{joint.mirror}'; {nearest(joint.mirror, joints)}")
        other = joints[joint.mirror]
        if other.mirror != joint.name:
            raise marks.error(
                key, f"{joint.name} names {other.name} as its mirror, but {other.name} names {other.mirror}"
            )
        if other.mirror_sign != joint.mirror_sign:
            raise marks.error(f"{key}_sign", f"{joint.name} and {other.name} must have the same sign")


def _check_feet(robot: Robot, marks: Marks) -> None:
    if not robot.feet:
        raise marks.error("feet", "a robot needs at least one foot")
    for side, foot in robot.feet.items():
        if not foot.geoms:
            raise marks.error(f"feet.{side}.geoms", "name at least one collision geom of the MJCF")
        if min(foot.half_size) <= 0.0:
            raise marks.error(f"feet.{side}.half_size", "must be positive, in metres")


def _require_positive(value: float, key: str, marks: Marks) -> None:
    if value <= 0:
        raise marks.error(key, f"must be positive, not {value:g}")


def _require_not_negative(value: float, key: str, marks: Marks) -> None:
    if value < 0:
        raise marks.error(key, f"must not be negative, not {value:g}")


def _require_id(value: int, key: str, marks: Marks) -> None:
    if not 0 <= value <= MAX_ID:
        raise marks.error(key, f"servo IDs are 0..{MAX_ID}, not {value}")


def _require_radians(value: float, key: str, marks: Marks, joint: str = "") -> None:
    if abs(value) > 2.0 * math.pi:
        name = f"{joint}: " if joint else ""
        raise marks.error(key, f"{name}{value:g} is more than a turn: angles are in radians, not degrees")
