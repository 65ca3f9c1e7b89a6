"""The control cycle against a scripted bus: what is lost is known to be lost, and no answer is taken for another."""

from __future__ import annotations

import struct

import pytest
from scripted import BYTE_NS, Memory, ScriptedBus

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import InstructionCode
from servoid.hw.dynamixel.transport.bus import GAP_NS, Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead

IDS = list(range(1, 21))
PRESENT = [(id, 126, 10) for id in IDS]


def rig(n: int = 20) -> tuple[ScriptedBus, Bus]:
    line = ScriptedBus([Memory("xm430-w350", id) for id in range(1, n + 1)])
    for id, servo in line.servos.items():
        servo.put("present_position", 1000 + id)
        servo.put("present_velocity", -id)
    return line, Bus(line, line)


def positions(group: GroupRead) -> list[int | None]:
    return [
        struct.unpack("<hii", d)[2] if fresh and d else None for d, fresh in zip(group.data, group.fresh, strict=True)
    ]


@pytest.mark.parametrize("fast", [False, True])
def test_a_cycle_is_one_write_and_ends_on_time(fast: bool) -> None:
    line, bus = rig()
    group = GroupRead(PRESENT, fast=fast)
    bus.send(b"")
    began = line.time
    before = codec.sync_write(116, 4, {id: bytes(4) for id in IDS})
    assert bus.sync_read(group, before=before) == 0
    assert positions(group) == [1000 + id for id in IDS]
    request, answer = 14 + len(IDS), 8 + 14 * 20 if fast else 21 * 20
    assert line.time - began == (len(before) + request + answer) * BYTE_NS + GAP_NS * (1 if fast else 20)
    assert [p.instruction for p in line.sent] == [
        InstructionCode.SYNC_WRITE,
        InstructionCode.FAST_SYNC_READ if fast else InstructionCode.SYNC_READ,
    ]
    assert bus.counters.lost == bus.counters.stray == 0


def test_groups_follow_each_other_without_a_pause() -> None:
    """What came whole is looked into while the next answer is on its way; what is damaged is asked for again, last."""
    line = ScriptedBus([*(Memory("xm430-w350", id) for id in IDS), Memory("opencr", 200)])
    bus = Bus(line, line)
    groups = GroupRead(PRESENT, fast=True), GroupRead([(200, 30, 20)])
    bus.send(b"")
    began = line.time
    count = sum(len(group.request_all().packet) + group.request_all().answer for group in groups)
    assert bus.sync_read(*groups) == 0
    assert line.time - began == count * BYTE_NS + 2 * GAP_NS

    def corrupt(id: int, data: bytes) -> list[tuple[bytes, int]]:
        return [(data[:70] + bytes([data[70] ^ 1]) + data[71:] if id == codec.BROADCAST else data, 0)]

    line.fault = corrupt
    line.sent.clear()
    assert bus.sync_read(*groups) == 0
    assert [p.id for p in line.sent] == [codec.BROADCAST, 200, 5], "the damaged one is asked again, last"
    assert groups[0].data[4] == bytes(line.servos[5].bytes[126:136])
    assert (bus.counters.lost, bus.counters.recovered, line.collisions) == (1, 1, 0)
    line.fault = lambda id, data: [] if id == codec.BROADCAST else [(data, 0)]
    line.sent.clear()
    assert bus.sync_read(*groups) == 0
    asked = [p.instruction for p in line.sent]
    assert asked == [InstructionCode.FAST_SYNC_READ, InstructionCode.READ, InstructionCode.SYNC_READ]
    assert line.collisions == 0


def test_who_was_lost_in_a_fast_read_is_asked_again_in_the_same_tick() -> None:
    line, bus = rig()
    group = GroupRead(PRESENT, fast=True)

    def corrupt(id: int, data: bytes) -> list[tuple[bytes, int]]:
        damaged = bytearray(data)
        if id == codec.BROADCAST:
            damaged[8 + 14 * 4 + 5] ^= 0x10
        return [(bytes(damaged), 0)]

    line.fault = corrupt
    assert bus.sync_read(group) == 0
    assert positions(group) == [1000 + id for id in IDS]
    assert [p.instruction for p in line.sent] == [InstructionCode.FAST_SYNC_READ, InstructionCode.READ]
    assert line.sent[1].id == 5
    assert (bus.counters.lost, bus.counters.recovered) == (1, 1)
    assert line.collisions == 0


def test_a_dead_servo_costs_only_its_own_values() -> None:
    """In the first tick too, although every other one waits for it in a fast frame."""
    line, bus = rig()
    line.servos[3].answers = False
    group = GroupRead(PRESENT, fast=True)
    for _ in range(8):
        began = line.time
        assert bus.sync_read(group) == 1
        assert positions(group) == [None if id == 3 else 1000 + id for id in IDS]
        assert line.time - began < 12_000_000, "a tick of 20 ms still holds it"
        line.sleep_until(began + 20_000_000)
    assert group.misses[2] == 8
    assert group.time_ns[2] is None
    last = [p for p in line.sent if p.instruction == InstructionCode.FAST_SYNC_READ][-1]
    assert last.params[4:][-1] == 3, "it is asked last, so that nobody waits for it"
    assert line.sent[-1] is last, "and no longer asked twice"
    line.servos[3].answers = True
    assert bus.sync_read(group) == 0
    assert positions(group)[2] == 1003


def test_an_answer_that_comes_late_is_not_the_next_one() -> None:
    """The servo has moved since: its old answer, arriving in the next tick, must not pass as the new one."""
    line, bus = rig(2)
    group = GroupRead([(1, 126, 10), (2, 126, 10)])
    bus.sync_read(group)
    held: list[bytes] = []

    def hold(id: int, data: bytes) -> list[tuple[bytes, int]]:
        if id == 2:
            held.append(data)
            return []
        return [(data, 0)]

    line.fault = hold
    assert bus.sync_read(group) == 1
    line.servos[2].put("present_position", 2222)
    assert len(held) == 2, "asked, and asked again"

    def deliver(id: int, data: bytes) -> list[tuple[bytes, int]]:
        return [(held.pop(0), 0)] if id == 2 and held else [(data, 0)]

    line.fault = deliver  # in place of the true answers, which would be the worst
    while held:
        bus.sync_read(group)
        assert positions(group)[1] in (None, 2222)
    line.fault = None
    bus.sync_read(group)
    assert positions(group) == [1001, 2222]
    assert bus.counters.unexpected > 0


def test_after_a_fault_the_line_is_drained_before_the_next_packet() -> None:
    line, bus = rig(3)
    group = GroupRead([(i, 126, 10) for i in (1, 2, 3)])
    bus.sync_read(group)
    line.fault = lambda id, data: [(data, 3_600_000)] if len(line.sent) == 2 else [(data, 0)]  # just too late
    assert bus.sync_read(group) == 0
    assert positions(group) == [1001, 1002, 1003]
    assert line.collisions == 0
    assert bus.counters.stray > 0
    line.fault = lambda id, data: [(data, 9_000_000)]  # later than the tick waits
    bus.sync_read(group)
    before = line.collisions
    line.fault = None
    line.sleep_until(line.time + 20_000_000)
    assert bus.sync_read(group) == 0
    assert positions(group) == [1001, 1002, 1003]
    assert line.collisions == before


def test_duplicates_are_harmless_and_conflicts_are_not_believed() -> None:
    line, bus = rig(3)
    group = GroupRead([(i, 126, 10) for i in (1, 2, 3)])
    line.fault = lambda id, data: [(data, 0), (data, len(data) * BYTE_NS)] if id == 1 else [(data, 22 * BYTE_NS)]
    assert bus.sync_read(group) == 0
    assert positions(group) == [1001, 1002, 1003]
    assert bus.counters.duplicates == 1
    line, bus = rig(3)
    group = GroupRead([(i, 126, 10) for i in (1, 2, 3)])
    other = codec.status(1, 0, bytes(10))
    line.fault = lambda id, data: [(data, 0), (other, len(data) * BYTE_NS)] if id == 1 else [(data, 22 * BYTE_NS)]
    bus.sync_read(group)
    assert bus.counters.conflicts >= 1


def test_a_wrong_id_is_not_taken() -> None:
    line, bus = rig(3)
    group = GroupRead([(i, 126, 10) for i in (1, 2)])
    stranger = codec.status(9, 0, bytes(10))
    line.fault = lambda id, data: [(stranger, 0)] if id == 1 else [(data, 0)]
    assert bus.sync_read(group) == 1
    assert positions(group) == [None, 1002]
    assert bus.counters.unexpected > 0


def test_an_error_without_data_is_an_answer_without_a_value() -> None:
    line, bus = rig(2)
    group = GroupRead([(1, 126, 10), (2, 126, 10)])
    refusal = codec.status(1, codec.ALERT | codec.StatusError.RESULT)
    line.fault = lambda id, data: [(refusal, 0)] if id == 1 else [(data, 0)]
    assert bus.sync_read(group) == 1
    assert (group.error[0], group.alert[0], group.data[0]) == (codec.StatusError.RESULT, True, None)
    assert positions(group)[1] == 1002


def test_a_ping_that_is_answered_with_an_error_found_no_servo() -> None:
    line, bus = rig(1)
    assert bus.ping(1) is not None
    line.fault = lambda id, data: [(codec.status(1, 3, b""), 0)]
    assert bus.ping(1, tries=1) is None


def test_an_alert_comes_with_valid_data() -> None:
    for fast in (False, True):
        line, bus = rig(3)
        line.servos[2].put("hardware_error_status", 4)
        group = GroupRead([(i, 126, 10) for i in (1, 2, 3)], fast=fast)
        assert bus.sync_read(group) == 0
        assert group.alert == [False, True, False]
        assert positions(group) == [1001, 1002, 1003]


def test_an_echo_is_no_answer() -> None:
    line, bus = rig(3)
    line.echo = True
    group = GroupRead([(i, 126, 10) for i in (1, 2, 3)], fast=True)
    assert bus.sync_read(group) == 0
    assert bus.ping(2) == (2, 1020, 48, False)


def test_a_babbling_line_does_not_hold_a_tick() -> None:
    line, bus = rig(3)
    group = GroupRead([(i, 126, 10) for i in (1, 2, 3)])
    bus.sync_read(group)
    line.fault = lambda id, data: []
    bus.sync_read(group)
    line.babble(bytes(range(256)) * 40)  # 51 ms of it
    began = line.time
    bus.sync_read(group)
    assert line.time - began < 20_000_000
    assert bus.counters.babble > 0


def test_mixed_models_are_read_in_bulk() -> None:
    line = ScriptedBus([Memory("xm430-w350", 1), Memory("opencr", 200)])
    bus = Bus(line, line)
    line.servos[200].put("gyro_z", -77)
    for fast in (False, True):
        group = GroupRead([(1, 126, 10), (200, 30, 20)], fast=fast)
        assert bus.sync_read(group) == 0
        assert len(group.data[0] or b"") == 10
        assert struct.unpack_from("<h", group.data[1] or b"", 6) == (-77,)
    assert {p.instruction for p in line.sent} == {InstructionCode.BULK_READ, InstructionCode.FAST_BULK_READ}


def test_single_instructions() -> None:
    line, bus = rig(2)
    item = line.servos[1].table.item("position_p_gain")
    assert bus.ping(1) == (1, 1020, 48, False)
    assert bus.ping(7) is None
    assert bus.write_item(1, item, 640)
    assert bus.read_item(1, item) == 640
    assert bus.read_item(7, item) is None
    refused = bus.write(1, 84, (20000).to_bytes(2, "little"))
    assert refused is not None
    assert refused.error == codec.StatusError.DATA_RANGE
    assert not bus.write_item(1, item, 20000)
    with pytest.raises(ValueError, match="position_p_gain"):
        bus.write_item(1, item, 70000)
    assert bus.reboot(1) is not None
    assert bus.read_item(1, item) == 800
    assert [p.id for p in bus.broadcast_ping()] == [1, 2]


def test_a_late_single_answer_is_waited_out() -> None:
    line, bus = rig(1)
    item = line.servos[1].table.item("present_position")
    line.fault = lambda id, data: [(data, 16_000_000)]  # an adapter that gathers for 16 ms
    assert bus.read_item(1, item, tries=1) is None
    line.fault = None
    line.servos[1].put("present_position", 7)
    assert bus.read_item(1, item) == 7


def test_a_return_delay_moves_the_deadline() -> None:
    line, bus = rig(20)
    delay = 500_000
    line.fault = lambda id, data: [(data, delay * id)]
    group = GroupRead(PRESENT)
    assert bus.sync_read(group) > 0
    line, bus = rig(20)
    bus.return_delay = delay * 1e-9
    line.fault = lambda id, data: [(data, delay * id)]
    assert bus.sync_read(GroupRead(PRESENT)) == 0


def test_an_interruption_in_mid_cycle_leaves_a_bus_that_works() -> None:
    """Ctrl-C anywhere: the torque-off that follows must reach the servos."""
    line, bus = rig(20)
    group = GroupRead(PRESENT)
    off = codec.sync_write(64, 1, {id: b"\0" for id in IDS})
    sleep = ScriptedBus.sleep_until
    for calls in range(12):
        for id in IDS:
            line.servos[id].put("torque_enable", 1)
        left = [calls]

        def interrupted(time_ns: int, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt
            sleep(line, time_ns)

        line.sleep_until = interrupted  # type: ignore[method-assign]
        try:
            line.fault = (lambda id, data: []) if calls % 2 else None
            bus.sync_read(group)
        except KeyboardInterrupt:
            pass
        line.sleep_until = lambda time_ns: sleep(line, time_ns)  # type: ignore[method-assign]
        line.fault = None
        bus.send(off)
        assert bus.sync_read(GroupRead([(id, 64, 1) for id in IDS])) == 0
        assert all(line.servos[id].get("torque_enable") == 0 for id in IDS)


def test_a_port_that_is_gone_is_said_at_once() -> None:
    line, bus = rig(1)
    line.gone = True
    with pytest.raises(BackendError, match="gone"):
        bus.ping(1)
    with pytest.raises(BackendError, match="gone"):
        bus.sync_read(GroupRead([(1, 126, 10)]))


def test_an_id_cannot_be_in_a_group_twice() -> None:
    with pytest.raises(ValueError, match="asked twice"):
        GroupRead([(1, 126, 10), (1, 64, 1)])
