"""Show angles, temperatures, voltages, loads and errors of every servo, the IMU, and the state of the bus.

It only reads: torque stays as it is. It ends after Ctrl-C or `--seconds`.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import shutil
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from servoid.hw.robot.description import Robot
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import Line, add_line_arguments, assembled, is_virtual, open_line
from servoid.tools.bringup.session import at_desk
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report
from servoid.tools.common.parser import positive
from servoid.tools.web.launch import add_view_arguments

if TYPE_CHECKING:
    from servoid.hw.contracts.body import Observation
    from servoid.hw.dynamixel.transport.bus import Counters
    from servoid.hw.imu.serial_imu import SerialImu

RATE = 20  # reads a second
SHOW_SECONDS = 0.5  # between tables on a terminal
_KEPT = 10_000  # times of reads that the statistics are of
_SILENT = 1.0  # s after which a servo is said to be silent


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    add_view_arguments(parser)
    parser.add_argument("--seconds", type=positive, metavar="S", help="how long to watch (default: until Ctrl-C)")


def main(args: argparse.Namespace) -> int:
    return at_desk(args, "watch", work)


def work(args: argparse.Namespace, desk: Desk) -> int:
    """Do it, and show the person at the desk."""
    report, robot = desk.report, assembled(args, desk.report)
    if is_virtual(args):
        from servoid.sim.rig.servo.board import on_the_board

        robot = on_the_board(robot)  # of which a virtual rig has the IMU that would be on a port of its own
    with open_line(args, robot, patient=False) as line, ExitStack() as stack:
        imu = None
        if robot.imu.kind not in ("opencr", "none"):
            from servoid.hw.imu.serial_imu import SerialImu

            imu = SerialImu(robot.imu, robot.rate, clock=line.clock)
            stack.callback(imu.close)
        watched = Watched(line, robot, imu)
        redraw = desk.redraws(watched.show)
        with suppress(KeyboardInterrupt):  # the usual way to end it
            watched.run(args.seconds, redraw, desk.show_read)
        if redraw is None:
            watched.show(report)
        report.result(watched.summary())
    return exit_codes.DONE


class Watched:
    """The robot on a line, read again and again. `imu` is one on a port of its own."""

    def __init__(self, line: Line, robot: Robot, imu: SerialImu | None = None) -> None:
        """Raises BackendError when a servo or the board does not answer."""
        from servoid.hw.dynamixel.protocol.units import Units
        from servoid.hw.dynamixel.sensors import DynamixelSensors, present
        from servoid.hw.dynamixel.servos.register_check import find_board, find_servos
        from servoid.hw.dynamixel.servos.servo_monitor import ServoMonitor
        from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY
        from servoid.stack.estimation.sample_hold import SampleHold
        from servoid.stack.runtime.clock import RealTime, WallClock

        bus = line.bus
        bus.return_delay = LONGEST_RETURN_DELAY  # until the servos' own is known
        find_board(bus, robot)
        found = find_servos(bus, robot)
        bus.return_delay = max(servo.get("return_delay_time") for servo in found) * 2e-6
        units = Units(robot, [servo.table for servo in found])
        units.anchor([servo.get("present_position") for servo in found])
        self._sensors = DynamixelSensors(bus, robot, units, ServoMonitor(bus, found, units), present(found), imu)
        self._bus, self._robot, self._hold = bus, robot, SampleHold()
        self._clock = line.clock if isinstance(line.clock, WallClock) else RealTime(line.clock)
        self._before = dataclasses.replace(bus.counters)
        self._reads = 0
        self._times: deque[float] = deque(maxlen=_KEPT)  # ms that the newest reads took
        self._hottest: list[float] = [float("nan")] * len(found)
        self._lowest: list[float] = [float("nan")] * len(found)
        self._newest: Observation | None = None
        self._drawn = 0

    def run(
        self,
        seconds: float | None,
        redraw: Callable[[], None] | None,
        seen: Callable[[Observation], None] = lambda observation: None,
    ) -> None:
        """Read for so long, or until KeyboardInterrupt. `redraw` is called now and then, `seen` after each read."""
        import numpy as np

        from servoid.stack.runtime.clock import Schedule

        schedule, tick, every = Schedule(self._clock, RATE), -1, round(SHOW_SECONDS * RATE)
        while seconds is None or tick + 1 <= seconds * RATE:
            tick = schedule.wait().tick
            began = self._clock.now_ns()
            self._newest = observation = self._hold.update(self._sensors.read())
            self._times.append((self._clock.now_ns() - began) * 1e-6)
            self._reads += 1
            self._hottest = np.fmax(self._hottest, observation.temperature).tolist()
            self._lowest = np.fmin(self._lowest, observation.voltage).tolist()
            seen(observation)
            if redraw is not None and self._reads % every == 0:
                redraw()

    def show(self, report: Report, redraw: bool = False) -> None:
        """The table as it is now; `redraw` over the one before."""
        if self._newest is None:
            return
        rows = [tuple(row.values()) for row in self._rows()]
        head = ("joint", "ID", "angle", "supply", "lowest", "heat", "hottest", "effort", "state")
        text = io.StringIO()
        Report(False, text).table(head, [(*row[:2], *map(_text, row[2:8], _UNITS), row[8]) for row in rows])
        bus = self._statistics()
        below = [
            self._imu(),
            f"bus: {bus['reads']} reads, median {bus['read_ms_p50']:.2f} ms, p99 {bus['read_ms_p99']:.2f} ms",
            f"     lost {bus['lost']}, recovered {bus['recovered']}, damaged {bus['bad_crc']}, "
            f"refused {bus['refused']}, conflicts {bus['conflicts']}",
        ]
        title, *table = text.getvalue().splitlines()
        if redraw:
            size = shutil.get_terminal_size()
            wrong = [row[8] != "ok" for row in rows]
            table = fitted(table, wrong, size.lines - len(below) - 2)
            lines = [line[: size.columns - 1] for line in (title, *table, *below)]
            report.line((f"\x1b[{self._drawn}F\x1b[J" if self._drawn else "") + "\n".join(lines))
            self._drawn = len(lines)
        else:
            for line in (title, *table, *below):
                report.line(line)

    def summary(self) -> dict[str, Any]:
        """The newest values and the bus's statistics, as JSON values."""
        o = self._newest
        if o is None:
            return {"servos": [], "imu": None, "bus": self._statistics()}
        imu = {"specific_force": o.specific_force, "angular_velocity": o.angular_velocity, "age": float(o.imu_age)}
        return {"servos": self._rows(), "imu": imu, "bus": self._statistics()}

    def _imu(self) -> str:
        import numpy as np

        from servoid.hw.faults import IMU, describe

        o = self._newest
        assert o is not None
        if not o.imu_age <= _SILENT:
            why = ", ".join(describe(int(np.bitwise_or.reduce(o.fault)) & IMU)) or "it sends nothing"
            return f"IMU: no fresh sample ({why}): check its cable"
        force, turning = (
            " ".join(f"{value:+.{digits}f}" for value in vector.tolist())
            for vector, digits in ((o.specific_force, 1), (o.angular_velocity, 2))
        )
        return f"IMU: force {force} m/s2, turning {turning} rad/s"

    def _rows(self) -> list[dict[str, Any]]:
        from servoid.hw.faults import ROBOT, describe

        o = self._newest
        assert o is not None
        rows = []
        for i, joint in enumerate(self._robot.joints):
            state = ", ".join(describe(int(o.fault[i]) & ~ROBOT)) or "ok"
            if o.age[i] > _SILENT:
                state = f"silent for {o.age[i]:.0f} s: check its cable"
            rows.append(
                {
                    "joint": joint.name,
                    "id": joint.id,
                    "position": float(o.position[i]),
                    "voltage": float(o.voltage[i]),
                    "voltage_min": self._lowest[i],
                    "temperature": float(o.temperature[i]),
                    "temperature_max": self._hottest[i],
                    "effort": float(o.effort[i]),
                    "state": state,
                }
            )
        return rows

    def _statistics(self) -> dict[str, Any]:
        import numpy as np

        now, before = self._bus.counters, self._before
        values: dict[str, Any] = {name: getattr(now, name) - getattr(before, name) for name in _names(now)}
        p50, p99 = np.percentile(list(self._times) or [0.0], [50, 99])
        return {"reads": self._reads, "read_ms_p50": float(p50), "read_ms_p99": float(p99)} | values


def fitted(rows: list[str], wrong: list[bool], room: int) -> list[str]:
    """The rows that fit into so many lines, in their order: those of servos with something wrong before all others."""
    if len(rows) <= room:
        return rows
    ranked = sorted(range(len(rows)), key=lambda i: not wrong[i])[: max(room - 1, 0)]
    left = [wrong[i] for i in range(len(rows)) if i not in ranked]
    note = f"... {len(left)} more, {'all ok' if not any(left) else f'{sum(left)} of them not ok'}: enlarge the window"
    return [*(rows[i] for i in sorted(ranked)), note]


_UNITS = (("rad", 3), ("V", 1), ("V", 1), ("C", 0), ("C", 0), ("N m", 2))


def _text(value: float, unit: tuple[str, int]) -> str:
    return "-" if value != value else f"{value:.{unit[1]}f} {unit[0]}"


def _names(counters: Counters) -> list[str]:
    return [field.name for field in dataclasses.fields(counters)]
