"""The controller's end of the guardian: a pipe that closes when this process ends, however it ends."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel import guardian
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import ALERT, FRAME_BITS, OVERHEAD
from servoid.hw.dynamixel.protocol.tables import ControlTable
from servoid.hw.dynamixel.transport.port import SerialPort
from servoid.hw.user_folders import user_folder

READY_SECONDS = 5.0  # that a busy machine may take to start it; torque waits for that
CLOSE_SECONDS = guardian.GIVE_UP_SECONDS + 1.0
STARTS = 5  # in a run; one that is killed is replaced, one that cannot live is an error
PROOF_BYTES = 2  # torque and LED: of no other length that a controller reads, so that no other answer looks alike


class Lifeline:
    """Keeps a guardian process beside this one while torque may be on."""

    def __init__(self, port: SerialPort, ids: Sequence[int], table: ControlTable, return_delay: float) -> None:
        """Start the guardian of the servos `ids`, which answer after `return_delay` [s]. `table` is of any of them:
        the registers of torque and gains are the same in all models. Raises BackendError when it cannot be started."""
        self._port = port
        self._plan = plan(port, ids, table, return_delay)
        self._on = False
        self._starts = 0
        self._process = self._start()

    @property
    def pid(self) -> int:
        """Process ID of the guardian."""
        return self._process.pid

    def hold(self) -> None:
        """Torque is about to come on. Raises BackendError when the guardian is not there to switch it off."""
        self.check()
        out = self._process.stdout
        if out is not None:
            heard = out.readline() if select.select([out], [], [], READY_SECONDS)[0] else b""
            if heard != b"ready\n":
                raise BackendError("the guardian process did not start: torque stays off; is the machine overloaded?")
            out.close()
            self._process.stdout = None
        self._on = True
        self._say(b"+")

    def let_go(self) -> None:
        """Every servo has said that its torque is off."""
        self._on = False
        self._say(b"-")

    def check(self) -> None:
        """Replace a guardian that was killed. Raises BackendError when it does not live."""
        if self._process.poll() is not None:
            if self._starts >= STARTS:
                raise BackendError(
                    f"the guardian process ended {STARTS} times, the last with code {self._process.returncode}: "
                    "find out what ends it"
                )
            process = self._start()  # first: where it cannot be started, torque off must still be possible
            self._forget()
            self._process = process
            self._say(b"+" if self._on else b"-")

    def close(self) -> bool:
        """End the guardian; when torque may still be on, after it has done its work. Returns whether it had to, and
        every servo has told it that its torque is off."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # nobody reads it any more
            self._process.stdin.close()
        try:
            self._process.wait(CLOSE_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._forget()
        return self._on and self._process.returncode == 0

    def _start(self) -> subprocess.Popen[bytes]:
        self._starts += 1
        command = [sys.executable, "-I", "-S", guardian.__file__]
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=(self._port.fileno(),),
                start_new_session=True,  # Ctrl-C goes to everybody in the terminal's group
                cwd="/",
            )
        except OSError as error:
            raise BackendError(f"the guardian process cannot be started ({error}): torque stays off") from error
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it ended at once, which `hold` finds out
            process.stdin.write(self._plan)
        return process

    def _say(self, word: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it was killed: `check` replaces it, and says it again
            self._process.stdin.write(word)

    def _forget(self) -> None:
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()


def plan(port: SerialPort, ids: Sequence[int], table: ControlTable, return_delay: float) -> bytes:
    """The guardian's plan as a line: what brakes the servos, what lets them go, and what proves that it did."""
    torque, first, last = (table.item(name) for name in ("torque_enable", "position_d_gain", "position_p_gain"))
    gains = bytes(last.end - first.address)
    answers = len(ids) * ((OVERHEAD + PROOF_BYTES) * FRAME_BITS / port.baud + return_delay)
    values = {
        "port": port.fileno(),
        "name": port.name,
        "controller": os.getpid(),
        "damp": codec.sync_write(first.address, len(gains), {id: gains for id in ids}).hex(),
        "off": codec.sync_write(torque.address, 1, {id: b"\0" for id in ids}).hex(),
        "ask": codec.sync_read(ids, torque.address, PROOF_BYTES).hex(),
        "ask_seconds": answers + guardian.SINGLE_SECONDS,
        "ask_one": {id: codec.read(id, torque.address, PROOF_BYTES).hex() for id in ids},
        "proof": {id: [answer.hex() for answer in _proofs(id)] for id in ids},
        "log": str(log_path() or ""),
    }
    return json.dumps(values).encode() + b"\n"


def log_path() -> Path | None:
    """Where guardians write down what they did, as the terminal may be gone with the controller; None for a user
    without a home."""
    folder = user_folder("XDG_STATE_HOME", ".local/state")
    return None if folder is None else folder / "guardian.log"


def _proofs(id: int) -> list[bytes]:
    """Whole answers of a servo that say: torque is off, whatever its LED and its alert bit."""
    return [codec.status(id, alert, bytes([0, led])) for alert in (0, ALERT) for led in (0, 1)]
