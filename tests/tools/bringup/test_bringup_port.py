"""Beside another program, and on a noisy line: what is wrong is named, and no servo is blamed for it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_bringup_scan import AT_2M, bus_of

from servoid.hw.dynamixel.transport.openers import openers
from servoid.sim.rig.process.control import RigProcess

READER = """
import sys
from dynamixel_sdk import PacketHandler, PortHandler
port = PortHandler(sys.argv[1])
port.openPort()
port.setBaudRate(2000000)
print("reading", flush=True)
while True:
    PacketHandler(2.0).read4ByteTxRx(port, 5, 132)
"""


@pytest.fixture
def reader(rig: RigProcess, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A program that reads ID 5 through the official SDK, which asks for no lock."""
    script = tmp_path / "reads_id_5.py"
    script.write_text(READER)
    process = subprocess.Popen([sys.executable, str(script), rig.port], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "reading\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.mark.parametrize("verb", [("scan",), ("check",), ("setup", "l_knee"), ("off",), ("watch", "--seconds", "1")])
def test_another_program_on_the_port_is_named_first(
    rig: RigProcess, bringup: Any, reader: subprocess.Popen[str], verb: tuple[str, ...]
) -> None:
    code, answer, _ = bringup(*verb, "--port", rig.port)
    assert code == 3
    expected = f"{rig.port}: another program has the port: reads_id_5.py (process {reader.pid}): end it first"
    assert answer["error"] == expected
    reader.kill()
    reader.wait()
    assert openers(rig.port) == [], "the remedy works; the rig that serves the port is no opener"


def test_who_serves_a_port_and_who_is_asking_are_no_openers(rig: RigProcess) -> None:
    with bus_of(rig):
        assert openers(rig.port) == []
    assert openers("/dev/null") == openers("/nonexistent") == openers("/etc/passwd") == []


@pytest.mark.slow
def test_noise_is_not_blamed_on_servos(rig: RigProcess, bringup: Any) -> None:
    with bus_of(rig):
        rig.control.inject("babble")
    code, found, _ = bringup("scan", *AT_2M)
    assert code == 3
    assert not any("two servos have this ID" in text for text in found["problems"]), found["problems"]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_damage_that_comes_and_goes_is_no_second_servo(rig: RigProcess, bringup: Any, share: float) -> None:
    with bus_of(rig):
        rig.control.inject("corrupt", servo="l_knee", probability=share)
    code, found, _ = bringup("scan", *AT_2M)
    assert not any("two servos have this ID" in text for text in found["problems"]), found["problems"]
    assert code in (0, 3)


def test_a_program_that_comes_later_is_named_too(rig: RigProcess, bringup: Any) -> None:
    """It asks for no lock, and a pseudo-terminal knows none that holds."""
    from servoid.hw.dynamixel.servos.bus_scan import census

    with bus_of(rig) as bus:
        rig.control.inject("id_conflict", servo="l_knee")
        code = "import sys, time; f = open(sys.argv[1], 'rb', buffering=0); print(1, flush=True); time.sleep(60)"
        other = subprocess.Popen([sys.executable, "-c", code, rig.port], stdout=subprocess.PIPE)
        try:
            assert other.stdout is not None
            other.stdout.readline()
            problems = census(bus, [2_000_000]).problems
        finally:
            other.kill()
            other.wait()
            assert other.stdout is not None
            other.stdout.close()
    assert any(f"(process {other.pid}) uses the port as well" in text for text in problems), problems
    assert not any("two servos" in text for text in problems)


def test_what_is_no_serial_port_is_called_that(bringup: Any) -> None:
    code, answer, _ = bringup("scan", "--port", "/dev/null")
    assert code == 3
    assert answer["error"] == "/dev/null: is no serial port: servoid bringup find-port lists them"
