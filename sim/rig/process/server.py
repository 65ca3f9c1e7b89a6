"""A virtual rig in a process of its own: its serial port, its control socket, and its time.

    python -m servoid.sim.rig.process.server --robot op3 --link /tmp/rig --control /tmp/rig.sock --clock locked

The first line of standard output is a JSON object with `port` and `control`. Time is the machine's, or stands still
until the control connection that locked it advances it. When that connection closes, the rig goes on at the machine's
pace: servos whose controller was killed go on living.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import select
import shutil
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from servoid.hw.clock import wake_sharply
from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process import control_requests
from servoid.sim.rig.process.control_requests import Connection
from servoid.sim.rig.process.lateness import NOTICED_NS, Lateness, packets, sentence
from servoid.sim.rig.process.pty import Pty
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.factory_state import add_factory_state_arguments, factory_state_of
from servoid.sim.rig.wire.faults import Scenario, load_scenario

ClockKind = Literal["real", "locked"]
PICK_UP_SECONDS = 3.0  # without torque anywhere, before somebody picks a free-running robot up
_LONGEST_WAIT = 50_000_000  # ns of a packet for a line that is never quiet
_FARTHEST_BEHIND = 200_000_000  # ns that a rig hurries to catch up; of longer pauses the rest never happened


class Server:
    """Serves `rig`. `linger` [s]: how long to go on without a control connection and without a byte on the bus."""

    def __init__(
        self,
        rig: Rig,
        *,
        clock: ClockKind = "real",
        link: Path | None = None,
        control: Path | None = None,
        linger: float | None = None,
        told: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`told` hears when the rig was late. Raises OSError when the link or the socket cannot be made."""
        self.rig = rig
        self.lateness = Lateness(told)
        self._sent_ns = 0  # when the last of them went out
        self._waiting: deque[bytes] = deque()  # packets that came together because the rig was late
        left = control is not None and control.is_socket()  # unless a rig that runs has it
        self._listener = None if control is None else _listen(control)
        try:
            self.pty = Pty(link, left)
        except OSError:
            if self._listener is not None and control is not None:
                self._listener.close()
                control.unlink()
            raise
        self._locked = clock == "locked"
        self._linger = linger
        self._control_path = control
        self._connections: dict[int, Connection] = {}
        self._driver: int | None = None
        self._stalled = False
        self._running = True
        self._wall_ns = time.monotonic_ns()  # of rig time `_rig_ns`
        self._rig_ns = rig.now_ns
        self._used = time.monotonic()
        self._limp_since: int | None = None

    @property
    def port(self) -> str:
        return self.pty.port

    def stop(self) -> None:
        self._running = False

    def serve(self) -> None:
        """Until `stop`, or until nobody has used the rig for the time to linger."""
        gc.collect()
        gc.freeze()
        wake_sharply()
        try:
            while self._running and not self._abandoned():
                self._turn()
        finally:
            self.close()

    def _abandoned(self) -> bool:
        """Whether nobody has used the rig for longer than it lingers."""
        if self._linger is None or self._connections:
            return False
        return time.monotonic() - self._used > self._linger

    def close(self) -> None:
        self.pty.close()
        for connection in self._connections.values():
            connection.stream.close()
        if self._listener is not None:
            self._listener.close()
        if self._control_path is not None:
            self._control_path.unlink(missing_ok=True)

    def _turn(self) -> None:
        timeout = 0.2
        if not self._locked:
            self._exchange(self._wall_now(), visible=False)
            self._pick_up()
            timeout = max(0.0, (self.rig.next_event() - self._wall_now()) * 1e-9)
        watched: list[int] = list(self._connections)
        if self._listener is not None:
            watched.append(self._listener.fileno())
        if self.pty.is_open and not self._stalled and not self._locked:
            watched.append(self.pty.master)
        for ready in select.select(watched, [], [], timeout)[0]:
            if self._listener is not None and ready == self._listener.fileno():
                stream, _ = self._listener.accept()
                self._connections[stream.fileno()] = Connection(stream)
            elif ready in self._connections:
                self._requests(ready)

    def _wall_now(self) -> int:
        """Rig time by the machine's clock."""
        wall = time.monotonic_ns()
        now = self._rig_ns + wall - self._wall_ns
        if now - self.rig.now_ns > _FARTHEST_BEHIND:
            now = self.rig.now_ns + _FARTHEST_BEHIND
            self._wall_ns, self._rig_ns = wall, now
        return now

    def _exchange(self, to_ns: int, *, visible: bool) -> int:
        """Let the rig live until `to_ns` with what the host has sent; returns the bytes that the host can now read."""
        rig, pty = self.rig, self.pty
        sent = b""
        if pty.is_open and not self._stalled:
            sent = pty.read()
            rig.wire.host_baud = pty.baud or rig.wire.host_baud
        if visible:  # locked: what the host wrote, it wrote before time went on
            rig.host_sends(sent)
            heard = rig.advance(to_ns)
        else:
            heard = self._catch_up(sent, to_ns)
        if sent:
            self._used = time.monotonic()
        if rig.skew_ns:
            skew, rig.skew_ns = rig.skew_ns, 0
            self._rig_ns += skew
            heard += rig.advance(rig.now_ns + skew)
        if pty.is_open:
            pty.write(heard, visible=visible)
        self._plug()
        return len(heard)

    def _catch_up(self, sent: bytes, to_ns: int) -> bytes:
        """Live until `to_ns` in real time. What the host has written was written just now; of a rig that was late
        nobody can say when, so its packets count as written one after the other since it last looked, none into an
        answer."""
        rig = self.rig
        late = to_ns - rig.next_event()
        self.lateness.note(late, time.monotonic_ns())
        if late <= NOTICED_NS and not self._waiting:
            heard = rig.advance(to_ns)
            rig.host_sends(sent)
            return heard
        self._waiting += packets(sent)
        heard, began, count = b"", rig.now_ns, len(self._waiting)
        for i in range(count):
            heard += rig.advance(max(rig.now_ns, began + (to_ns - began) * i // count))
            while rig.wire.busy and rig.next_event() <= to_ns:
                heard += rig.advance(rig.next_event())
            if rig.wire.busy and rig.now_ns - self._sent_ns < _LONGEST_WAIT:
                break
            self._sent_ns = rig.now_ns
            rig.host_sends(self._waiting.popleft())
        return heard + rig.advance(to_ns)

    def _plug(self) -> None:
        """Make the port what the faults say."""
        if self.rig.port_open != self.pty.is_open:
            if self.rig.port_open:
                self.pty.open()
            else:
                self.pty.close()
            self._stalled = False
        if self.pty.is_open and self.rig.stalled != self._stalled:
            self._stalled = self.rig.stalled
            self.pty.stall(self._stalled)

    def _pick_up(self) -> None:
        """Nobody leaves a robot lying: without torque for a while, it is held at its home pose again."""
        rig = self.rig
        if rig.plant.held or rig.motors.firmware.powered.any() or self._connections:
            self._limp_since = None
        elif self._limp_since is None:
            self._limp_since = rig.now_ns
        elif rig.now_ns - self._limp_since > PICK_UP_SECONDS * 1e9:
            rig.place(rig.robot.home)

    # Control

    def _requests(self, number: int) -> None:
        connection = self._connections[number]
        lines = connection.lines()
        for line in lines or []:
            if not connection.answer(self._request(number, line)):
                lines = None
                break
        if lines is None:
            del self._connections[number]
            connection.stream.close()
            self._used = time.monotonic()
            if self._driver == number:
                self._driver = None
                self._run_free()

    def _run_free(self) -> None:
        self._locked = False
        self._wall_ns, self._rig_ns = time.monotonic_ns(), self.rig.now_ns

    def _request(self, number: int, line: bytes) -> dict[str, Any]:
        own: dict[str, Callable[..., dict[str, Any]]] = {
            "hello": self._hello,
            "lock": partial(self._lock, number),
            "advance": self._advance,
            "reset": self._reset,
            "lateness": self._lateness,
        }
        try:
            request = json.loads(line)
            name = request.pop("op")
            request_of = own[name] if name in own else control_requests.find(name, self.rig)
            return {"now": self.rig.now_ns, **request_of(**request)}
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError) as error:
            return {"error": f"{type(error).__name__}: {error}"}

    def _hello(self) -> dict[str, Any]:
        return {"robot": self.rig.robot.name, "port": self.port, "locked": self._locked}

    def _lock(self, number: int) -> dict[str, Any]:
        """From here on only this connection advances time."""
        if self._driver not in (None, number):
            raise ValueError("another connection has the clock")
        self._driver, self._locked = number, True
        return {}

    def _advance(self, to: int) -> dict[str, Any]:
        if not self._locked:
            raise ValueError("the clock is not locked")
        heard = self._exchange(max(to, self.rig.now_ns), visible=True)
        return {"now": self.rig.now_ns, "heard": heard}

    def _lateness(self) -> dict[str, Any]:
        """How often, and by how much, the rig was late since this was last asked."""
        times, worst = self.lateness.take()
        return {"times": times, "worst_ms": worst * 1e-6, "text": sentence(times, worst) if times else None}

    def _reset(self, seed: int, randomise: bool = False) -> dict[str, Any]:
        if self.pty.is_open:
            self.pty.flush()
        self._waiting.clear()
        self.rig.reset(seed, randomise=randomise)
        self._plug()
        return {}


def _listen(path: Path) -> socket.socket:
    """A control socket at `path`; one that a rig left behind is replaced. Raises OSError if another rig has it."""
    if path.is_socket():
        with socket.socket(socket.AF_UNIX) as other:
            if other.connect_ex(str(path)) == 0:
                raise OSError(f"{path}: another virtual rig is running there")
        path.unlink()
    listener = socket.socket(socket.AF_UNIX)
    try:
        listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise OSError(f"{path}: {error.strerror or error}") from error
    listener.listen()
    return listener


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", help="name or file")
    parser.add_argument("--link", type=Path, help="make a link of this name to the port")
    parser.add_argument("--faults", type=Path, help="fault scenario (YAML)")
    parser.add_argument("--clock", choices=("real", "locked"), default="real")
    parser.add_argument("--control", type=Path, help="control socket")
    add_factory_state_arguments(parser)


def build(
    args: argparse.Namespace, *, linger: float | None = None, told: Callable[[str], None] = lambda text: None
) -> Server:
    """A server as the arguments say. Raises ConfigError, and OSError for a link or socket that cannot be made."""
    scenario = load_scenario(args.faults) if args.faults else Scenario()
    factory_state = factory_state_of(args)
    rig = Rig(
        load_robot(args.robot), seed=args.seed, randomise=args.randomise, scenario=scenario, factory_state=factory_state
    )
    return Server(rig, clock=args.clock, link=args.link, control=args.control, linger=linger, told=told)


def main() -> int:
    parser = argparse.ArgumentParser(prog="servoid.sim.rig.process.server")
    add_arguments(parser)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--randomise", action="store_true")
    parser.add_argument("--linger", type=float)
    parser.add_argument("--folder", type=Path, help="a temporary folder, which goes when the rig ends")
    args = parser.parse_args()
    try:
        return _serve(args)
    finally:  # whoever made the folder may have been killed, which is why it goes from here
        if args.folder is not None:
            shutil.rmtree(args.folder, ignore_errors=True)


def _serve(args: argparse.Namespace) -> int:
    try:
        server = build(args, linger=args.linger)
    except (ConfigError, OSError) as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return 2

    def stop(signum: int, frame: FrameType | None) -> None:
        server.stop()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    try:
        print(json.dumps({"port": server.port, "control": str(args.control) if args.control else None}), flush=True)
    except BrokenPipeError:  # whoever started the rig is gone before it had begun
        server.close()
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    server.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
