"""Move one joint slowly, a little.

Torque comes on at every joint, each where it is; then one joint moves while an arrow key is held, at 0.25 rad/s and at
most 0.35 rad from where it was found. It stops when the key is released. q, Ctrl-C or a minute without a key turn
torque off. Every goal passes the guard. Support the robot: it is limp before and after.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, TextIO

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.body import Array, BackendError, Sensors
from servoid.hw.robot.description import Robot
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import add_line_arguments, assembled, is_virtual
from servoid.tools.bringup.session import at_desk
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, Screen
from servoid.tools.web.launch import add_view_arguments

if TYPE_CHECKING:
    from servoid.stack.log.tick import TickRecord
    from servoid.stack.safety.guard import Guard

_READS = 25  # of a first pose: half a second
_SHOW_EVERY = 5  # ticks


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("joint", metavar="JOINT", help="joint to move")
    add_line_arguments(parser)
    add_view_arguments(parser)
    parser.add_argument("--by", type=float, metavar="RAD", help="angle to move by, and back, instead of using keys")
    parser.add_argument("--start", action="store_true", help="switch torque on without asking")


def main(args: argparse.Namespace) -> int:
    return at_desk(args, "jog", work)


def work(args: argparse.Namespace, desk: Desk) -> int:
    """Do it, by the wishes of the person at the desk."""
    from servoid.stack.runtime.backends import make_backend
    from servoid.tools.bringup.desk.jogging import SPAN

    robot = assembled(args, desk.report)
    if args.joint not in robot.names:
        raise ConfigError(f"{robot.name} has no joint '{args.joint}'; {nearest(args.joint, robot.names)}")
    if args.by is not None and not 0.0 < abs(args.by) <= SPAN:
        raise ConfigError(f"--by {args.by:g}: must be between -{SPAN:g} and {SPAN:g} rad, and not 0")
    if args.by is None:
        desk.check_keys()
    name = "virtual" if is_virtual(args) else "dynamixel"
    port = None if name == "virtual" else args.port
    body = make_backend(name, robot, seed=0, randomise=False, port=port)
    with ExitStack() as stack:
        stack.callback(body.close)
        sensors, motors = body.connect()
        if name == "virtual":
            body.rig.control.hold()  # type: ignore[attr-defined]  # on a stand, however it is bent
        result = _jog(body, sensors, motors, robot, args, desk)
    desk.report.result(result)
    return {"task": exit_codes.DONE, "interrupt": exit_codes.INTERRUPTED}.get(result["cause"], exit_codes.STOPPED)


def _jog(
    body: Backend, sensors: Sensors, motors: Any, robot: Robot, args: argparse.Namespace, desk: Desk
) -> dict[str, Any]:
    import numpy as np

    from servoid.stack.estimation.estimator import Estimator
    from servoid.stack.runtime.clock import RealTime, Schedule, WallClock
    from servoid.stack.runtime.interrupt import Interrupt, Stops
    from servoid.stack.runtime.loop import ControlledRobot, Loop
    from servoid.stack.safety.guard import Guard
    from servoid.tools.bringup.desk.jogging import SPEED, JogSupervisor, There, reach, restrict

    report, i = desk.report, robot.names.index(args.joint)
    clock = body.clock
    if not isinstance(clock, WallClock) and args.by is None:
        clock = RealTime(clock)
    here = _pose(sensors, clock, robot)
    low, high = reach(restrict(robot, here, i), i)
    _announce(report, robot, i, here, (low, high), args)
    if not args.start:
        desk.confirm("Support the robot", "give --start to switch torque on without being asked")
    here = _pose(sensors, clock, robot)  # it may have been moved meanwhile
    restricted = restrict(robot, here, i)
    low, high = reach(restricted, i)
    if args.by is not None and not low - 1e-9 <= here[i] + args.by <= high + 1e-9:
        raise ConfigError(
            f"--by {args.by:g}: {args.joint} can go from {low - here[i]:+.3f} to {high - here[i]:+.3f} rad from here"
        )
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        source = There(args.by, robot.dt) if args.by is not None else stack.enter_context(desk.keys())
        guard = Guard(restricted, motors)
        shown = _Shown(guard, i, args.joint, here, sys.stderr)
        supervisor = JogSupervisor(restricted, guard, i, source)
        schedule = Schedule(clock, robot.rate)
        controlled = ControlledRobot(restricted, sensors, Estimator(robot), guard)
        operator = desk.operator
        stops = Stops(interrupt, asked=(lambda: None) if operator is None else operator.stop)
        loop = Loop(controlled, supervisor, schedule, interrupt, stops, (shown, *desk.listeners), operator)
        try:
            loop.run()
        finally:
            shown.close()
    events = [*shown.events, *guard.events()]
    for event in events:
        if event.kind not in ("phase", "task"):
            report.line(event.text)
    report.line(
        f"{args.joint} was at {here[i]:+.3f} rad and went from {shown.low:+.3f} to {shown.high:+.3f}; torque is off"
    )
    return {
        "joint": args.joint,
        "start": float(here[i]),
        "lowest": shown.low,
        "highest": shown.high,
        "speed": SPEED,
        "others_moved": 0.0 if shown.drift is None else float(np.delete(shown.drift, i).max(initial=0.0)),
        "cause": guard.cause,
        "events": [event.text for event in events],
    }


def _pose(sensors: Sensors, clock: Any, robot: Robot) -> Array:
    """Where every joint is [rad], the newest of several reads. Raises BackendError naming a joint that is silent."""
    from servoid.stack.estimation.sample_hold import SampleHold, missing

    hold = SampleHold()
    for _ in range(_READS):
        clock.sleep_until(clock.now_ns() + round(robot.dt * 1e9))
        observation = hold.update(sensors.read())
    if lacking := missing(observation, robot.names):
        raise BackendError(f"no sample from {', '.join(lacking)}: check cables and power, then servoid bringup scan")
    return observation.position.copy()


def _announce(
    report: Report, robot: Robot, i: int, here: Array, ends: tuple[float, float], args: argparse.Namespace
) -> None:
    import numpy as np

    from servoid.tools.bringup.calibration.turning import describe_turns
    from servoid.tools.bringup.desk.jogging import SPEED

    joint = robot.joints[i]
    report.line(
        f"{joint.name} (ID {joint.id}) is at {here[i]:+.3f} rad; its range is {joint.range[0]:g} to {joint.range[1]:g}."
    )
    turn = describe_turns(robot, here, np.ones(len(here)))[i]
    report.line(f"A positive turn of it, with the robot upright: {turn}.")
    report.line(f"Torque will come on at all {len(robot.joints)} joints, each where it is. Nothing moves by that.")
    if args.by is None:
        report.line(
            f"Then {joint.name} moves while an arrow key is held (or + and -), at {SPEED:g} rad/s, between "
            f"{ends[0]:+.3f} and {ends[1]:+.3f} rad. q, Ctrl-C or a minute without a key: torque off."
        )
    else:
        report.line(
            f"Then {joint.name} goes by {args.by:+.3f} rad at {SPEED:g} rad/s, and back; then torque goes off. "
            "Ctrl-C: at once."
        )


class _Shown:
    """Shows the joint while it moves, and remembers how far it went."""

    def __init__(self, guard: Guard, i: int, name: str, start: Array, stream: TextIO) -> None:
        self._guard, self._i, self._name, self._start = guard, i, name, start
        self._screen = Screen(stream)
        self._count = 0
        self.low, self.high = float("inf"), float("-inf")
        self.drift: Array | None = None  # (n_joints,) rad, the farthest that each joint was from `start`
        self.events: list[Any] = []

    def __call__(self, record: TickRecord) -> None:
        import numpy as np

        from servoid.stack.safety.phase import ENDED

        self.events += record.events
        if record.phase in ENDED:
            return  # what is limp sinks
        angle = float(record.observation.position[self._i])
        if angle == angle:  # it was read
            self.low, self.high = min(self.low, angle), max(self.high, angle)
        away = np.abs(np.nan_to_num(record.observation.position - self._start))
        self.drift = away if self.drift is None else np.maximum(self.drift, away)
        self._count += 1
        if self._screen.tty and self._count % _SHOW_EVERY == 0:
            effort, goal = float(record.observation.effort[self._i]), float(self._guard.applied[self._i])
            text = f"{self._name} {angle:+.3f} rad  goal {goal:+.3f}  effort {effort:+.2f} N m  {record.phase}"
            self._screen.write("\r" + text.ljust(78))

    def close(self) -> None:
        if self._screen.tty:
            self._screen.write("\n")
