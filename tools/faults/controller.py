"""A `servoid run` in a process of its own, on a virtual rig that runs free: the target of faults.

Everything is as on hardware from the port up, in real time. What happened is judged by what the rig's servos took, and
when, by the rig's own clock.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servoid.hw.contracts.body import BackendError
from servoid.sim.rig.process.control import Control, RigProcess

STAND_SECONDS = 2.5  # from torque to the first step: homing a robot that is at home, and standing still
PRIORITY = 70  # of the rig by SCHED_FIFO, above the controller's: real servos do not wait for the host's processor
_START_SECONDS = 60.0
_END_SECONDS = 60.0
_GUARDIAN_SECONDS = 5.0
_FIGURES = re.compile(r".*  tick .*|\w+: \S+|\d+ ticks, .*|log: .*")  # that a run shows, and adds to how it ended


@contextmanager
def free_rig(robot: str = "op3", seed: int = 0) -> Iterator[RigProcess]:
    """A rig in real time. Without the right to SCHED_FIFO it lags where the machine is busy, and so do its answers."""
    with RigProcess(robot, clock="real", seed=seed) as rig:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(rig.process.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
        yield rig


class Controller:
    """A walk with the gait, which needs no planner. Close it, or use it as a context manager: it is ended then."""

    def __init__(self, rig: RigProcess, log: Path) -> None:
        self.rig, self.log = rig, log
        self._guardian = -1  # process ID, once it is on its own
        words = ["run", "walk", "--policy", "gait", "--set", "vx=0.1", "--set", "vy=0", "--set", "yaw_rate=0"]
        words += ["--seconds", "600", "--backend", "dynamixel", "--port", rig.port, "--start"]
        words += ["--record", str(log), "--json"]
        self._errors = tempfile.TemporaryFile("a+b")  # noqa: SIM115 - a pipe would fill up while nobody reads
        self.process = subprocess.Popen(
            [sys.executable, "-m", "servoid", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,  # a group of its own, to send it a Ctrl-C as a terminal does
            env={**os.environ, "XDG_STATE_HOME": str(log.parent)},
        )

    def wait_for(self, condition: Callable[[Control], bool]) -> bool:
        """Until the rig says so; False when the run ends before. Raises BackendError when it does neither."""
        deadline = time.monotonic() + _START_SECONDS
        while not condition(self.rig.control):
            if self.process.poll() is not None:
                return False
            if time.monotonic() > deadline:
                raise BackendError(f"the run has not begun within {_START_SECONDS:g} s: {self.last_words()}")
            time.sleep(0.01)
        return True

    def wait_on(self, seconds: float) -> bool:
        """Let it go on; False when it ended by itself meanwhile."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        return self.process.poll() is None

    def guardian(self) -> int:
        """Process ID of its guardian. Raises BackendError when it has none."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        for child in children:
            if b"guardian.py" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
        raise BackendError(f"process {self.process.pid} has no guardian")

    def kill(self, *, guarded: bool) -> int:
        """kill -9, of its guardian first if it is not to be `guarded`. Returns the rig's time just before [ns]."""
        self._guardian = self.guardian()
        mark = rig_time(self.rig)
        if not guarded:
            os.kill(self._guardian, signal.SIGKILL)  # with no time to be replaced
        self.process.kill()
        return mark

    def interrupt(self) -> int:
        """Ctrl-C, to its whole group. Returns the rig's time just before [ns]."""
        with contextlib.suppress(BackendError, OSError):  # it has none yet, or none any more, or has ended by itself
            self._guardian = self.guardian()
        mark = rig_time(self.rig)
        with contextlib.suppress(ProcessLookupError):  # it has ended by itself
            os.killpg(self.process.pid, signal.SIGINT)
        return mark

    def wait(self) -> int:
        """Its exit code, when it and its guardian have ended. Raises BackendError when it does not end."""
        try:
            code = self.process.wait(_END_SECONDS)
            deadline = time.monotonic() + _GUARDIAN_SECONDS
            while Path(f"/proc/{self._guardian}").exists() and time.monotonic() < deadline:
                time.sleep(0.005)
            return code
        except subprocess.TimeoutExpired:
            raise BackendError(f"the run did not end within {_END_SECONDS:g} s: {self.last_words()}") from None

    def errors(self) -> str:
        """What it, and its guardian, wrote to standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")

    def last_words(self) -> str:
        """What was said last of how it ended."""
        lines = [line.strip() for line in self.errors().splitlines()]
        told = [line for line in lines if line and not _FIGURES.fullmatch(line)]
        return "; ".join(told[-2:]) or "nothing was said"

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Controller:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
        self._errors.close()


def rig_time(rig: RigProcess) -> int:
    """The rig's clock [ns]."""
    return int(rig.control.call("hello")["now"])


def has_torque(control: Control) -> bool:
    """Whether every servo has torque."""
    return all(servo["torque"] for servo in control.servos())


def has_none(control: Control) -> bool:
    """Whether no servo has torque."""
    return not any(servo["torque"] for servo in control.servos())


def first_taken(writes: list[dict[str, Any]], register: str, value: int, since: int) -> dict[int, float]:
    """When each joint first took `value` in `register`, ms after `since` [ns]."""
    taken: dict[int, float] = {}
    for write in writes:
        if write["register"] == register and write["value"] == value and write["time_ns"] >= since:
            taken.setdefault(write["joint"], (write["time_ns"] - since) * 1e-6)
    return taken
