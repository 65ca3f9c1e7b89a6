"""Faults: read from YAML, struck when and where they are meant to, and gone when they end."""

from __future__ import annotations

from pathlib import Path

import pytest
from rig_host import BOARD, Host

from servoid.hw.config import ConfigError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import parse_fast
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.wire.faults import EXPECTED, KINDS, Fault, Outcome, load_scenario


def inject(rig: Rig, kind: str, **values: object) -> None:
    rig.inject(Fault(kind, at=rig.seconds, **values))  # type: ignore[arg-type]
    rig.advance(rig.now_ns + 8_000_000)


def test_every_fault_says_what_is_expected_of_the_controller() -> None:
    assert set(EXPECTED) == set(KINDS)
    assert Fault("drop", expect="named").outcome is Outcome.NAMED
    assert Fault("drop").outcome is Outcome.ABSORBED


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("faults:\n  - {kind: dorp}", r"faults.yaml:2: faults\[0\].kind.*drop"),
        ("faults:\n  - {kind: drop, probability: 2}", "probability 2.0"),
        ("faults:\n  - {kind: dead, at: 1}", "needs a servo"),
        ("faults:\n  - {kind: drop, at: 2, until: 1}", "no span of time"),
        ("faults:\n  - {kind: drop, servos: 3}", "unknown key.*servo"),
    ],
)
def test_a_wrong_scenario_names_line_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        load_scenario(path)


def test_an_unknown_servo_is_refused_with_the_nearest(robot: Robot, tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text("faults:\n  - {kind: dead, servo: l_kne, at: 1}")
    with pytest.raises(ConfigError, match="l_knee"):
        Rig(robot, scenario=load_scenario(path))


def test_a_scenario_strikes_by_time_and_servo(robot: Robot, tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text("seed: 1\nfaults:\n  - {kind: dead, servo: l_knee, at: 0.5, until: 0.6}")
    host = Host(Rig(robot, scenario=load_scenario(path)), robot)
    host.start()
    assert len(host.ask(codec.ping(14))) == 1
    host.wait(0.18)
    assert host.ask(codec.ping(14)) == []
    assert len(host.ask(codec.ping(13))) == 1
    host.wait(0.4)
    assert len(host.ask(codec.ping(14))) == 1


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("kind", ["drop", "truncate", "corrupt"])
def test_a_spoiled_status_never_passes_as_good(host: Host, kind: str, fast: bool) -> None:
    inject(host.rig, kind, servo=host.ids[3])
    truth = {s.id: s.get("model_number").to_bytes(2, "little") for s in host.rig.servos}
    for _ in range(20):
        host.rig.host_sends(codec.sync_read(host.ids, 0, 2, fast=fast))
        heard = host.wait(0.01)
        if fast:
            found = parse_fast(heard, host.ids, [2] * 20)
            good = {s.id: s.data for s in found if s is not None}
            if kind == "corrupt":
                assert len(good) >= 18, "a spoiled checksum costs the next block too, but no more"
            else:
                assert list(good) == host.ids[:3]
        else:
            good = {p.id: p.params[1:] for p in host.parser.feed(heard) if p.params[0] == 0}
            host.parser.reset()
            assert len(good) >= 18
        assert host.ids[3] not in good
        assert all(truth[id] == data for id, data in good.items())
    assert host.rig.injector.struck[kind, host.ids[3]] == 20


def test_other_ways_of_answering_wrong(host: Host) -> None:
    rig = host.rig
    inject(rig, "duplicate", servo=1, until=rig.seconds + 0.05)
    assert [s.id for s in host.ask(codec.ping(1))] == [1, 1]
    host.wait(0.05)
    inject(rig, "wrong_id", servo=1, until=rig.seconds + 0.05)
    assert [s.id for s in host.ask(codec.ping(1))] == [2]
    host.wait(0.05)
    inject(rig, "error_status", servo=1, value=4, until=rig.seconds + 0.05)
    (status,) = host.ask(codec.read(1, 132, 4))
    assert (status.error, status.data) == (4, b"")
    host.wait(0.05)
    inject(rig, "late", servo=1, value=0.01)
    rig.host_sends(codec.ping(1))
    assert host.wait(0.008) == b""
    assert len(host.wait(0.004)) == 14


def test_the_share_of_spoiled_statuses_is_the_probability(host: Host) -> None:
    inject(host.rig, "drop", probability=0.1)
    got = sum(len(host.ask(codec.sync_read(host.ids, 0, 2), 0.01)) for _ in range(100))
    assert 0.87 < got / 2000 < 0.93


def test_noise_on_the_line(host: Host) -> None:
    rig = host.rig
    inject(rig, "garbage", servo=1, until=rig.seconds + 0.03)
    rig.host_sends(codec.ping(1))
    heard = host.wait(0.02)
    assert len(heard) == 9 + 14
    host.wait(0.05)
    inject(rig, "echo", until=rig.seconds + 0.03)
    packet = codec.ping(1)
    rig.host_sends(packet)
    assert host.wait(0.02).startswith(packet)
    host.wait(0.05)
    inject(rig, "split", until=rig.seconds + 0.03)
    rig.host_sends(packet)
    first, second = host.wait(0.0005), host.wait(0.01)
    assert len(first) == len(second) == 7
    host.wait(0.05)
    inject(rig, "babble", until=rig.seconds + 0.2)
    assert sum(len(host.ask(codec.ping(1), 0.01)) for _ in range(10)) < 6
    host.wait(0.2)
    host.parser.reset()
    assert len(host.ask(codec.ping(1))) == 1


def test_servo_faults(host: Host) -> None:
    rig = host.rig
    rig.auto_release = False
    host.torque_on(host.ids)
    inject(rig, "torque_off", servo=1)
    assert host.read(1, "torque_enable") == 0
    inject(rig, "reboot", servo=2)
    assert host.ask(codec.ping(2)) == []
    host.wait(0.35)
    assert host.read(2, "torque_enable") == 0
    for kind, bit, off in (("overheating", 4, 0), ("encoder", 8, 1), ("shock", 16, 0), ("overload", 32, 0)):
        id = 3 + [4, 8, 16, 32].index(bit)
        inject(rig, kind, servo=id)
        assert host.read(id, "hardware_error_status") == bit
        assert host.read(id, "torque_enable") == off, kind
    inject(rig, "watchdog", servo=10)
    assert host.read(10, "bus_watchdog") == 255
    inject(rig, "baud_mismatch", servo=11, until=rig.seconds + 0.1)
    assert host.ask(codec.ping(11)) == []
    host.wait(0.1)
    assert len(host.ask(codec.ping(11))) == 1
    inject(rig, "id_conflict", servo=host.ids[0], until=rig.seconds + 0.1)
    assert host.ask(codec.read(host.ids[0], 132, 4)) == [], "two that say different things at once"
    host.parser.reset()
    assert len(host.ask(codec.read(host.ids[1], 132, 4))) == 1
    host.wait(0.1)
    assert len(host.ask(codec.read(host.ids[0], 132, 4))) == 1


def test_a_brown_out_takes_all_servos_and_gives_them_back_without_torque(host: Host) -> None:
    host.rig.auto_release = False
    host.torque_on(host.ids)
    inject(host.rig, "brown_out")
    assert host.ask(codec.ping(1)) == []
    host.wait(0.5)
    assert host.read(1, "torque_enable") == 0
    assert host.one(codec.read(BOARD, 24, 1)).data == b"\1"


def test_a_port_that_vanishes_in_mid_read_takes_half_of_the_answer(host: Host) -> None:
    inject(host.rig, "vanish_in_read")
    host.rig.host_sends(codec.ping(1))
    assert len(host.wait(0.02)) == 7
    assert not host.rig.port_open


def test_the_board_s_imu_dies(host: Host) -> None:
    inject(host.rig, "imu_dead")
    assert host.one(codec.read(BOARD, 32, 18)).data == bytes(18)


def test_the_same_seed_strikes_the_same(host: Host, robot: Robot) -> None:
    def run() -> list[int]:
        host.rig.reset(0)
        host.parser.reset()
        host.start()
        inject(host.rig, "corrupt", probability=0.3)
        return [len(host.ask(codec.sync_read(host.ids, 0, 2), 0.01)) for _ in range(20)]

    first = run()
    assert first == run()
    assert len(set(first)) > 1


def test_buttons_are_pressed_and_servos_heated_by_a_scenario(host: Host, rig: Rig) -> None:
    button, temperature = codec.read(BOARD, 30, 1), codec.read(14, 146, 1)
    assert host.one(button).data == b"\0"
    rig.inject(Fault("button", at=rig.seconds, until=rig.seconds + 0.1, value=6))
    inject(rig, "heat", servo="l_knee")
    assert host.one(button).data == b"\6"
    assert 70 <= host.one(temperature).data[0] <= 72
    assert host.read(13, "present_temperature") < 30
    host.wait(0.15)
    assert host.one(button).data == b"\0"


@pytest.mark.parametrize(
    ("kind", "good"), [("wrong_id", 19), ("error_status", 20), ("garbage", 3), ("id_conflict", 18)]
)
def test_a_fast_frame_is_spoiled_as_plain_answers_are(host: Host, kind: str, good: int) -> None:
    """The driver reads its servos in fast frames: a fault that strikes only plain answers would never meet it."""
    inject(host.rig, kind, servo=host.ids[3])
    host.rig.host_sends(codec.sync_read(host.ids, 132, 4, fast=True))
    found = [s for s in parse_fast(host.wait(0.01), host.ids, [4] * 20) if s is not None]
    assert good <= len(found) <= good + 1
    truth = {s.id: s.get("present_position").to_bytes(4, "little") for s in host.rig.servos}
    assert all(truth[s.id] == s.data for s in found if not s.error)
    assert [s.id for s in found if s.error] == ([host.ids[3]] if kind == "error_status" else [])
