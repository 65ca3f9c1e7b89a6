"""The flight log: what is written reads back, and survives kills, truncation and full disks."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from fake_body import StillEstimator, observation
from waiting import until

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Command, Mode
from servoid.hw.contracts.control import Adopted, Instruction, Plan
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.stack.log.flightlog import read_log
from servoid.stack.log.format import FORMAT
from servoid.stack.log.recorder import Recorder
from servoid.stack.log.tick import Proposal, TickRecord, Timing
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")
N = len(ROBOT.names)
CHOSEN = {"task": "walk", "backend": "sim", "robot": "op3", "policy": "gait", "seed": 3}
HEADER = {
    "format": FORMAT, "seed": 3, "settings": CHOSEN, "task": {}, "backend": "sim", "policy": {"name": "gait"},
    "robot": {"joints": [{"name": name} for name in ROBOT.names], "rate": ROBOT.rate, "feet": []},
}  # fmt: skip


def tick_record(tick: int, rng: np.random.Generator) -> TickRecord:
    seen = observation(ROBOT, tick * 20_000_000, rng.normal(size=N))
    plan = Plan(tick, rng.normal(size=(4, N)), rng.normal(size=(4, 9)), rng.normal(size=(4, 2)), 0.003)
    return TickRecord(
        tick=tick,
        phase=Phase.RUNNING,
        observation=replace(seen, temperature=np.full(N, np.nan), imu_age=np.asarray(np.inf)),
        state=StillEstimator(ROBOT).update(seen, ROBOT.home),
        command=Command(rng.normal(size=N), np.ones(N), Mode.ACTIVE),
        proposal=Proposal(
            instruction=Instruction(np.array([0.1, 0.0, 0.2]), goal=np.array([1.0, 0.5]), ground=np.array([0.3, -0.1])),
            percept=Percept("task", 0.0, goal=np.array([1.2, 0.5])),
            plan=Adopted(tick, tick + 2, plan) if tick % 4 == 0 else None,
        ),
        events=(Event(tick, tick * 0.02, "phase", None, "running"),) if tick == 1 else (),
        timing=Timing(1000, 0, 1, 2, 3, 4, 5, 6),
    )


def record(path, ticks=100, close=True):
    rng = np.random.default_rng(0)
    recorder = Recorder.create(path, HEADER, wait=True)
    records = [tick_record(i, rng) for i in range(ticks)]
    for item in records:
        recorder(item)
    if close:
        recorder.close({"outcome": "succeeded", "metrics": {"error": float("nan")}})
    return recorder, records


def test_everything_reads_back(tmp_path):
    recorder, records = record(tmp_path / "a.mcap")
    assert recorder.error is None
    log = read_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.header == HEADER
    assert log.result == {"outcome": "succeeded", "metrics": {"error": None}}
    for field in ("position", "temperature", "imu_age"):  # bit by bit, what is not finite too
        expected = np.array([getattr(item.observation, field) for item in records])
        np.testing.assert_array_equal(log.column("/observation", field), expected)
    np.testing.assert_array_equal(
        log.column("/command", "position"), np.array([item.command.position for item in records])
    )
    np.testing.assert_array_equal(log.ticks("/plan"), np.arange(0, 100, 4))
    assert log.messages["/plan"][1]["requested"] == 4
    assert log.messages["/plan"][1]["adopted"] == 6
    np.testing.assert_allclose(
        log.column("/plan", "path"), np.array([item.proposal.plan.plan.path for item in records[::4]]), rtol=1e-6
    )
    for name, sent in (("place", [1.2, 0.5]), ("goal", [1.0, 0.5]), ("ground", [0.3, -0.1])):
        np.testing.assert_allclose(log.column("/instruction", name)[0], sent, rtol=1e-6)
    assert [event["text"] for event in log.messages["/event"]] == ["running"]


def test_other_mcap_readers_understand_it(tmp_path):
    from mcap.reader import make_reader

    record(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}
    counts = {summary.channels[key].topic: n for key, n in summary.statistics.channel_message_counts.items()}
    assert counts["/observation"] == 100
    assert summary.statistics.chunk_count >= 100 / ROBOT.rate  # at least one a second


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_file_reads_back_to_its_last_chunk(tmp_path, share):
    record(tmp_path / "a.mcap")
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: int(share * len(data))])
    whole, cut = read_log(tmp_path / "a.mcap"), read_log(tmp_path / "b.mcap")
    assert not cut.complete
    assert cut.header == HEADER
    n = len(cut.ticks("/observation"))
    assert share * 100 - 25 <= n <= 100
    np.testing.assert_array_equal(cut.ticks("/observation"), whole.ticks("/observation")[:n])


@pytest.mark.parametrize("content", [b"", b"hello", bytes(5000)])
def test_what_is_no_log_is_refused(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(ConfigError, match=r"a\.mcap: not a flight log"):
        read_log(tmp_path / "a.mcap")


def test_a_missing_log_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        read_log(tmp_path / "a.mcap")


def test_a_log_is_never_overwritten(tmp_path):
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises(ConfigError, match="already exists"):
        Recorder.create(tmp_path / "a.mcap", HEADER)
    assert (tmp_path / "a.mcap").read_text() == "precious"


class FullDisk(io.BytesIO):
    """A file on a disk with room for so many bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room
        self.kept = b""

    def write(self, data) -> int:
        if len(self.kept) + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.kept += bytes(data)
        return len(data)


@pytest.mark.parametrize("room", [10, 60_000])
def test_a_full_disk_is_one_error_with_the_remedy_and_holds_nobody_up(tmp_path, monkeypatch, room):
    monkeypatch.setattr("servoid.stack.log.recorder.PATIENCE", None)  # who waits, waits for ever
    disk = FullDisk(room)
    recorder = Recorder(disk, HEADER, wait=True, name="run.mcap")
    rng = np.random.default_rng(0)
    for i in range(2000):  # more than the backlog holds
        recorder(tick_record(i, rng) if i < 50 else tick_record(0, rng))
    recorder.close({"outcome": "stopped"})
    assert recorder.error is not None
    assert "No space left on device" in recorder.error
    assert "run.mcap" in recorder.error
    assert "free some space" in recorder.error
    (tmp_path / "a.mcap").write_bytes(disk.kept)
    if room > 10_000:
        assert len(read_log(tmp_path / "a.mcap").ticks("/observation")) > 5


def test_a_disk_that_fills_at_the_very_end_holds_nobody_up(monkeypatch):
    """The last chunk is written when the recording is closed: nobody is to wait for items after that."""
    monkeypatch.setattr("servoid.stack.log.recorder.PATIENCE", None)
    disk = FullDisk(10**9)
    recorder = Recorder(disk, HEADER, name="run.mcap")
    recorder(tick_record(0, np.random.default_rng(0)))
    until(recorder._items.empty)  # then the header is written
    disk.room = 0
    recorder.close({})
    assert "No space left on device" in recorder.error


def test_a_disk_that_hangs_does_not_hold_up_a_real_loop(monkeypatch):
    monkeypatch.setattr("servoid.stack.log.recorder.PATIENCE", 0.2)
    monkeypatch.setattr("servoid.stack.log.recorder.BACKLOG", 5)

    answers = threading.Event()

    class Hung(io.BytesIO):
        def write(self, data) -> int:
            answers.wait()
            return len(data)

    recorder = Recorder(Hung(), HEADER, wait=False)
    rng = np.random.default_rng(0)
    for i in range(10):
        recorder(tick_record(i, rng))
    recorder.close({})  # whoever waits for the disk does so for ever
    assert "slower than the run" in recorder.error
    answers.set()


KILLED = """
import os, sys, time
sys.path[:0] = sys.argv[2].split(os.pathsep)
import numpy as np
from pathlib import Path
from test_recorder import HEADER, tick_record
from servoid.stack.log.recorder import Recorder
recorder, rng = Recorder.create(Path(sys.argv[1]), HEADER), np.random.default_rng(0)
for i in range(10_000):
    recorder(tick_record(i, rng))
    print(i, flush=True)
    time.sleep(0.005)
"""


@pytest.mark.slow
def test_a_killed_recording_loses_less_than_a_second(tmp_path):
    path = tmp_path / "a.mcap"
    here = os.pathsep.join(sys.path)
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path), here], stdout=subprocess.PIPE) as process:
        for line in process.stdout:
            if int(line) == 200:
                break
        process.send_signal(signal.SIGKILL)
    log = read_log(path)
    assert not log.complete
    ticks = log.ticks("/observation")
    assert ticks[-1] > 200 - ROBOT.rate
    np.testing.assert_array_equal(ticks, np.arange(len(ticks)))
