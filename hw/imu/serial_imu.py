"""An IMU on a serial port of its own, read by a thread: the loop takes what is newest and never waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servoid.hw.clock import WallClock
from servoid.hw.contracts.body import BackendError, Clock
from servoid.hw.dynamixel.transport.port import Port, SerialPort
from servoid.hw.faults import IMU_DEAD, IMU_FROZEN, IMU_SILENT
from servoid.hw.imu.bno08x import Bno08x
from servoid.hw.imu.mounting import Mounting
from servoid.hw.imu.reading import Decoder, Reading, Sample
from servoid.hw.imu.witmotion import WitMotion
from servoid.hw.robot.description import Imu

FROZEN_SECONDS = 0.08  # of equal samples that a living sensor, which has noise, does not give; 4 ticks of 20 ms
FROZEN_SAMPLES = 4  # and at least so many repetitions
START_SECONDS = 2.0  # for the first samples to come
RATE_SAMPLES = 20  # that the rate is judged by
RATE_MARGIN = 0.9  # of the rate that is needed: a sensor's clock is its own
_BITS = 10  # of a byte on the wire
_WAIT_SECONDS = 0.1  # that the thread sleeps at most, and so what closing takes


class _Newest(NamedTuple):
    sample: Sample
    time_ns: int  # when it was sampled
    changed_ns: int  # when its values were last others than those before
    repeats: int


def decoder(imu: Imu) -> Decoder:
    """The decoder of a kind of sensor."""
    if imu.kind == "witmotion":
        return WitMotion()
    if imu.kind == "bno08x":
        return Bno08x(imu.yaw_sign)
    raise ValueError(f"an IMU of kind '{imu.kind}' has no serial port of its own")


class SerialImu:
    """The IMU that a robot's file names. `slowest` [Hz] is the rate that it must have, that of the loop."""

    def __init__(
        self,
        imu: Imu,
        slowest: float,
        *,
        clock: Clock | None = None,
        opener: Callable[[str, int], Port] = SerialPort,
    ) -> None:
        """Opens the port and waits until samples come. Raises BackendError with the remedy, the port closed again."""
        assert imu.port is not None  # the robot's file was checked
        self.name, self.kind = imu.port, imu.kind
        self.error: str | None = None  # why the thread gave up
        self.decoder = decoder(imu)
        self._mounting = Mounting(imu.signs, imu.mounting)
        self._clock = clock or WallClock()
        self._port = opener(imu.port, imu.baud)
        self._newest: _Newest | None = None  # replaced as a whole, so that no lock is needed
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="imu", daemon=True)
        self._thread.start()
        try:
            self._expect(slowest)
        except BaseException:
            self.close()
            raise

    def read(self) -> Reading:
        """The newest sample with the time that it was taken at, or why there is none that is valid."""
        newest = self._newest
        if newest is None:
            return Reading(fault=IMU_SILENT)
        sample = newest.sample
        if newest.repeats >= FROZEN_SAMPLES and newest.time_ns - newest.changed_ns >= FROZEN_SECONDS * 1e9:
            return Reading(newest.changed_ns, IMU_FROZEN)
        if not any(sample.specific_force):
            return Reading(newest.changed_ns, IMU_DEAD)  # nothing weighs nothing
        silent = self.error is not None or self._clock.now_ns() - newest.time_ns > FROZEN_SECONDS * 1e9
        return Reading(
            newest.time_ns,
            IMU_SILENT if silent else 0,
            self._mounting.to_base(np.array(sample.angular_velocity)),
            self._mounting.to_base(np.array(sample.specific_force)),
            self._mounting.orientation(sample.orientation),
        )

    def close(self) -> None:
        """End the thread and give the port back."""
        self._stop.set()
        self._thread.join()
        self._port.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                if isinstance(self._port, SerialPort):
                    self._port.wait(_WAIT_SECONDS)
                else:
                    self._stop.wait(0.001)
                if data := self._port.read():
                    self._take(data)
        except BackendError as error:  # the port is gone: the sample's age says so to the loop
            self.error = str(error)

    def _take(self, data: bytes) -> None:
        now = self._clock.now_ns()
        # The first byte left the sensor as long ago as the sample takes on the wire.
        time_ns = now - round(self.decoder.frame_bytes * _BITS * 1e9 / self._port.baud)
        for sample in self.decoder.feed(data):
            last = self._newest
            if last is not None and sample.number == last.sample.number:
                self._newest = last._replace(sample=sample)  # its orientation came later
            elif last is not None and sample.raw == last.sample.raw:
                self._newest = _Newest(sample, time_ns, last.changed_ns, last.repeats + 1)
            else:
                self._newest = _Newest(sample, time_ns, time_ns, 0)

    def _expect(self, slowest: float) -> None:
        """Wait for RATE_SAMPLES and judge their rate."""
        began = self._clock.now_ns()
        first: _Newest | None = None
        while True:
            newest = self._newest
            first = first or newest
            if first is not None and newest is not None and newest.sample.number >= first.sample.number + RATE_SAMPLES:
                break
            if self.error is not None:
                raise BackendError(f"the IMU: {self.error}")
            if self._clock.now_ns() - began > START_SECONDS * 1e9:
                raise BackendError(self._complaint(first, newest, slowest))
            self._clock.sleep_until(self._clock.now_ns() + 2_000_000)
        rate = RATE_SAMPLES / max((newest.time_ns - first.time_ns) * 1e-9, 1e-9)
        if rate < RATE_MARGIN * slowest:
            raise BackendError(self._complaint(first, newest, slowest))

    def _complaint(self, first: _Newest | None, newest: _Newest | None, slowest: float) -> str:
        if first is None or newest is None:
            garbled = " (something comes, but garbled)" if self.decoder.garbage else ""
            return (
                f"{self.name}: no sample of a {self.kind} came at {self._port.baud} bit/s{garbled}: check the cable, "
                "the sensor's output, and imu.kind and imu.baud in the robot's file"
            )
        passed = max((newest.time_ns - first.time_ns) * 1e-9, 1e-9)
        rate = (newest.sample.number - first.sample.number) / passed
        return (
            f"{self.name}: the {self.kind} sends {rate:.0f} samples a second, but the loop needs {slowest:g}: set its "
            "output rate to 100 or more"
        )
