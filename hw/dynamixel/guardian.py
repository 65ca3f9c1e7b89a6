"""The guardian: a process that outlives the controller by as long as it takes to brake the servos and let them go.

    python -I -S hw/dynamixel/guardian.py      (started by servoid.hw.dynamixel.guardian_client, never by hand)

It inherits the controller's open port, with its lock and its baud rate, and the reading end of a pipe. The first line
on that pipe is the plan: every packet that it may have to send, and every answer that proves torque is off, assembled
beforehand. After that, `+` says that torque may be on and `-` that all servos have said it is off. While the
controller lives nothing else happens here, and not a byte goes to the bus. When the pipe closes, or the controller's
process ends while something else keeps its pipe open, and the last word was `+`: the line is drained to silence, gains
go to zero with torque on, and torque off is asked for until every servo has acknowledged it.

Ctrl-C is for the controller, and so are the other polite signals; the guardian has a session of its own and ignores
them. A controller that is frozen (stopped, or stuck in a call) is not dead, and when it goes on it would talk at the
same time as this process: there the servos' own bus watchdog acts. It stops each servo 80 ms after the last packet,
with torque on, so that the robot is stiff where it was; a controller that goes on finds it tripped, and ends the run.

Only the standard library is used, so that it is up within some 20 ms and has next to nothing that can break.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import signal
import sys
import termios
import time
from dataclasses import dataclass
from pathlib import Path

PRIORITY = 60  # of SCHED_FIFO, above the controller's: it sleeps unless there is something to do
QUIET_SECONDS = 0.003  # of silence after which nothing is on its way any more: above a USB adapter's latency timer
DRAIN_SECONDS = 0.010  # after which a line that is never silent is talked over
DAMP_SECONDS = 0.030  # braked before torque goes off
DAMP_TIMES = 3  # nobody acknowledges gains, so they are sent more than once
SINGLE_SECONDS = 0.006  # that one servo may take to answer
GIVE_UP_SECONDS = 2.0
WRITE_SECONDS = 0.02  # that the adapter may take to accept a packet


@dataclass(frozen=True)
class ReleasePackets:
    """What to send, and what to hear. `ask` asks everybody in one packet, which takes `ask_seconds`."""

    port: int  # file descriptor
    name: str
    controller: int  # process ID
    damp: bytes
    off: bytes
    ask: bytes
    ask_seconds: float
    ask_one: dict[int, bytes]  # of each servo ID
    proof: dict[int, tuple[bytes, ...]]  # the answers of each servo that say: torque is off
    log: str  # file to add a line to, or nothing

    @classmethod
    def parse(cls, line: bytes) -> ReleasePackets:
        values = json.loads(line)
        for key in ("damp", "off", "ask"):
            values[key] = bytes.fromhex(values[key])
        values["ask_one"] = {int(id): bytes.fromhex(packet) for id, packet in values["ask_one"].items()}
        values["proof"] = {int(id): tuple(map(bytes.fromhex, each)) for id, each in values["proof"].items()}
        return cls(**values)


class GuardedPort:
    """The port, in the few ways that are needed here. Methods raise OSError when it is gone."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        os.set_blocking(fd, False)

    def read(self, seconds: float) -> bytes:
        """What comes within `seconds`, as soon as something does."""
        if not select.select([self._fd], [], [], max(0.0, seconds))[0]:
            # Silence and a port that is gone look the same to a tty's reader, but not to a question about it.
            _state(self._fd)
            return b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._fd, 65536)
            if not data:
                raise OSError("hung up")
            return data
        return b""

    def write(self, data: bytes) -> None:
        """Send; when the adapter takes no more, forget what is left, so that it cannot come out later in a burst."""
        end = time.monotonic() + WRITE_SECONDS
        while data:
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._fd, data) :]
            left = end - time.monotonic()
            if data and (left <= 0 or not select.select([], [self._fd], [], left)[1]):
                termios.tcflush(self._fd, termios.TCOFLUSH)
                return

    def drain(self) -> None:
        """Drop what comes until nothing does."""
        end = time.monotonic() + DRAIN_SECONDS
        while time.monotonic() < end and self.read(QUIET_SECONDS):
            pass


def release(plan: ReleasePackets) -> set[int]:
    """Brake, then torque off. Returns the IDs that did not acknowledge. Raises OSError when the port is gone."""
    line = GuardedPort(plan.port)
    line.drain()
    for _ in range(DAMP_TIMES):
        line.write(plan.damp)
        end = time.monotonic() + DAMP_SECONDS / DAMP_TIMES
        while (left := end - time.monotonic()) > 0:
            line.read(left)
    heard, open_ = bytearray(), set(plan.proof)

    def listen(seconds: float, wanted: set[int]) -> None:
        """Until all of `wanted` are proven or the time is over. An answer that is late proves as much: torque does not
        come back, as nobody is left to switch it on."""
        end = time.monotonic() + seconds
        while open_ & wanted and (left := end - time.monotonic()) > 0:
            heard.extend(line.read(left))
            open_.difference_update([id for id in open_ if any(answer in heard for answer in plan.proof[id])])
            del heard[:-4096]

    deadline = time.monotonic() + GIVE_UP_SECONDS
    line.write(plan.off + plan.ask)
    listen(plan.ask_seconds, set(open_))
    while open_ and time.monotonic() < deadline:
        line.drain()
        line.write(plan.off)
        for id in sorted(open_):  # one by one: a servo that is silent does not keep others from being heard
            line.write(plan.ask_one[id])
            listen(SINGLE_SECONDS, {id})
    return open_


def report(plan: ReleasePackets, left: set[int], seconds: float, gone: OSError | None) -> str:
    """One line for the person at the robot."""
    n = len(plan.proof)
    begins = f"servoid guardian: process {plan.controller} ended with torque on: "
    if gone is not None:
        return (
            f"{begins}{plan.name} cannot be reached either ({gone}): "
            "the servos' own watchdog stops them, stiff; switch their power off"
        )
    if left:
        names = ", ".join(map(str, sorted(left)))
        return (
            f"{begins}{n - len(left)} of {n} servos damped and off, no word from ID {names}: "
            "hold the robot and switch its power off"
        )
    return f"{begins}{n} of {n} servos damped, then torque off, acknowledged {seconds * 1000:.0f} ms after"


def wait(pipe: int, controller: int, unread: bytes) -> bool:
    """Until the controller is gone. Returns whether torque may be on."""
    watch = select.poll()
    watch.register(pipe, select.POLLIN)
    # A process that the controller forked may keep its end of the pipe open.
    with contextlib.suppress(OSError):  # an old kernel, or a controller that has ended already: the pipe tells
        watch.register(os.pidfd_open(controller), select.POLLIN)
    last = unread[-1:]
    while True:
        ready = {fd for fd, _ in watch.poll()}
        data = os.read(pipe, 4096) if pipe in ready else b""
        last = data[-1:] or last
        if not data:
            return last == b"+"


def main() -> int:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(PermissionError):  # without the right it is an ordinary process
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    pipe, received = sys.stdin.fileno(), b""
    while b"\n" not in received:
        data = os.read(pipe, 65536)
        if not data:
            return 0  # the controller ended before it had told anything
        received += data
    line, _, states = received.partition(b"\n")
    plan = ReleasePackets.parse(line)
    with contextlib.suppress(OSError):  # the controller is gone already: that is seen next
        os.write(sys.stdout.fileno(), b"ready\n")
    if not wait(pipe, plan.controller, states):
        return 0
    began, left, gone = time.monotonic(), set(plan.proof), None
    try:
        left = release(plan)
    except OSError as error:
        gone = error
    except termios.error as error:  # which is not an OSError
        gone = OSError(*error.args)
    _tell(report(plan, left, time.monotonic() - began, gone), plan.log)
    return 1 if left else 0


def _state(fd: int) -> None:
    """Raises OSError when the port is gone."""
    fcntl.ioctl(fd, termios.TIOCINQ, b"\0\0\0\0")


def _tell(text: str, log: str) -> None:
    """To whoever still reads, and to a file for when nobody does."""
    with contextlib.suppress(OSError):  # the terminal went with the controller
        os.write(2, f"{text}\n".encode())
    if log:
        with contextlib.suppress(OSError):  # a full disk must not look like a failure to let go
            Path(log).parent.mkdir(parents=True, exist_ok=True)
            with open(log, "a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")


if __name__ == "__main__":
    sys.exit(main())
