"""An IMU on a port of its own: read by its thread, over a real pseudo-terminal, dead or alive."""

from __future__ import annotations

import os
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from imu_bytes import rvc, wit_sample

from servoid.hw.contracts.body import BackendError
from servoid.hw.faults import IMU_DEAD, IMU_FROZEN, IMU_SILENT
from servoid.hw.imu.serial_imu import SerialImu
from servoid.hw.robot.description import Imu, load_robot

OP3 = load_robot().imu


class Sensor:
    """A sensor on the other side of a pty: sends a message every `period` s until it is told otherwise."""

    def __init__(self, kind: str = "witmotion", period: float = 0.005) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.kind, self.period, self.mode = kind, period, "alive"
        self.count = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def imu(self) -> Imu:
        return replace(OP3, kind=self.kind, port=os.ttyname(self.slave), signs=(1.0, 1.0, 1.0))

    def _run(self) -> None:
        while not self._end.wait(self.period):
            if self.mode != "silent":
                os.write(self.master, self._message())

    def _message(self) -> bytes:
        self.count += 1
        noise = 0 if self.mode in ("frozen", "dead") else self.count % 5
        force = (0, 0, 0) if self.mode == "dead" else (0, noise, 2048 if self.kind == "witmotion" else 1000)
        if self.kind == "witmotion":
            return wit_sample(force, (noise, 0, 1638))
        return rvc(self.count, yaw=0 if self.mode == "frozen" else 10 * self.count % 18000, force=force)

    def unplug(self) -> None:
        self.mode = "silent"
        time.sleep(2 * self.period)
        os.close(self.master)
        os.close(self.slave)
        self.master = self.slave = -1

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        if self.master >= 0:
            os.close(self.master)
            os.close(self.slave)


@pytest.fixture
def sensor() -> Iterator[Sensor]:
    sensor = Sensor()
    yield sensor
    sensor.close()


def until(condition: object, seconds: float = 2.0) -> float:
    """Wait for a condition; returns how long it took."""
    began = time.monotonic()
    while not condition():  # type: ignore[operator]
        assert time.monotonic() - began < seconds, "never"
        time.sleep(0.002)
    return time.monotonic() - began


@pytest.mark.parametrize("kind", ["witmotion", "bno08x"])
def test_samples_come_in_the_base_frame_with_their_age(kind: str) -> None:
    sensor = Sensor(kind)
    try:
        imu = replace(sensor.imu, mounting=(0.0, 0.0, np.pi))
        device = SerialImu(imu, 50.0)
        reading = device.read()
        assert reading.fault == 0
        assert reading.time_ns is not None
        assert 0 < (time.monotonic_ns() - reading.time_ns) * 1e-9 < 0.05
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
def test_an_imu_that_does_not_live_is_named_within_10_ticks(sensor: Sensor, mode: str, bit: int) -> None:
    device = SerialImu(sensor.imu, 50.0)
    sensor.mode = mode
    seen = until(lambda: device.read().fault == bit)
    reading = device.read()
    assert reading.time_ns is not None
    assert seen < 0.18
    if mode != "silent":
        assert np.isnan(reading.angular_velocity).all(), "it is not believed"
    first = reading.time_ns
    time.sleep(0.03)
    assert device.read().time_ns == first, "its age grows"
    sensor.mode = "alive"
    until(lambda: device.read().fault == 0)
    assert np.isfinite(device.read().specific_force).all()
    device.close()


def test_a_port_that_vanishes_is_silence_and_closing_is_no_error(sensor: Sensor) -> None:
    device = SerialImu(sensor.imu, 50.0)
    sensor.unplug()
    until(lambda: device.read().fault == IMU_SILENT)
    assert device.error is not None
    assert "gone" in device.error
    device.close()


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
    sensor = Sensor(period=period)
    try:
        sensor.mode = mode
        threads = threading.active_count()
        with pytest.raises(BackendError, match=words):
            SerialImu(replace(sensor.imu, **change), 50.0)
        assert threading.active_count() == threads
        sensor.mode, sensor.period = "alive", 0.005
        SerialImu(sensor.imu, 50.0).close()
    finally:
        sensor.close()


def test_a_port_that_is_not_there_says_so() -> None:
    with pytest.raises(BackendError, match="/dev/nothing: no such port"):
        SerialImu(replace(OP3, kind="witmotion", port="/dev/nothing"), 50.0)
