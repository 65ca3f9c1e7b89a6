"""What a servo accepts, refuses, forgets and keeps, as real ones do."""

from __future__ import annotations

import math

import pytest
from rig_host import BOARD, XM430, Host

import servoid.sim.rig.rig
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import Reset, StatusError
from servoid.hw.dynamixel.protocol.tables import models
from servoid.hw.robot.description import Robot
from servoid.sim.rig.process import control_requests
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.virtual_servo import VirtualServo


def test_servos_are_silent_until_the_board_gives_them_power(rig: Rig, robot: Robot) -> None:
    host = Host(rig, robot)
    assert [status.id for status in host.ask(codec.ping(), 0.5)] == [BOARD]
    host.start()
    assert sorted(s.id for s in host.ask(codec.ping(), 0.5)) == sorted([*host.ids, BOARD])
    host.ask(codec.write(BOARD, 24, b"\0"))
    assert host.ask(codec.ping(1)) == []


def test_eeprom_is_locked_under_torque(host: Host) -> None:
    host.torque_on([1])
    for item in XM430.items.values():
        if item.writable and item.eeprom:
            value = host.read(1, item.name)
            assert host.write(1, item.name, value) is StatusError.ACCESS, item.name
    assert host.write(1, "torque_enable", 0) is StatusError.NONE
    assert host.write(1, "temperature_limit", 70) is StatusError.NONE
    assert host.read(1, "temperature_limit") == 70


def test_every_writable_register_keeps_what_is_written(host: Host) -> None:
    kept_by_others = {"id", "baud_rate", "operating_mode", "status_return_level", "protocol_type"}
    for item in XM430.items.values():
        if not item.writable or item.name in kept_by_others or item.name.startswith("indirect"):
            continue
        low, high = item.range or (0, 100)
        value = {"goal_position": 2050, "min_position_limit": 10, "max_position_limit": 4000}.get(item.name)
        value = (low + high) // 2 if value is None else value
        assert host.write(1, item.name, value) is StatusError.NONE, item.name
        assert host.read(1, item.name) == value, item.name


@pytest.mark.parametrize(
    ("packet", "error"),
    [
        (codec.write(1, 132, b"\0\0\0\0"), StatusError.ACCESS),  # read-only
        (codec.write(1, 72, b"\0"), StatusError.ACCESS),  # a gap in the table
        (codec.write(1, 116, b"\0\0"), StatusError.DATA_LENGTH),  # half a register
        (codec.write(1, 117, b"\0"), StatusError.ACCESS),  # the middle of one
        (codec.write(1, 64, b"\2"), StatusError.DATA_RANGE),
        (codec.write(1, 11, b"\7"), StatusError.DATA_RANGE),  # a mode that this model has not
        (codec.write(1, 116, (4000).to_bytes(4, "little")), StatusError.DATA_LIMIT),
        (codec.write(1, 100, (900).to_bytes(2, "little")), StatusError.DATA_LIMIT),
        (codec.read(1, 660, 10), StatusError.ACCESS),  # beyond the table
        (codec.read(1, 700, 1), StatusError.ACCESS),
        (codec.read(1, 72, 1), StatusError.ACCESS),  # a gap in the table does not read as zero
        (codec.read(1, 14, 6), StatusError.ACCESS),
        (codec.read(1, 40, 4), StatusError.ACCESS),  # a register that only other models have
        (codec.action(1), StatusError.INSTRUCTION),  # nothing was registered
        (codec.packet(1, 0x21, b"\1CTRL"), StatusError.INSTRUCTION),
        (codec.packet(1, codec.InstructionCode.READ, b"\0"), StatusError.DATA_LENGTH),
        (codec.packet(1, 0x20, b"\1CTRM"), StatusError.DATA_RANGE),  # another key
    ],
)
def test_refusals_say_why(host: Host, packet: bytes, error: StatusError) -> None:
    assert host.one(packet).error == error


def test_a_refused_write_changes_nothing_of_a_block(host: Host) -> None:
    before = host.read(1, "profile_velocity")
    block = (50).to_bytes(4, "little") + (60).to_bytes(4, "little") + (4000).to_bytes(4, "little")
    assert host.one(codec.write(1, 108, block)).error == StatusError.DATA_LIMIT
    assert host.read(1, "profile_velocity") == before


def test_reboot_loses_ram_and_keeps_eeprom(host: Host) -> None:
    host.write(1, "position_p_gain", 300)
    host.write(1, "indirect_address_1", 132)
    host.write(1, "return_delay_time", 5)
    host.torque_on([1])
    assert host.one(codec.reboot(1)).error == 0
    assert host.ask(codec.ping(1)) == [], "it answered while starting"
    host.wait(0.35)
    assert host.read(1, "position_p_gain") == 800
    assert host.read(1, "torque_enable") == 0
    assert host.read(1, "indirect_address_1") == 224
    assert host.read(1, "return_delay_time") == 5


@pytest.mark.parametrize("spare", list(Reset))
def test_factory_reset_spares_what_it_says(host: Host, spare: Reset) -> None:
    host.write(7, "temperature_limit", 60)
    host.ask(codec.factory_reset(7, spare))
    host.wait(0.35)
    servo = host.rig.servos[host.ids.index(7)]
    assert servo.get("temperature_limit") == 80
    assert servo.get("id") == (1 if spare is Reset.ALL else 7)
    assert servo.baud == (2_000_000 if spare is Reset.EXCEPT_ID_AND_BAUD else 57600)
    assert servo.get("model_number") == 1020


def test_registered_writes_wait_for_action(host: Host) -> None:
    assert host.one(codec.reg_write(1, 65, b"\1")).error == 0
    assert host.read(1, "registered_instruction") == 1
    assert host.read(1, "led") == 0
    assert host.ask(codec.action()) == [], "a broadcast is not answered"
    assert host.read(1, "led") == 1
    assert host.read(1, "registered_instruction") == 0


def test_indirect_data_read_and_write_what_they_point_to(host: Host) -> None:
    for i, address in enumerate((84, 85, 132, 133, 134, 135)):
        assert host.write(1, f"indirect_address_{i + 1}", address) is StatusError.NONE
    data = host.one(codec.read(1, 224, 6)).data
    assert data == (800).to_bytes(2, "little") + host.read(1, "present_position").to_bytes(4, "little")
    assert host.one(codec.write(1, 224, (640).to_bytes(2, "little"))).error == 0
    assert host.read(1, "position_p_gain") == 640
    assert host.one(codec.write(1, 226, b"\0\0\0\0")).error == StatusError.ACCESS, "a read-only one by the back door"


def test_status_return_level_silences_answers(host: Host) -> None:
    host.write(1, "status_return_level", 1)
    assert host.ask(codec.write(1, 65, b"\1")) == []
    assert host.read(1, "led") == 1
    host.ask(codec.write(1, 68, b"\0"))
    assert host.ask(codec.read(1, 65, 1)) == []
    assert len(host.ask(codec.ping(1))) == 1


def test_secondary_id_is_obeyed_without_an_answer(host: Host) -> None:
    host.write(1, "secondary_id", 77)
    assert host.ask(codec.write(77, 65, b"\1")) == []
    assert host.read(1, "led") == 1


def test_a_new_mode_resets_gains_and_profile(host: Host) -> None:
    host.write(1, "position_p_gain", 200)
    host.write(1, "profile_velocity", 50)
    assert host.write(1, "operating_mode", 4) is StatusError.NONE
    assert host.read(1, "position_p_gain") == 800
    assert host.read(1, "profile_velocity") == 0


def test_homing_offset_counts_up_to_a_quarter_turn_in_position_mode(host: Host) -> None:
    actual = host.read(1, "present_position")
    host.write(1, "homing_offset", 500)
    assert host.read(1, "present_position") == actual + 500
    host.write(1, "homing_offset", 5000)
    assert host.read(1, "present_position") == actual + 1024
    host.write(1, "operating_mode", 4)
    assert host.read(1, "present_position") == actual + 5000


def test_reverse_mode_mirrors_position_and_motion(host: Host) -> None:
    actual = host.read(19, "present_position")
    host.rig.move({"head_pan": 0.3})
    plain = host.read(19, "present_position")
    host.write(19, "drive_mode", 1)
    assert host.read(19, "present_position") - 2048 == 2048 - plain
    host.rig.move({"head_pan": 0.0})
    host.torque_on([19])
    host.write(19, "goal_position", actual + 200)
    host.wait(1.0)
    assert host.rig.plant.joints[0] == pytest.approx(-200 * 2 * math.pi / 4096, abs=0.02)
    assert host.read(19, "present_position") == pytest.approx(actual + 200, abs=12)


def test_turns_are_counted_until_position_mode_forgets_them(host: Host) -> None:
    host.write(19, "operating_mode", 4)
    host.rig.move({"head_pan": 2 * math.pi + 0.5})
    inside = 2048 + round(0.5 * 4096 / (2 * math.pi))
    assert host.read(19, "present_position") == pytest.approx(inside + 4096, abs=2)
    host.write(19, "operating_mode", 3)
    assert host.read(19, "present_position") == pytest.approx(inside, abs=2)
    host.rig.move({"head_pan": 4 * math.pi + 0.5})
    assert host.read(19, "present_position") == pytest.approx(inside + 4096, abs=2)
    assert host.one(codec.clear(19)).error == 0
    assert host.read(19, "present_position") == pytest.approx(inside, abs=2)


def test_the_watchdog_stops_a_servo_and_refuses_goals_until_cleared(host: Host) -> None:
    host.torque_on([19])
    host.write(19, "profile_velocity", 40)
    host.write(19, "goal_position", 2800)
    assert host.write(19, "bus_watchdog", 5) is StatusError.NONE  # 100 ms
    for _ in range(20):  # any packet on the bus feeds it
        host.ask(codec.ping(1), 0.02)
    assert host.read(19, "bus_watchdog") == 5
    assert host.read(19, "present_velocity") > 20
    host.wait(0.2)
    assert host.read(19, "bus_watchdog") == 255
    stopped = host.read(19, "present_position")
    host.wait(0.5)
    assert host.read(19, "present_position") == pytest.approx(stopped, abs=40)
    assert host.read(19, "profile_velocity") == 0
    assert host.read(19, "torque_enable") == 1
    assert host.write(19, "goal_position", 2048) is StatusError.DATA_RANGE
    assert host.write(19, "bus_watchdog", 0) is StatusError.NONE
    assert host.write(19, "goal_position", 2048) is StatusError.NONE
    host.wait(1.0)
    assert host.read(19, "present_position") == pytest.approx(2048, abs=12)


def test_the_watchdog_sleeps_without_torque(host: Host) -> None:
    host.write(1, "bus_watchdog", 1)
    host.wait(0.5)
    assert host.read(1, "bus_watchdog") == 1


def test_shutdown_locks_torque_out_until_reboot_and_again_while_hot(host: Host) -> None:
    host.torque_on([1])
    index = host.ids.index(1)
    host.rig.motors.firmware.winding[index] = 95.0
    host.wait(0.01)
    status = host.one(codec.read(1, 64, 1))
    assert status.alert, "the alert bit"
    assert status.data == b"\0", "torque"
    assert host.read(1, "hardware_error_status") == 4
    assert host.write(1, "torque_enable", 1) is StatusError.ACCESS
    host.ask(codec.reboot(1))
    host.wait(0.35)
    assert host.write(1, "torque_enable", 1) is StatusError.ACCESS, "still hot"
    host.rig.motors.firmware.winding[index] = 40.0
    host.ask(codec.reboot(1))
    host.wait(0.35)
    assert host.write(1, "torque_enable", 1) is StatusError.NONE


def test_an_error_outside_the_shutdown_mask_is_only_reported(host: Host) -> None:
    host.torque_on([1])
    host.rig.motors.sag = 12.0 - 9.0  # below the limit of 9.5 V
    host.wait(0.02)
    status = host.one(codec.read(1, 64, 1))
    assert status.alert
    assert status.data == b"\1"
    assert host.read(1, "hardware_error_status") == 1


def test_a_baud_change_is_answered_at_the_old_baud(host: Host) -> None:
    assert host.write(1, "baud_rate", 3) is StatusError.NONE
    assert host.ask(codec.ping(1)) == []
    host.rig.wire.host_baud = 1_000_000
    assert len(host.ask(codec.ping(1))) == 1


def test_older_firmware_stays_silent_on_fast_reads(host: Host) -> None:
    assert host.rig.servos[0].fast()
    host.rig.servos[0].put("firmware_version", 44)
    ids = [host.rig.servos[0].id, host.rig.servos[1].id]
    assert host.ask(codec.sync_read(ids, 126, 10, fast=True)) == []
    assert len(host.ask(codec.sync_read(ids, 126, 10))) == 2


def test_what_was_forgotten_is_told_once(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long walk that nobody asked about must not spoil all that comes after."""
    ask = control_requests.find("accepted", host.rig)
    monkeypatch.setattr(servoid.sim.rig.rig, "_REMEMBERED", 3)
    host.rig.reset(0)
    host.start()
    for _ in range(2):
        for goal in range(5):
            host.write(1, "goal_position", 2000 + goal)
        answer = ask()
        assert ([entry["value"] for entry in answer["accepted"]], answer["forgotten"]) == ([2002, 2003, 2004], 2)
        assert ask() == {"accepted": [], "forgotten": 0}
    for goal in range(5):
        host.write(1, "goal_position", 2000 + goal)
    host.rig.reset(0)
    assert ask() == {"accepted": [], "forgotten": 0}


@pytest.mark.parametrize("model", [name for name in models() if name != "opencr"])
def test_every_model_is_emulated_with_its_own_registers(rig: Rig, model: str) -> None:
    servo = VirtualServo(rig.motors, 0, model, {"id": 42})
    known = servo.table
    assert servo.execute(codec.InstructionCode.PING, b"", 0) == (
        42,
        0,
        False,
        known.number.to_bytes(2, "little") + b"\x34",
    )
    position = known.item("present_position")
    error, data = servo.read(position.address, position.width, 0)
    assert (error, position.decode(data)) == (StatusError.NONE, 2048)
    assert ("present_current" in known) is (0 in known.modes), "a servo without current has no current mode"
    for mode in known.modes:
        assert servo.write(11, bytes([mode]), 0) is StatusError.NONE
    for block in known.indirect:
        assert servo.write(block.address, position.address.to_bytes(2, "little"), 0) is StatusError.NONE
        assert servo.read(block.data, 1, 0) == (StatusError.NONE, data[:1])
