"""An IMU on a port of its own: read by its thread, over a real pseudo-terminal, dead or alive."""

from __future__ import annotations

import os
import queue
import threading
import tty
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from imu_bytes import rvc, wit_sample
from waiting import until

from servoid.hw.contracts.body import BackendError
from servoid.hw.faults import IMU_DEAD, IMU_FROZEN, IMU_SILENT
from servoid.hw.imu.serial_imu import SerialImu
from servoid.hw.robot.description import Imu, load_robot

OP3 = load_robot().imu
TICK = 20_000_000  # ns


class Messages:
    """What a sensor says, alive or dead."""

    def __init__(self, kind: str) -> None:
        self.kind, self.mode, self.count = kind, "alive", 0

    def next(self) -> bytes:
        self.count += 1
        noise = 0 if self.mode in ("frozen", "dead") else self.count % 5
        force = (0, 0, 0) if self.mode == "dead" else (0, noise, 2048 if self.kind == "witmotion" else 1000)
        if self.kind == "witmotion":
            return wit_sample(force, (noise, 0, 1638))
        return rvc(self.count, yaw=0 if self.mode == "frozen" else 10 * self.count % 18000, force=force)


class Line(Messages):
    """A sensor's port, and the time that it lives in, which passes only while somebody sleeps: a message every `period`
    s, taken by who reads before time goes on."""

    name, baud = "/dev/imu", OP3.baud

    def __init__(self, kind: str = "witmotion", period: float = 0.005) -> None:
        super().__init__(kind)
        self.now, self.closed = 0, False
        self._period = self._due = round(period * 1e9)
        self._sent: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._taken = threading.Event()

    def now_ns(self) -> int:
        return self.now

    def sleep_until(self, time_ns: int) -> None:
        while self._due <= time_ns:
            self.now, self._due = self._due, self._due + self._period
            if self.mode != "silent":
                self._taken.clear()
                self._sent.put(self.next())
                self._taken.wait()
        self.now = max(self.now, time_ns)

    def read(self) -> bytes:
        if self._sent.empty():
            self._taken.set()
            return b""
        return self._sent.get()

    def write(self, data: bytes) -> None: ...

    def set_baud(self, baud: int) -> None: ...

    def close(self) -> None:
        self.closed = True

    def device(self, **changes: Any) -> SerialImu:
        imu = replace(OP3, **{"kind": self.kind, "port": self.name, "signs": (1.0, 1.0, 1.0), **changes})
        return SerialImu(imu, 50.0, clock=self, opener=lambda *_: self)


class Sensor(Messages):
    """A sensor on the other side of a pty, in real time: sends a message every 5 ms until it is told otherwise."""

    def __init__(self, kind: str = "witmotion") -> None:
        super().__init__(kind)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.period = 0.005
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def imu(self) -> Imu:
        return replace(OP3, kind=self.kind, port=os.ttyname(self.slave), signs=(1.0, 1.0, 1.0))

    def _run(self) -> None:
        while not self._end.wait(self.period):
            if self.mode != "silent":
                os.write(self.master, self.next())

    def unplug(self) -> None:
        self._end.set()
        self._thread.join()  # it may be writing
        os.close(self.master)
        os.close(self.slave)
        self.master = self.slave = -1

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        if self.master >= 0:
            os.close(self.master)
            os.close(self.slave)


@pytest.mark.parametrize("kind", ["witmotion", "bno08x"])
def test_a_sample_has_the_time_that_it_was_taken_at(kind: str) -> None:
    """Before it went over the wire, which takes 2 to 4 ms."""
    line = Line(kind)
    device = line.device()
    sent = line.now // 5_000_000 * 5_000_000
    reading = device.read()
    assert reading.time_ns is not None
    assert 1_000_000 < sent - reading.time_ns < 4_000_000
    device.close()


@pytest.mark.parametrize("kind", ["witmotion", "bno08x"])
def test_samples_come_in_the_base_frame(kind: str) -> None:
    sensor = Sensor(kind)
    try:
        device = SerialImu(replace(sensor.imu, mounting=(0.0, 0.0, np.pi)), 5.0)
        until(lambda: device.read().fault == 0)
        reading = device.read()
        assert reading.time_ns is not None
        assert reading.specific_force == pytest.approx([0, 0, 9.81], abs=0.06)
        assert reading.angular_velocity[2] == pytest.approx(1.745 if kind == "witmotion" else np.radians(10), rel=0.01)
        assert np.linalg.norm(reading.orientation) == pytest.approx(1.0)
        first = reading.time_ns
        until(lambda: (device.read().time_ns or 0) > first + 50_000_000)
        threads = threading.active_count()
        device.close()
        assert threading.active_count() == threads - 1
    finally:
        sensor.close()


@pytest.mark.parametrize(("mode", "bit"), [("frozen", IMU_FROZEN), ("dead", IMU_DEAD), ("silent", IMU_SILENT)])
def test_an_imu_that_does_not_live_is_named_within_10_ticks(mode: str, bit: int) -> None:
    line = Line()
    device = line.device()
    line.mode = mode
    for _ in range(9):
        line.sleep_until(line.now + TICK)
        if (reading := device.read()).fault:
            break
    assert reading.fault == bit
    assert reading.time_ns is not None
    if mode != "silent":
        assert np.isnan(reading.angular_velocity).all(), "it is not believed"
    first = reading.time_ns
    line.sleep_until(line.now + TICK)
    assert device.read().time_ns == first, "its age grows"
    line.mode = "alive"
    line.sleep_until(line.now + TICK)
    assert device.read().fault == 0
    assert np.isfinite(device.read().specific_force).all()
    device.close()


def test_a_port_that_vanishes_is_silence_and_closing_is_no_error() -> None:
    sensor = Sensor()
    try:
        device = SerialImu(sensor.imu, 5.0)
        sensor.unplug()
        until(lambda: device.error is not None)
        assert device.error is not None
        assert "gone" in device.error
        assert device.read().fault == IMU_SILENT
        device.close()
    finally:
        sensor.close()


@pytest.mark.parametrize(
    ("change", "mode", "period", "words"),
    [
        ({}, "silent", 0.005, "no sample of a witmotion came at 115200 bit/s: check the cable"),
        ({"kind": "bno08x"}, "alive", 0.005, "no sample of a bno08x came .*something comes, but garbled"),
        ({}, "alive", 0.04, r"sends 2\d samples a second, but the loop needs 50: set its output rate"),
    ],
)
def test_an_imu_that_cannot_serve_is_refused_and_its_port_given_back(
    change: dict[str, str], mode: str, period: float, words: str
) -> None:
    line = Line(period=period)
    line.mode = mode
    threads = threading.active_count()
    with pytest.raises(BackendError, match=words):
        line.device(**change)
    assert threading.active_count() == threads
    assert line.closed


def test_a_port_that_is_not_there_says_so() -> None:
    with pytest.raises(BackendError, match="/dev/nothing: no such port"):
        SerialImu(replace(OP3, kind="witmotion", port="/dev/nothing"), 50.0)
