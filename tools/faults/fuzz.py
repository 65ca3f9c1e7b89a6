"""Feed random and damaged byte streams to everything that reads bytes.

The targets are the codec, the driver's bus, the IMU parsers and the virtual servos. Exceptions, hangs and unbounded
allocation are counted, and each is printed with the command that repeats it.

A target keeps its state from stream to stream and starts afresh every 2000, so a failure is repeated from there.
"""

from __future__ import annotations

import argparse
import gc
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import check_seed

BLOCK = 2000  # streams after which targets begin anew
SHOWN = 20  # failures that are printed
_HANG_SECONDS = 5.0  # for one stream, which takes a millisecond at most
_GROWTH_MB = 64.0  # of memory from after the first block to the end, above which something is kept


class Hang(Exception):
    """A stream held a target."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--streams", type=int, default=1_000_000, metavar="N", help="number of streams (default: %(default)s)"
    )
    parser.add_argument(
        "--first", type=int, default=0, metavar="N", help="number of the first stream (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.streams < 1 or args.first < 0:
            raise ConfigError("--streams must be at least 1, and --first must not be negative")
        check_seed(args.seed)
        result = fuzz(report, args)
        figures = {key: value for key, value in result.items() if key != "failures"}
        report.table(["figure", "value"], [[key.replace("_", " "), value] for key, value in figures.items()])
        report.result(result)
    return exit_codes.DONE


def fuzz(report: Report, args: argparse.Namespace) -> dict[str, Any]:
    """All streams into all targets. Raises ConfigError for an unknown robot."""
    from tqdm import tqdm

    from servoid.hw.robot.description import load_robot
    from servoid.tools.faults.streams import stream
    from servoid.tools.faults.targets import CodecTarget, DriverTarget, ImuTarget, ServoTarget, Target, Unbounded

    servos = ServoTarget(load_robot(args.robot))
    counts = {"exceptions": 0, "hangs": 0, "unbounded": 0}
    failures: list[dict[str, Any]] = []
    began, settled = time.monotonic(), 0.0
    total_bytes = 0
    targets: list[Target] = []
    last = args.first + args.streams
    with _deadline() as limit:
        for number in tqdm(range(args.first, last), unit="stream", mininterval=5.0):
            done = number - args.first
            if done % BLOCK == 0:
                servos.renew()
                targets = [CodecTarget(), DriverTarget(), ImuTarget(), servos]
                settled = memory_mb() if done <= BLOCK else settled
            pieces = stream(args.seed, number)
            total_bytes += sum(map(len, pieces))
            for target in targets:
                try:
                    limit(_HANG_SECONDS)
                    target.take(pieces)
                    continue
                except Hang:
                    kind, text = "hangs", f"did not end within {_HANG_SECONDS:g} s"
                except Unbounded as error:
                    kind, text = "unbounded", str(error)
                except Exception as error:
                    where = traceback.extract_tb(error.__traceback__)[-1]
                    kind, text = "exceptions", f"{type(error).__name__}: {error} ({where.filename}:{where.lineno})"
                counts[kind] += 1
                first = number - done % BLOCK
                repeat = f"servoid bench fuzz --seed {args.seed} --first {first} --streams {number - first + 1}"
                if len(failures) < SHOWN:
                    failures.append({"target": target.name, "stream": number, "what": text, "repeat": repeat})
                    report.line(f"{target.name}: {text}: {repeat}")
    growth = memory_mb() - settled
    counts["unbounded"] += growth > _GROWTH_MB
    seconds = time.monotonic() - began
    return {
        "streams": args.streams,
        "bytes": total_bytes,
        **counts,
        "memory_growth_mb": growth,
        "streams_per_s": args.streams / seconds,
        "wall_seconds": seconds,
        "failures": failures,
    }


def memory_mb() -> float:
    """Memory of this process that is in RAM [MB]."""
    gc.collect()
    with open("/proc/self/statm", encoding="ascii") as file:
        pages = int(file.read().split()[1])
    return pages * 4096 * 1e-6


@contextmanager
def _deadline() -> Iterator[Any]:
    """A function that lets Hang be raised here after so many seconds, counted anew at every call."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, ring)
    try:
        yield lambda seconds: signal.setitimer(signal.ITIMER_REAL, seconds)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
