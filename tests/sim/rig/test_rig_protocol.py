"""Bytes that other people's programs send, and the bytes that they wait for: as the manufacturer's manual has them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rig_host import BOARD, Host

from servoid.hw.config import CONFIGS
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import Reset, StatusError
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.virtual_servo import VirtualServo

DONE = bytes.fromhex("fffffd000104005500a10c")  # ID 1: no error
STORE, RESTORE = codec.packet(1, 0x20, b"\1CTRL"), codec.packet(1, 0x20, b"\2CTRL")


def bytes_for(host: Host, packet: bytes, seconds: float = 0.02) -> bytes:
    """What comes back for a packet, to the byte."""
    host.rig.host_sends(packet)
    return host.wait(seconds)


def first_servo(host: Host) -> VirtualServo:
    return host.rig.servos[host.ids.index(1)]


@pytest.mark.parametrize(
    "packet",
    [
        bytes.fromhex("fffffd000106000307000e9563"),  # write ID 14
        bytes.fromhex("fffffd000104000601a1e6"),  # factory reset of all but the ID
        codec.factory_reset(1, Reset.ALL),
        codec.factory_reset(1, Reset.EXCEPT_ID_AND_BAUD),
        bytes.fromhex("fffffd000103 00082f4e"),  # reboot
        bytes.fromhex("fffffd000108001001 44584c22b1dc"),  # clear
        bytes.fromhex("fffffd000108002001 4354524c16f5"),  # control table backup
    ],
)
def test_whatever_an_instruction_changes_its_status_comes_from_who_was_asked(host: Host, packet: bytes) -> None:
    """Five clients wait for the old ID; the new one they take for another servo's answer."""
    assert bytes_for(host, packet) == DONE


def test_a_servo_has_its_new_id_after_the_answer(host: Host) -> None:
    first_servo(host).put("id", 40)
    assert bytes_for(host, codec.write(40, 7, b"\x2a")) == codec.status(40)
    assert host.ask(codec.ping(40)) == []
    assert len(host.ask(codec.ping(42))) == 1
    host.one(codec.reg_write(42, 7, b"\x28"))
    assert bytes_for(host, codec.action(42)) == codec.status(42), "a registered ID, too"
    assert len(host.ask(codec.ping(40))) == 1


def test_a_broadcast_does_not_make_twenty_servos_of_id_1(host: Host) -> None:
    """From firmware 42 on; other options reach everybody, and older firmware obeys."""
    host.write(3, "led", 1)
    assert bytes_for(host, codec.factory_reset(codec.BROADCAST, Reset.ALL)) == b""
    assert sorted(servo.id for servo in host.rig.servos) == sorted(host.ids)
    assert host.read(3, "led") == 1, "it has not even restarted"
    assert bytes_for(host, codec.factory_reset(codec.BROADCAST, Reset.EXCEPT_ID_AND_BAUD)) == b""
    host.wait(0.4)
    host.start()
    assert host.read(3, "led") == 0
    first_servo(host).put("firmware_version", 41)
    first_servo(host).put("id", 40)
    host.ask(codec.factory_reset(codec.BROADCAST, Reset.ALL))
    assert first_servo(host).id == 1


def test_an_action_without_a_registered_write_is_refused(host: Host) -> None:
    assert host.one(codec.action(1)).error == StatusError.INSTRUCTION
    assert host.one(codec.reg_write(1, 65, b"\1")).error == 0
    assert bytes_for(host, codec.action(1)) == DONE
    assert host.read(1, "led") == 1
    assert host.one(codec.action(1)).error == StatusError.INSTRUCTION, "once"


def test_a_packet_with_a_wrong_checksum_is_answered_as_such(host: Host) -> None:
    packet = bytearray(codec.read(1, 132, 4))
    packet[-1] ^= 1
    assert bytes_for(host, bytes(packet)) == codec.status(1, StatusError.CRC)
    packet[4] = 99
    assert bytes_for(host, bytes(packet)) == b"", "nobody's"


def test_a_backup_holds_eeprom_and_gains_and_brings_the_eeprom_back(host: Host) -> None:
    assert host.read(1, "backup_ready") == 0
    assert host.one(RESTORE).error == StatusError.RESULT, "there is none"
    host.write(1, "temperature_limit", 61)
    assert bytes_for(host, STORE) == DONE
    assert host.read(1, "backup_ready") == 1
    host.write(1, "temperature_limit", 70)
    assert bytes_for(host, RESTORE) == DONE
    assert host.ask(codec.ping(1)) == [], "it restarts"
    host.wait(0.35)
    assert host.read(1, "temperature_limit") == 61
    assert host.read(1, "backup_ready") == 1
    host.torque_on([1])
    assert host.one(STORE).error == StatusError.RESULT, "not with torque on"


@pytest.mark.parametrize(("model", "firmware"), [("xm430-w350", 44), ("xl330-m288", 45), ("mx-28", 52)])
def test_a_backup_needs_a_firmware_that_knows_it(rig: Rig, model: str, firmware: int) -> None:
    servo = VirtualServo(rig.motors, 0, model, {"firmware_version": firmware})
    answer = servo.execute(0x20, b"\1CTRL", 0)
    assert answer is not None
    assert answer.error == StatusError.INSTRUCTION
    assert not servo.fast()


def test_fast_reads_are_of_the_models_and_firmware_that_have_them(rig: Rig) -> None:
    assert VirtualServo(rig.motors, 0, "xl330-m288", {"firmware_version": 46}).fast()
    assert not VirtualServo(rig.motors, 0, "2xl430-w250", {}).fast(), "never those with two axes"


def test_a_startup_configuration_is_obeyed_at_reboot(host: Host) -> None:
    host.write(1, "position_p_gain", 333)
    host.write(1, "profile_velocity", 44)
    host.ask(STORE)
    host.write(1, "position_p_gain", 900)
    host.write(1, "startup_configuration", 3)  # torque on, RAM from the backup
    host.rig.auto_release = False
    before = host.read(1, "present_position")
    host.ask(codec.reboot(1))
    assert not first_servo(host).torque, "not while it is starting"
    host.wait(0.4)
    assert host.read(1, "torque_enable") == 1
    assert host.read(1, "goal_position") == pytest.approx(before, abs=2), "where it is"
    assert (host.read(1, "position_p_gain"), host.read(1, "profile_velocity")) == (333, 44)
    host.write(1, "torque_enable", 0)
    host.write(1, "startup_configuration", 0)
    host.ask(codec.reboot(1))
    host.wait(0.4)
    assert (host.read(1, "torque_enable"), host.read(1, "position_p_gain")) == (0, 800)


def old(id: int, instruction: int, *params: int) -> bytes:
    """A packet of protocol 1.0."""
    body = bytes([id, len(params) + 2, instruction, *params])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def test_a_servo_of_protocol_1_hears_nothing_else(host: Host) -> None:
    """Acknowledged in the protocol that was spoken; from then on it is gone for those who speak 2.0."""
    assert bytes_for(host, codec.write(1, 13, b"\1")) == DONE
    assert bytes_for(host, codec.ping(1)) == b""
    assert 1 not in [status.id for status in host.ask(codec.ping(), 0.1)]
    assert bytes_for(host, old(1, 1)) == bytes.fromhex("ffff010200fc")
    assert bytes_for(host, old(2, 1)) == b"", "and the others hear nothing of it"
    assert bytes_for(host, old(1, 2, 0, 2)) == bytes.fromhex("ffff010400fc03fb")  # model 1020
    assert bytes_for(host, old(1, 3, 65, 1)) == bytes.fromhex("ffff010200fc")
    assert first_servo(host).get("led") == 1
    assert bytes_for(host, old(1, 2, 72, 1))[4] == 8, "a range error"
    assert bytes_for(host, old(1, 5))[4] == 64, "an instruction error"
    bytes_for(host, old(0xFE, 0x83, 65, 1, 1, 0))
    assert first_servo(host).get("led") == 0
    assert bytes_for(host, b"\xff" + old(1, 3, 13, 2)) == bytes.fromhex("ffff010200fc")
    assert len(host.ask(codec.ping(1))) == 1, "back again"


def test_a_remote_control_s_protocol_falls_back_where_there_is_none(rig: Rig) -> None:
    servo = VirtualServo(rig.motors, 0, "xl330-m288", {})
    for value, error in ((1, StatusError.DATA_RANGE), (3, StatusError.DATA_RANGE), (22, StatusError.NONE)):
        assert servo.write(13, bytes([value]), 0) is error
    assert not servo.old_protocol


def test_a_secondary_id_is_obeyed_in_sync_writes_and_writes_no_eeprom(host: Host) -> None:
    """A group of servos with one secondary ID moves together; none of them can be set up by it."""
    for id in (3, 5):
        host.write(id, "secondary_id", 77)
    host.ask(codec.sync_write(65, 1, {77: b"\1"}))
    host.ask(codec.bulk_write([(77, 84, (321).to_bytes(2, "little"))]))
    assert [host.read(id, "led") for id in (3, 4, 5)] == [1, 0, 1]
    assert [host.read(id, "position_p_gain") for id in (3, 4, 5)] == [321, 800, 321]
    assert host.ask(codec.write(77, 31, b"\x32")) == []
    assert host.ask(codec.factory_reset(77, Reset.EXCEPT_ID)) == []
    host.ask(codec.sync_write(31, 1, {77: b"\x32"}))
    assert host.read(3, "temperature_limit") == 80
    host.write(3, "secondary_id", 253)
    host.ask(codec.sync_write(65, 1, {253: b"\0"}))
    assert host.read(3, "led") == 1, "from 253 on there is none"


def test_a_broadcast_ping_is_answered_in_the_order_of_ids_whatever_the_return_delays(host: Host) -> None:
    """As servos come from the factory and as one that was set up: none talks into another's answer."""
    for id, delay in ((1, 254), (2, 0), (3, 250), (7, 250), (8, 0), (19, 254), (20, 0)):
        host.write(id, "return_delay_time", delay)
    answers = [status.id for status in host.ask(codec.ping(), 0.1)]
    assert answers == [*sorted(host.ids), BOARD]
    assert host.rig.wire.collisions == 0


def test_a_servo_counts_its_time_from_its_start_and_tells_its_profile(host: Host) -> None:
    host.wait(1.0)
    host.ask(codec.reboot(1))
    host.wait(0.48)
    assert host.read(1, "realtime_tick") == pytest.approx(500, abs=5)
    for velocity, acceleration, bits in ((0, 0, 0), (0, 10, 0), (50, 0, 0x10), (50, 10, 0x30)):
        host.write(1, "profile_velocity", velocity)
        host.write(1, "profile_acceleration", acceleration)
        assert host.read(1, "moving_status") & 0x30 == bits


def test_indirect_addresses_lead_no_farther_than_the_model_s_ram(rig: Rig) -> None:
    for model, last in (("xm430-w350", 661), ("xl330-m288", 227)):
        servo = VirtualServo(rig.motors, 0, model, {})
        assert servo.write(168, last.to_bytes(2, "little"), 0) is StatusError.NONE
        assert servo.write(168, (last + 1).to_bytes(2, "little"), 0) is StatusError.DATA_RANGE
        assert servo.write(168, (63).to_bytes(2, "little"), 0) is StatusError.DATA_RANGE


def test_a_servo_at_rest_reads_no_velocity_and_one_that_moves_a_noisy_one(host: Host) -> None:
    """Programs wait for zero to know that a joint has stopped."""
    host.rig.auto_release = False
    host.torque_on([19])
    host.wait(0.5)
    assert {host.read(id, "present_velocity") for id in host.ids for _ in range(5)} == {0}
    host.write(19, "profile_velocity", 40)
    host.write(19, "goal_position", host.read(19, "present_position") + 500)
    host.wait(0.3)
    moving = [host.read(19, "present_velocity") for _ in range(10)]
    assert all(35 < velocity < 45 for velocity in moving)
    assert len(set(moving)) > 1
    host.wait(1.0)
    assert [host.read(19, "present_velocity") for _ in range(5)] == [0] * 5


def test_small_servos_live_on_the_voltage_of_their_own_file(robot: Robot, tmp_path: Path) -> None:
    """An XL330 runs on 5 V, where one of 12 V would be dead."""
    file = tmp_path / "xl330.yaml"
    text = Path(CONFIGS / "servos" / "xm430-w350.yaml").read_text()
    for old_line, new_line in (
        ("name: xm430-w350", "name: xl330-m288"),
        ("model_number: 1020", f"model_number: {table('xl330-m288').number}"),
        ("voltage: 12.0 ", "voltage: 5.0 "),
        ("voltage_range: [9.5, 16.0]", "voltage_range: [3.5, 7.0]"),
    ):
        assert text.count(old_line) == 1
        text = text.replace(old_line, new_line)
    file.write_text(text)
    joints = tuple(replace(joint, servo=str(file)) for joint in robot.joints)
    host = Host(Rig(replace(robot, joints=joints)), robot)
    host.start()
    assert host.rig.motors.supply == pytest.approx(5.0)
    assert [status.error for status in host.ask(codec.ping(1))] == [0]
    host.rig.motors.sag = 5.0 - 2.4
    host.wait(0.02)
    assert host.ask(codec.ping(1)) == []
