"""A rig in a process of its own: its clock, its control socket, and what happens when the controller goes."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import serial
from rig_host import BOARD, XM430
from waiting import until

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.rig.process.control import Control, LockedClock, RigProcess
from servoid.sim.rig.process.server import Server
from servoid.sim.rig.rig import Rig

MS = 1_000_000


class Locked:
    """A controller on a locked rig: every answer is there when the clock has passed its end."""

    def __init__(self, rig: RigProcess) -> None:
        self.rig, self.clock = rig, LockedClock(rig.control)
        self.port = serial.Serial(rig.port, rig.robot.bus.baud, timeout=0)
        self.ids = [joint.id for joint in rig.robot.joints]
        self.ask(codec.write(BOARD, 24, b"\1"))
        self.wait(400)

    def wait(self, ms: float) -> None:
        self.clock.sleep_until(self.clock.now_ns() + round(ms * MS))

    def ask(self, packet: bytes, ms: float = 4.0) -> bytes:
        self.port.write(packet)
        self.wait(ms)
        return self.port.read(self.port.in_waiting)


def walk_about(rig: RigProcess) -> tuple[list[bytes], list[dict[str, object]], list[float]]:
    """Torque on, arms about: what was heard, accepted, and true at the end."""
    host = Locked(rig)
    item = XM430.item("goal_position")
    home = [2048 + round(float(angle) / item.scale) for angle in rig.robot.home]
    heard = [host.ask(codec.sync_read(host.ids, 132, 4, fast=True))]
    for tick in range(30):
        wave = round(150 * np.sin(tick / 5))
        goals = {id: item.encode(home[i] + (wave if i in (2, 5) else 0)) for i, id in enumerate(host.ids)}
        host.port.write(codec.sync_write(116, 4, goals))
        host.wait(2)
        if tick == 0:
            host.ask(codec.sync_write(64, 1, dict.fromkeys(host.ids, b"\1")), 2)
        heard.append(host.ask(codec.sync_read(host.ids, 126, 10, fast=True), 4))
        host.wait(14)
    host.port.close()
    truth = rig.truth().fetch()
    return heard, rig.control.accepted(), [*truth.qpos[0], *truth.angular_velocity[0]]


@pytest.mark.slow
def test_two_locked_runs_are_the_same_bit_for_bit() -> None:
    runs = []
    for _ in range(2):
        with RigProcess(seed=3) as rig:
            runs.append(walk_about(rig))
    assert runs[0] == runs[1]
    heard, accepted, _ = runs[0]
    assert all(len(answer) == 8 + 20 * 14 for answer in heard[1:]), "an answer was not there when the clock said so"
    assert len(accepted) == 31 * 20


def test_a_reset_rig_repeats_itself_and_another_seed_does_not() -> None:
    with RigProcess() as rig:
        imu = []
        for seed in (3, 3, 4):
            rig.control.reset(seed, randomise=True)
            host = Locked(rig)
            imu.append(host.ask(codec.read(BOARD, 32, 12))[9:-2])
            host.port.close()
        assert imu[0] == imu[1] != imu[2]


def test_time_stands_still_until_the_controller_lets_it_pass() -> None:
    with RigProcess() as rig:
        clock = LockedClock(rig.control)
        before = clock.now_ns()
        time.sleep(0.1)
        assert rig.control.call("hello")["now"] == before
        clock.sleep_until(before + 20 * MS)
        assert clock.now_ns() == before + 20 * MS
        clock.sleep_until(before)
        assert clock.now_ns() == before + 20 * MS
        observer = Control(rig.control_path)
        with pytest.raises(BackendError, match="another connection has the clock"):
            LockedClock(observer)
        with pytest.raises(BackendError, match="no joint 'l_kne'"):
            rig.control.inject("dead", servo="l_kne")
        with pytest.raises(BackendError, match=r"unknown request 'truht'.*truth"):
            observer.call("truht")
        observer.close()


def test_servos_go_on_living_when_the_controller_dies() -> None:
    """The watchdog stops them: nobody feeds it, and time goes on."""
    with RigProcess() as rig:
        host = Locked(rig)
        watchdog = XM430.item("bus_watchdog")
        host.ask(codec.sync_write(64, 1, dict.fromkeys(host.ids, b"\1")))
        host.ask(codec.sync_write(watchdog.address, 1, dict.fromkeys(host.ids, b"\5")))
        observer = Control(rig.control_path)
        assert not any(servo["tripped"] for servo in observer.servos())
        rig.control.close()  # what a killed process leaves
        until(lambda: all(servo["tripped"] and servo["torque"] for servo in observer.servos()))
        assert observer.call("hello")["now"] > host.clock.now_ns() + 100 * MS
        rig.control = observer
        host.port.close()


def test_a_clock_step_and_a_vanishing_port() -> None:
    with RigProcess() as rig:
        host = Locked(rig)
        before = host.clock.now_ns()
        rig.control.inject("clock_step", value=0.5)
        host.wait(20)
        assert host.clock.now_ns() == before + 520 * MS
        rig.control.inject("stall", until=0.05)
        host.wait(8)
        host.port.write_timeout = 0.05
        with pytest.raises(serial.SerialTimeoutException):
            host.port.write(codec.ping(1))
        host.wait(100)
        host.port.write(codec.ping(1))
        host.wait(4)
        assert host.port.in_waiting >= 14
        rig.control.inject("vanish")
        host.wait(8)
        with pytest.raises(OSError, match="Input/output error"):
            _ = host.port.in_waiting


class FreeRig:
    """A server in real time that only looks at its port when it is told what time it is: a busy machine at will."""

    def __init__(self, rig: Rig, told: list[str]) -> None:
        self.server = Server(rig, told=told.append)
        self.port = serial.Serial(self.server.port, rig.robot.bus.baud, timeout=0)
        self.rig = rig
        self.port.write(codec.write(BOARD, 24, b"\1"))
        for _ in range(400):
            self.look(1.0)
        self.port.reset_input_buffer()

    def look(self, ms: float) -> None:
        """Look at the port, so long after the last time."""
        self.server._exchange(self.rig.now_ns + round(ms * MS), visible=False)

    def heard(self) -> list[int]:
        """Who answered."""
        data = b""
        for _ in range(20):  # the kernel may take a moment to hand the bytes over
            data += self.port.read(4096)
            time.sleep(0.01)
        return [packet.id for packet in codec.PacketParser().feed(data)]


def test_reads_that_a_late_rig_finds_together_were_not_sent_into_answers(rig: Rig, robot: Robot) -> None:
    """Twenty reads some ms apart, each after the other's answer or its time, on a machine that had no time for the rig:
    all at once they would count as collisions. It says that it was late."""
    told: list[str] = []
    free, ids = FreeRig(rig, told), [joint.id for joint in robot.joints]
    assert told == []
    for id in ids:
        free.port.write(codec.read(id, 132, 4))
    free.look(50.0)
    assert free.heard() == ids
    assert rig.wire.collisions == 0
    assert len(told) == 1
    assert "late" in told[0]
    assert "busy" in told[0]
    assert free.server.lateness.worst_ns > 40 * MS
    free.port.write(codec.sync_write(64, 1, dict.fromkeys(ids, b"\1")) + codec.read(1, 64, 1))
    free.look(4.0 + 1.0)
    assert free.heard() == [1]
    free.server.close()


def test_a_rig_that_is_late_does_not_starve_its_servos(rig: Rig, robot: Robot) -> None:
    """What the host wrote every 20 ms feeds the watchdog of 80 ms, though the rig saw none of it for 120."""
    free, ids = FreeRig(rig, []), [joint.id for joint in robot.joints]
    watchdog = XM430.item("bus_watchdog")
    free.port.write(codec.sync_write(64, 1, dict.fromkeys(ids, b"\1")))
    free.port.write(codec.sync_write(watchdog.address, 1, dict.fromkeys(ids, b"\4")))
    free.look(2.0)
    free.look(2.0)
    for _ in range(6):
        free.port.write(codec.sync_write(116, 4, {id: b"\0\x08\0\0" for id in ids}))
    free.look(120.0)
    assert not any(servo.tripped for servo in rig.servos)
    free.look(120.0)
    assert all(servo.tripped for servo in rig.servos)
    free.server.close()


def test_an_unused_rig_ends_by_itself(tmp_path: Path) -> None:
    control = tmp_path / "control"
    command = [sys.executable, "-m", "servoid.sim.rig.process.server", "--control", str(control), "--linger", "0.5"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline()
    assert process.wait(120) == 0
    assert not control.exists()
    process.stdout.close()


_STARTED = """
import sys, time
from servoid.sim.rig.process.control import LockedClock, RigProcess
rig = RigProcess(linger=float(sys.argv[1]))
clock = LockedClock(rig.control)
print(rig.process.pid, rig.port, rig._folder.name, flush=True)
time.sleep(60)
"""


@pytest.mark.slow
def test_a_rig_whose_controller_was_killed_lives_on_and_then_leaves_nothing_behind() -> None:
    """As long as somebody talks to its servos, and no longer: a guardian does for a moment."""
    parent = subprocess.Popen([sys.executable, "-c", _STARTED, "2"], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid, port, folder = parent.stdout.readline().split()
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert Path(folder).is_dir()
    with serial.Serial(port, 2_000_000, timeout=1.0) as line:
        answers = 0
        for _ in range(10):  # more than twice as long as it would linger without
            line.write(codec.ping(BOARD))
            answers += len(line.read(14)) == 14  # on a busy machine it may take longer
            time.sleep(0.5)
        assert Path(f"/proc/{pid}").exists()
        assert answers > 2
    until(lambda: not Path(f"/proc/{pid}").exists(), "the rig is an orphan")
    assert not Path(folder).exists()


def test_a_rig_whose_controller_was_killed_before_it_had_begun_leaves_nothing_behind(tmp_path: Path) -> None:
    folder = tmp_path / "rig"
    folder.mkdir()
    command = [sys.executable, "-m", "servoid.sim.rig.process.server", "--linger", "60", "--folder", str(folder)]
    process = subprocess.Popen([*command, "--control", str(folder / "control")], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(60) != 0
    assert not folder.exists()


def test_the_command_serves_a_linked_port_until_ctrl_c(tmp_path: Path) -> None:
    link = tmp_path / "rig"
    command = [sys.executable, "-m", "servoid", "virtual", "--link", str(link)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert str(link) in process.stdout.readline()
    with serial.Serial(str(link), 2_000_000, timeout=1.0) as port:
        port.write(codec.ping(BOARD))
        assert port.read(14)[4] == BOARD
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 0
    assert not os.path.lexists(link)
    process.stdout.close()


def test_two_rigs_do_not_share_a_control_socket_but_a_leftover_is_replaced(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "control"
    rig = Rig(robot)
    first = Server(rig, control=path)
    with pytest.raises(OSError, match="another virtual rig"):
        Server(rig, control=path)
    first._listener.close()  # as a killed one leaves it
    second = Server(rig, control=path)
    second.close()
    first.pty.close()


def test_a_rig_that_cannot_start_says_why(tmp_path: Path) -> None:
    faults = tmp_path / "faults.yaml"
    faults.write_text("faults:\n  - {kind: nonsense}")
    with pytest.raises(BackendError, match=r"faults.yaml:2"):
        RigProcess(faults=faults)


@pytest.mark.parametrize("seed", range(4))
def test_no_bytes_whatever_upset_a_rig(seed: int) -> None:
    """Random and mutated packets: no exception, no hang, no growth, and the rig still answers."""
    rng = random.Random(seed)
    robot = load_robot()
    rig = Rig(robot)
    rig.wire.host_baud = robot.bus.baud
    rig.host_sends(codec.write(BOARD, 24, b"\1"))
    rig.advance(400 * MS)
    ids = [joint.id for joint in robot.joints]
    instructions = [*range(16), 0x20, 0x55, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A]
    keep = {7, 8, 9, 12, 24, 68}  # registers after which silence would be right
    for _ in range(400):
        kind = rng.random()
        if kind < 0.3:
            data = rng.randbytes(rng.randrange(1, 80))
        else:
            id = rng.choice([*ids, BOARD, 254, rng.randrange(253)])
            params = rng.randbytes(rng.randrange(0, 40))
            if params and rng.random() < 0.7:
                params = bytes([rng.randrange(64, 150)]) + b"\0" + params[2:]
            data = codec.packet(id, rng.choice(instructions), params)
            if kind > 0.9:
                data = bytes(b ^ (rng.random() < 0.02) for b in data)
            addresses = set(range(params[0], params[0] + len(params))) if params else set()
            if addresses & keep or (params and params[0] < 64) or data[7] in (6, 8):
                continue
        rig.host_sends(data)
        rig.advance(rig.now_ns + 3 * MS)
    assert len(rig.wire._line) < 1000
    assert rig.dispatcher._parser.pending < 4096
    rig.advance(rig.now_ns + 400 * MS)
    rig.host_sends(codec.ping(BOARD))
    assert len(rig.advance(rig.now_ns + 20 * MS)) >= 14
