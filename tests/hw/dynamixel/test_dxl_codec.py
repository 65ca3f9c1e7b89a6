"""Packets against the official SDK's, and a parser that no stream can upset."""

from __future__ import annotations

import random

import pytest
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import BROADCAST, HEADER, InstructionCode, Packet, PacketParser, Status
from servoid.hw.dynamixel.protocol.crc import crc16

SDK = Protocol2PacketHandler()
IDS = st.integers(0, 252)
PARAMS = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x01, 0x55, 0x80]), max_size=60).map(bytes) | st.binary(
    max_size=60
)


class Wire:
    """A port of the SDK that keeps what is written and answers what it is told."""

    def __init__(self, answer: bytes = b"") -> None:
        self.is_using = False
        self.written = b""
        self.answer = answer

    def clearPort(self) -> None: ...

    def writePort(self, data: list[int]) -> int:
        self.written += bytes(data)
        return len(data)

    def readPort(self, length: int) -> list[int]:
        taken, self.answer = self.answer[:length], self.answer[length:]
        return list(taken)

    def setPacketTimeout(self, length: int) -> None: ...

    def setPacketTimeoutMillis(self, milliseconds: float) -> None: ...

    def isPacketTimeout(self) -> bool:
        return not self.answer

    def getBaudRate(self) -> int:
        return 1000000


def parse(stream: bytes) -> list[Packet]:
    return PacketParser().feed(stream)


@given(st.binary(max_size=400), st.integers(0, 0xFFFF))
def test_crc_is_the_official_one(data: bytes, start: int) -> None:
    assert crc16(data, start) == SDK.updateCRC(start, data, len(data))
    cut = len(data) // 3
    assert crc16(data[cut:], crc16(data[:cut])) == crc16(data)


def test_instructions_are_the_official_bytes() -> None:
    wire = Wire()
    sent = b""
    cases = [
        (codec.ping(3), lambda: SDK.ping(wire, 3)),
        (codec.ping(), lambda: SDK.broadcastPing(wire)),
        (codec.read(7, 132, 4), lambda: SDK.readTx(wire, 7, 132, 4)),
        (codec.write(7, 116, b"\x00\x08\x00\x00"), lambda: SDK.writeTxOnly(wire, 7, 116, 4, [0, 8, 0, 0])),
        (codec.reg_write(7, 116, b"\x01\x02\x03\x04"), lambda: SDK.regWriteTxOnly(wire, 7, 116, 4, [1, 2, 3, 4])),
        (codec.action(), lambda: SDK.action(wire, BROADCAST)),
        (codec.reboot(9), lambda: SDK.reboot(wire, 9)),
        (codec.clear(9), lambda: SDK.clearMultiTurn(wire, 9)),
        (codec.factory_reset(9, codec.Reset.EXCEPT_ID), lambda: SDK.factoryReset(wire, 9, 1)),
        (codec.sync_read([1, 2, 3], 126, 10), lambda: SDK.syncReadTx(wire, 126, 10, [1, 2, 3], 3, False)),
        (codec.sync_read([1, 2, 3], 126, 10, fast=True), lambda: SDK.syncReadTx(wire, 126, 10, [1, 2, 3], 3, True)),
        (
            codec.sync_write(116, 2, {1: b"\x05\x06", 2: b"\x07\x08"}),
            lambda: SDK.syncWriteTxOnly(wire, 116, 2, [1, 5, 6, 2, 7, 8], 6),
        ),
        (
            codec.bulk_read([(1, 132, 4), (2, 30, 1)]),
            lambda: SDK.bulkReadTx(wire, [1, 132, 0, 4, 0, 2, 30, 0, 1, 0], 10, False),
        ),
        (
            codec.bulk_write([(1, 116, b"\x01\x02"), (200, 24, b"\x01")]),
            lambda: SDK.bulkWriteTxOnly(wire, [1, 116, 0, 2, 0, 1, 2, 200, 24, 0, 1, 0, 1], 13),
        ),
    ]
    for ours, official in cases:
        wire.is_using = False
        official()
        assert wire.written[len(sent) :] == ours
        sent = wire.written


@given(IDS, PARAMS, st.integers(0, 255))
def test_the_sdk_reads_our_answers(id: int, data: bytes, error: int) -> None:
    """Only where its own unstuffing is not lossy: it is, in rare payloads."""
    received, result = SDK.rxPacket(Wire(codec.status(id, error, data)), False)
    assert result == 0
    if codec.HEADER[:3] not in data:
        assert bytes(received[8 : 8 + 1 + len(data)]) == bytes([error]) + data


@given(IDS, st.sampled_from(list(InstructionCode)), PARAMS)
def test_a_packet_comes_back_as_it_was(id: int, instruction: InstructionCode, params: bytes) -> None:
    stream = codec.packet(id, instruction, params)
    assert HEADER not in stream[4:-2]
    assert parse(stream) == [Packet(id, instruction, params)]


@given(PARAMS)
def test_stuffing_is_lossless_and_leaves_its_argument_alone(data: bytes) -> None:
    before = bytes(data)
    assert codec.unstuff(codec.stuff(data)) == data == before


def test_a_stuffed_payload_has_the_official_bytes() -> None:
    """Current -1 followed by velocity -3 looks like a header."""
    data = (-1).to_bytes(2, "little", signed=True) + (-3).to_bytes(4, "little", signed=True)
    stream = codec.status(1, 0, data)
    assert stream[9:-2] == b"\xff\xff\xfd\xfd\xff\xff\xff"
    assert parse(stream)[0].params[1:] == data


@given(st.lists(st.tuples(IDS, PARAMS), max_size=6), st.lists(st.integers(1, 9), min_size=1, max_size=40))
def test_pieces_of_a_stream_give_the_same_packets(content: list[tuple[int, bytes]], cuts: list[int]) -> None:
    stream = b"".join(codec.status(id, 0, data) for id, data in content)
    parser, found, at, i = PacketParser(), [], 0, 0
    while at < len(stream):
        step = cuts[i % len(cuts)]
        found += parser.feed(stream[at : at + step])
        at, i = at + step, i + 1
    assert found == [Packet(id, InstructionCode.STATUS, b"\x00" + data) for id, data in content]
    assert parser.pending == 0
    assert parser.garbage == 0


@given(st.binary(max_size=80), IDS, PARAMS)
def test_a_packet_behind_garbage_is_found(garbage: bytes, id: int, data: bytes) -> None:
    """Whatever the garbage claims of its bytes, as long as more come."""
    wanted = Packet(id, InstructionCode.STATUS, b"\x00" + data)
    parser = PacketParser(max_length=256)
    found = parser.feed(garbage + codec.status(id, 0, data))
    found += parser.feed(bytes(256))
    assert wanted in found


def test_a_truncated_packet_does_not_swallow_the_next() -> None:
    """Without waiting for bytes that the first claimed: the next is whole, and stuffing forbids it inside the first."""
    first, second = codec.status(1, 0, bytes(10)), codec.status(2, 0, bytes(10))
    for cut in range(1, len(first)):
        parser = PacketParser()
        assert [p.id for p in parser.feed(first[:cut] + second)] == [2], cut
        assert parser.garbage == cut


@pytest.mark.parametrize("flip", range(8 * 21))
def test_a_flipped_bit_is_never_taken_for_data(flip: int) -> None:
    stream = bytearray(codec.status(1, 0, bytes(range(10))))
    stream[flip // 8] ^= 1 << flip % 8
    parser = PacketParser()
    assert parser.feed(bytes(stream)) == []
    assert [p.id for p in parser.feed(bytes(64) + codec.status(2) + bytes(2048))] == [2]


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=300) | PARAMS | st.just(HEADER + b"\x01\xf0\x07\x55"), max_size=20))
def test_no_stream_upsets_the_parser(pieces: list[bytes]) -> None:
    parser = PacketParser(max_length=512)
    taken = 0
    for piece in pieces:
        taken += sum(len(codec.stuff(p.params)) + 10 for p in parser.feed(piece))
        assert parser.pending <= 512 + 300
    assert parser.garbage + parser.pending + taken == sum(map(len, pieces))


def test_random_and_mutated_streams_do_not_hang() -> None:
    """Dense false headers are the worst case: each claims all that follows."""
    rng = random.Random(1)
    good = [codec.status(i, 0, bytes(10)) for i in range(1, 21)]
    parser = PacketParser()
    for _ in range(3000):
        kind = rng.randrange(3)
        if kind == 0:
            stream = rng.randbytes(rng.randrange(200))
        elif kind == 1:
            stream = b"".join(
                HEADER + bytes([rng.randrange(253), rng.randrange(256), rng.randrange(8)]) for _ in range(20)
            )
        else:
            mutable = bytearray(b"".join(good))
            for _ in range(rng.randrange(1, 6)):
                mutable[rng.randrange(len(mutable))] = rng.randrange(256)
            stream = bytes(mutable[: rng.randrange(len(mutable))])
        parser.feed(stream)
        assert parser.pending <= codec.MAX_LENGTH + 420
    parser.reset()
    assert len(parser.feed(b"".join(good))) == 20


# Fast reads ----------------------------------------------------------------------------------------------------------

FAST_IDS = list(range(1, 21))
LENGTHS = [10] * 20


def fast_frame(seed: int = 0) -> tuple[bytes, list[Status | None]]:
    rng = random.Random(seed)
    blocks = [(id, 0x80 if id == 7 else 0, rng.randbytes(10)) for id in FAST_IDS]
    expected: list[Status | None] = [Status(id, error & 0x7F, error > 0, data) for id, error, data in blocks]
    return codec.fast_status(blocks), expected


def test_a_fast_frame_gives_every_block() -> None:
    frame, expected = fast_frame()
    assert codec.parse_fast(frame, FAST_IDS, LENGTHS) == expected
    assert codec.parse_fast(b"\x00noise\xff" + frame + b"\xff", FAST_IDS, LENGTHS) == expected
    received, result = SDK.rxPacket(Wire(frame), True)
    assert result == 0, "the SDK takes the frame too"
    assert bytes(received) == frame
    assert parse(frame)[0].id == BROADCAST


def test_a_fast_frame_that_looks_stuffed_is_left_alone() -> None:
    data = b"\xff\xff\xfd\xfd\xff\xff\xfd\x00\x01\x02"
    frame = codec.fast_status([(1, 0, data), (2, 0, data)])
    assert codec.parse_fast(frame, [1, 2], [10, 10]) == [Status(1, 0, False, data), Status(2, 0, False, data)]
    assert data in parse(frame)[0].params


@given(st.integers(0, 287), st.integers(1, 255))
def test_damage_to_a_fast_frame_costs_few_blocks_and_never_gives_wrong_ones(place: int, change: int) -> None:
    frame, expected = fast_frame()
    damaged = bytearray(frame)
    damaged[place] ^= change
    got = codec.parse_fast(bytes(damaged), FAST_IDS, LENGTHS)
    lost = [i for i, (a, b) in enumerate(zip(got, expected, strict=True)) if a != b]
    assert all(got[i] is None for i in lost)
    block = (place - 8) // 14
    assert lost == list(range(20)) if place < 8 else set(lost) <= {block, block + 1} and lost


@given(st.integers(0, 287))
def test_a_fast_frame_cut_short_gives_the_blocks_that_came(cut: int) -> None:
    frame, expected = fast_frame()
    whole = max(0, (cut - 8) // 14)
    assert codec.parse_fast(frame[:cut], FAST_IDS, LENGTHS) == expected[:whole] + [None] * (20 - whole)


def test_ids_out_of_place_are_not_taken() -> None:
    """A servo that answers twice, or for another, must not pass as the one that was asked."""
    data = bytes(10)
    frame = codec.fast_status([(1, 0, data), (1, 0, data), (3, 0, data)])
    assert [s.id if s else None for s in codec.parse_fast(frame, [1, 2, 3], [10] * 3)] == [1, None, 3]
    assert codec.parse_fast(frame, [1, 2], [10] * 2) == [None, None], "another length: an answer to something else"


@given(st.binary(max_size=400))
def test_garbage_is_no_fast_frame(garbage: bytes) -> None:
    assert all(
        s is None or s.id == id for s, id in zip(codec.parse_fast(garbage, [1, 2], [10, 4]), [1, 2], strict=True)
    )


@given(st.integers(0, 287), st.integers(0, 255), st.integers(1, 5))
def test_the_quick_way_through_a_fast_frame_agrees_with_the_careful_one(place: int, change: int, seed: int) -> None:
    """It takes a frame only when there is nothing to say against any block."""
    rng = random.Random(seed)
    frame = codec.fast_status([(id, 0, rng.randbytes(10)) for id in FAST_IDS])
    damaged = bytearray(frame)
    damaged[place] ^= change
    got = codec.whole_fast(bytes(damaged), codec.fast_head(LENGTHS), bytes(FAST_IDS), 10)
    careful = codec.parse_fast(bytes(damaged), FAST_IDS, LENGTHS)
    assert got == (None if change else [s.data for s in careful if s])
    assert codec.whole_fast(frame + b"x", codec.fast_head(LENGTHS), bytes(FAST_IDS), 10) is None
    assert codec.whole_fast(frame, codec.fast_head(LENGTHS), bytes(reversed(FAST_IDS)), 10) is None


@given(st.integers(0, 62), st.integers(0, 255), st.lists(PARAMS.filter(lambda p: len(p) >= 10), min_size=3, max_size=3))
def test_the_quick_way_through_plain_answers_agrees_with_the_careful_one(
    place: int, change: int, payloads: list[bytes]
) -> None:
    stream = bytearray(b"".join(codec.status(i + 1, 0, data[:10]) for i, data in enumerate(payloads)))
    stream[place] ^= change
    got = codec.whole_sync(bytes(stream), [codec.status_head(i, 10) for i in (1, 2, 3)], 10)
    if got is not None:
        assert [p.params[1:] for p in parse(bytes(stream))] == got
    elif not change:
        assert any(HEADER[:3] in data[:10] for data in payloads), "only stuffing needs care here"


def test_an_alert_takes_the_careful_way() -> None:
    frame, _ = fast_frame()
    assert codec.whole_fast(frame, codec.fast_head(LENGTHS), bytes(FAST_IDS), 10) is None


# What is refused before it is sent -----------------------------------------------------------------------------------


def test_impossible_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="ID 253"):
        codec.read(253, 0, 2)
    with pytest.raises(ValueError, match="asked twice"):
        codec.sync_read([1, 2, 1], 132, 4)
    with pytest.raises(ValueError, match="servo 2: 2 bytes"):
        codec.sync_write(116, 4, {1: bytes(4), 2: bytes(2)})
    with pytest.raises(ValueError, match="ID 254"):
        codec.bulk_read([(254, 0, 1)])


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=3, max_size=3))
def test_a_preassembled_sync_write_is_the_plain_one(values: list[int]) -> None:
    writer = codec.SyncWriter([4, 5, 6], 116, 4, signed=True)
    data = {id: value.to_bytes(4, "little", signed=True) for id, value in zip([4, 5, 6], values, strict=True)}
    assert writer.packet(values) == codec.sync_write(116, 4, data)
    with pytest.raises(ValueError, match="sync write"):
        writer.packet([0, 0, 2**31])


def test_an_answer_tells_alert_from_error() -> None:
    assert codec.as_status(Packet(1, InstructionCode.STATUS, b"\x84\x01")) == Status(
        1, codec.StatusError.DATA_RANGE, True, b"\x01"
    )
    assert codec.as_status(Packet(1, InstructionCode.READ, b"\x84\x00\x04\x00")) is None, "an echo is no answer"
