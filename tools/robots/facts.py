"""What a robot's file says by itself, as findings: speeds, supply, feet, rate and IMU."""

from __future__ import annotations

from dataclasses import dataclass

from servoid.hw.robot.description import Robot
from servoid.sim.model import TIMESTEP


@dataclass(frozen=True)
class Comparison:
    """Something that was compared, and whether it is as it should be. Where it is not: at these joints, and at these
    places [m] at home, in the base's frame."""

    good: bool
    what: str
    found: str
    joints: tuple[str, ...] = ()
    places: tuple[tuple[float, float, float], ...] = ()


def file_findings(robot: Robot) -> list[Comparison]:
    """All that needs no pose."""
    return [_asked(robot), _supply(robot), _feet(robot), _rate(robot), _imu(robot)]


def _asked(robot: Robot) -> Comparison:
    """What a controller may ask of the robot."""
    walks = robot.walking
    text = (
        f"at most {walks.forward:.2f} m/s ahead, {walks.backward:.2f} back, {walks.sideways:.2f} aside and "
        f"{walks.turning:.2f} rad/s: give less as `walking` if its servos are too slow or too weak for it"
    )
    return Comparison(True, "walking", text)


def _supply(robot: Robot) -> Comparison:
    """One voltage suits all servos, as they hang on one bus and one supply."""
    lowest = max(robot.servos, key=lambda servo: servo.voltage_range[0])
    highest = min(robot.servos, key=lambda servo: servo.voltage_range[1])
    low, high, given = lowest.voltage_range[0], highest.voltage_range[1], robot.bus.supply_voltage
    if low > high:
        text = f"a {lowest.name} needs {low:g} V, and a {highest.name} bears {high:g} V at most"
    elif given is not None and not low <= given <= high:
        text = f"bus.supply_voltage, {given:g} V, is outside the {low:g} to {high:g} V that all servos work at"
    else:
        return Comparison(True, "supply", f"all servos work at {low:g} to {high:g} V")
    wrong = [j.name for j, servo in zip(robot.joints, robot.servos, strict=True) if servo.name == highest.name]
    return Comparison(False, "supply", text, tuple(wrong) if low > high else ())


def _feet(robot: Robot) -> Comparison:
    """A robot that walks has two feet."""
    text = f"{len(robot.feet)}: {', '.join(robot.feet)}"
    return Comparison(len(robot.feet) == 2, "feet", text if len(robot.feet) == 2 else f"{text}: a humanoid has two")


def _rate(robot: Robot) -> Comparison:
    """A tick is a whole number of physics steps."""
    steps = round(1 / TIMESTEP)
    good = abs(robot.dt / TIMESTEP - round(robot.dt / TIMESTEP)) < 1e-9
    text = f"{robot.rate:g} Hz, of the physics' {steps} steps a second"
    return Comparison(good, "rate", text if good else f"{text}: one that divides them is needed in simulation")


def _imu(robot: Robot) -> Comparison:
    """Said, since without one a robot stands and cannot balance."""
    kind = robot.imu.kind
    text = "none: the robot is taken to be upright, and cannot balance" if kind == "none" else kind
    return Comparison(True, "IMU", text if robot.imu.port is None else f"{text} on {robot.imu.port}")
