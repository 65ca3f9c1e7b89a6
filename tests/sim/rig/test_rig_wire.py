"""Time on the wire, collisions, and who answers when somebody is missing."""

from __future__ import annotations

import pytest
from rig_host import BOARD, XM430, Host

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import parse_fast
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.wire.dispatcher import TURNAROUND_NS
from servoid.sim.rig.wire.half_duplex import Wire


def when(rig: Rig, packet: bytes, count: int, limit: float = 0.05) -> float:
    """Seconds from the write of `packet` until `count` bytes have come back."""
    began, heard = rig.now_ns, 0
    rig.host_sends(packet)
    while heard < count:
        assert rig.now_ns - began < limit * 1e9, f"{heard} of {count} bytes came"
        heard += len(rig.advance(rig.now_ns + 5_000))
    return (rig.now_ns - began) * 1e-9


@pytest.mark.parametrize(("fast", "expected"), [(True, 314), (False, 454)])
def test_a_group_read_takes_the_time_of_its_bytes(host: Host, fast: bool, expected: int) -> None:
    """20 servos, 10 bytes: 34 bytes of request and 14 + 288 or 20 * 21 of answers, and turnarounds."""
    request = codec.sync_read(host.ids, 126, 10, fast=fast)
    answers = 8 + 20 * 14 if fast else 20 * 21
    assert len(request) + answers == expected + (8 if fast else 0)
    turnarounds = TURNAROUND_NS * 1e-9 * (1 if fast else 20)
    wire = (len(request) + answers) * 10 / 2e6 + turnarounds
    assert when(host.rig, request, answers) == pytest.approx(wire, abs=15e-6)


def test_return_delay_is_waited(host: Host) -> None:
    quick = when(host.rig, codec.ping(1), 14)
    host.write(1, "return_delay_time", 250)
    assert when(host.rig, codec.ping(1), 14) - quick == pytest.approx(500e-6, abs=10e-6)


def test_packets_queue_on_the_wire(host: Host) -> None:
    """Two writes at once leave one after the other: the second is heard only when its last byte has gone."""
    long = codec.sync_write(116, 4, {id: b"\0\x08\0\0" for id in host.ids})
    host.rig.host_sends(long)
    assert when(host.rig, codec.ping(1), 14) == pytest.approx((len(long) + 10 + 14) * 5e-6 + 2e-6, abs=10e-6)


def test_talking_into_an_answer_spoils_both(host: Host) -> None:
    rig = host.rig
    rig.host_sends(codec.sync_read(host.ids, 126, 10))
    rig.advance(rig.now_ns + 400_000)  # several answers are still to come
    rig.host_sends(codec.write(1, 65, b"\1"))
    answers = host.parser.feed(host.wait(0.02))
    assert len(answers) < 20
    assert rig.wire.collisions > 0
    assert host.read(1, "led") == 0, "the write was spoiled as well"


def test_two_servos_with_an_id_talk_over_each_other(host: Host) -> None:
    host.rig.servos[1].put("id", host.ids[0])
    answers = host.ask(codec.read(host.ids[0], 132, 4))
    same = host.rig.servos[0].get("present_position") == host.rig.servos[1].get("present_position")
    assert same or not answers
    assert len(host.ask(codec.read(host.ids[0], 0, 2))) == 1, "two that say the same are one on the wire"


def test_a_host_at_another_baud_neither_speaks_nor_hears(host: Host) -> None:
    host.rig.wire.host_baud = 1_000_000
    assert host.ask(codec.ping(1)) == []
    host.rig.wire.host_baud = 2_000_000
    host.rig.host_sends(codec.ping(1))
    host.rig.advance(host.rig.now_ns + 60_000)
    host.rig.wire.host_baud = 1_000_000
    heard = host.wait(0.02)
    assert heard
    assert codec.status(1, 0, (1020).to_bytes(2, "little") + b"\x34") not in heard


def test_a_silent_servo_costs_a_sync_read_one_answer_and_a_fast_one_the_rest(host: Host) -> None:
    host.rig.servos[5].dead = True
    answers = host.ask(codec.sync_read(host.ids, 126, 10))
    assert [s.id for s in answers] == [id for i, id in enumerate(host.ids) if i != 5]
    host.rig.host_sends(codec.sync_read(host.ids, 126, 10, fast=True))
    blocks = parse_fast(host.wait(0.02), host.ids, [10] * 20)
    assert [block is not None for block in blocks] == [True] * 5 + [False] * 15


def test_a_slow_packet_in_two_pieces_is_heard_and_one_that_pauses_is_not(host: Host) -> None:
    """At 57600 a piece alone takes longer than the silence after which a packet is given up."""
    servo = host.rig.servos[0]
    servo.put("baud_rate", 1)
    host.rig.wire.host_baud = 57600
    whole = codec.write(servo.id, 65, bytes(100))  # too long for the register: refused, but heard
    for pause, answers in ((0.0, 1), (0.0012, 1), (0.0018, 0)):
        host.rig.host_sends(whole[:50])
        host.wait(50 * 10 / 57600 + pause)
        host.rig.host_sends(whole[50:])
        assert len(host.parser.feed(host.wait(0.05))) == answers


def test_bulk_reads_mix_registers_and_devices(host: Host) -> None:
    parts = [(1, 132, 4), (BOARD, 32, 12), (2, 144, 3)]
    answers = host.ask(codec.bulk_read(parts))
    assert [(s.id, len(s.data)) for s in answers] == [(1, 4), (BOARD, 12), (2, 3)]
    host.rig.host_sends(codec.bulk_read(parts[:1] + parts[2:], fast=True))
    blocks = parse_fast(host.wait(0.02), [1, 2], [4, 3])
    assert all(block is not None for block in blocks)


def test_bulk_write_writes_each_its_own(host: Host) -> None:
    host.ask(codec.bulk_write([(1, 65, b"\1"), (2, 84, (321).to_bytes(2, "little")), (99, 65, b"\1")]))
    assert host.read(1, "led") == 1
    assert host.read(2, "position_p_gain") == 321


def test_answers_that_need_stuffing_are_stuffed(host: Host) -> None:
    servo = host.rig.servos[0]
    servo.stuffed, servo._seen = True, -1
    host.rig.host_sends(codec.read(servo.id, 126, 10))
    heard = host.wait(0.02)
    assert b"\xff\xff\xfd\xfd" in heard
    assert host.parser.feed(heard)[0].params[1:7] == b"\xff\xff\xfd\xff\xff\xff"


def test_an_untuned_adapter_hands_over_every_16_ms(host: Host) -> None:
    host.rig.wire.adapter_ns = 16_000_000
    took = [when(host.rig, codec.ping(1), 14) for _ in range(8)]
    assert max(took) <= 0.0165
    assert sum(took) / len(took) > 0.005


def test_the_realtime_tick_counts_milliseconds(host: Host) -> None:
    before = host.read(1, "realtime_tick")
    host.wait(0.98)
    assert (host.read(1, "realtime_tick") - before) % 32768 == pytest.approx(1000, abs=5)


def test_a_wire_forgets_what_has_gone_by() -> None:
    wire = Wire()
    for i in range(1000):
        wire.host_sends(b"\0" * 10, i * 10_000_000)
        wire.device_sends(b"\0" * 10, i * 10_000_000 + 5_000_000, 57600, i * 10_000_000)
        wire.take_instruction()
        wire.take_delivery(i * 10_000_000 + 9_000_000)
    assert len(wire._line) < 10
    assert XM430.size == 662
