"""Measure time and CPU of a control cycle on the servo bus, beside the official SDK and the limit of the wire.

A cycle writes the goals of 20 servos (4 bytes), reads their current, velocity and position (10 bytes) and the board's
block with the IMU. Servos and wire are a separate process on a pty, so that only the client is timed; it watches the
line without sleeping, as the SDK does, so two cores must be idle. Clients take turns, a batch of cycles each; `wire`
is the time that the bytes of a cycle take at the baud.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting

BAUDS = (1_000_000, 2_000_000, 3_000_000, 4_000_000)
SERVOS, BOARD_ID = 20, 200
WARM_UP = 20  # cycles before the clock counts
BATCH = 50  # cycles of a client before the next has its turn
_PAUSE = 0.0002  # s between cycles, which are not timed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cycles",
        type=int,
        default=1250,
        metavar="N",
        help="cycles of each client, mode and baud (default: %(default)s)",
    )
    parser.add_argument(
        "--baud", type=int, action="append", metavar="BPS", help="baud; may be repeated (default: 1, 2, 3 and 4 Mbit/s)"
    )
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.cycles < 1:
            raise ConfigError(f"--cycles must be at least 1, not {args.cycles}")
        bauds = tuple(args.baud or BAUDS)
        for baud in bauds:
            if baud not in BAUDS:
                raise ConfigError(f"--baud {baud}: here the official SDK runs at {', '.join(map(str, BAUDS))}")
        rows = measure(report, bauds, args.cycles)
        report.table(COLUMNS, [[_cell(row[key]) for key in COLUMNS] for row in rows])
        report.result({"cycles": args.cycles, "servos": SERVOS, "rows": rows})
    return exit_codes.DONE


COLUMNS = ("client", "mode", "baud", "median_ms", "p99_ms", "cpu_us", "failed", "ratio_to_wire")


def measure(report: Report, bauds: tuple[int, ...], cycles: int) -> list[dict[str, Any]]:
    """A row for each client, mode and baud, the wire's own among them."""
    from tqdm import tqdm

    from servoid.stack.runtime.realtime import undisturbed
    from servoid.tools.bench.bus_clients import CLIENTS

    rows = []
    total = 2 * len(CLIENTS) * len(bauds) * cycles
    with (
        responder() as port,
        undisturbed(False, report.line),
        tqdm(total=total, unit="cycle", leave=False, disable=None) as bar,  # on a terminal, between what is timed
    ):
        for baud in bauds:
            runs = {(name, mode): ClientTimes() for mode in ("sync", "fast") for name in CLIENTS}
            done = 0
            while done < cycles:
                batch = min(BATCH, cycles - done)
                for (name, mode), run in runs.items():
                    run.batch(CLIENTS[name](port, baud, range(1, SERVOS + 1), BOARD_ID, mode == "fast"), batch)
                    bar.update(batch)
                done += batch
            for mode in ("sync", "fast"):
                limit = wire_ms(mode, baud)
                rows += [runs[name, mode].row(name, mode, baud, limit) for name in CLIENTS]
                rows.append(_row("wire", mode, baud, limit, limit, 0.0, 0, 1.0))
            report.line(f"{baud} bit/s: {len(runs)} x {cycles} cycles")
    return rows


class ClientTimes:
    """Times of a client in one mode at one baud."""

    def __init__(self) -> None:
        self.wall: list[int] = []
        self.cpu: list[int] = []
        self.failed = 0
        self._count = 0

    def batch(self, client: Any, cycles: int) -> None:
        """Time so many cycles after a warm-up, and close the client."""
        import numpy as np

        from servoid.tools.bench.responder import CURRENT, VELOCITY

        try:
            for i in range(-WARM_UP, cycles):
                self._count += 1
                goals = [(self._count * 7 + 13 * joint) % 4096 for joint in range(SERVOS)]
                time.sleep(_PAUSE)
                wall, cpu = time.perf_counter_ns(), time.thread_time_ns()
                values = client.cycle(goals)
                cpu, wall = time.thread_time_ns() - cpu, time.perf_counter_ns() - wall
                if i < 0:
                    continue
                self.wall.append(wall)
                self.cpu.append(cpu)
                good = values is not None and np.array_equal(values[2], goals)
                good = good and bool((values[0] == CURRENT).all() and (values[1].astype("int32") == VELOCITY).all())
                self.failed += not good
        finally:
            client.close()

    def row(self, client: str, mode: str, baud: int, limit_ms: float) -> dict[str, Any]:
        import numpy as np

        median, p99 = (float(value) * 1e-6 for value in np.percentile(self.wall, (50, 99)))
        cpu = float(np.mean(self.cpu)) * 1e-3
        return _row(client, mode, baud, median, p99, cpu, self.failed, median / limit_ms)


def wire_ms(mode: str, baud: int) -> float:
    """Time that the bytes of a cycle take on a wire, without any pause between them."""
    from servoid.hw.dynamixel.protocol.codec import FRAME_BITS
    from servoid.hw.dynamixel.transport.group_read import GroupRead
    from servoid.tools.bench.bus_clients import BOARD, BOARD_BYTES, GOAL_BYTES, PRESENT, PRESENT_BYTES

    present = GroupRead([(id, PRESENT, PRESENT_BYTES) for id in range(SERVOS)], fast=mode == "fast").request_all()
    board = GroupRead([(BOARD_ID, BOARD, BOARD_BYTES)]).request_all()
    goals = 14 + SERVOS * (1 + GOAL_BYTES)
    count = goals + sum(len(request.packet) + request.answer for request in (present, board))
    return 1e3 * FRAME_BITS * count / baud


@contextmanager
def responder() -> Iterator[str]:
    """The servos, in a process of their own; their port."""
    command = [sys.executable, "-m", "servoid.tools.bench.responder"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        port = process.stdout.readline().strip()
        if not port:
            raise BackendError(f"the responder did not start: it ended with code {process.wait()}")
        yield port
    finally:
        process.stdin.close()
        process.wait(10)
        process.stdout.close()


def _row(*values: Any) -> dict[str, Any]:
    return dict(zip(COLUMNS, values, strict=True))


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
