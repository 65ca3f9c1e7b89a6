"""`servoid bench fuzz`: a small run of it, and that what goes wrong in a target is counted and can be repeated."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence

import pytest

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import PacketParser
from servoid.tools.cli import main
from servoid.tools.faults import fuzz, targets
from servoid.tools.faults.streams import IDS, WIDTH, stream


@pytest.mark.slow
def test_nothing_upsets_what_reads_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "fuzz", "--streams", "400", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["exceptions"], result["hangs"], result["unbounded"], result["failures"]) == (0, 0, 0, [])
    assert result["streams"] == 400


def test_failures_of_every_kind_are_counted_with_what_repeats_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    count = iter(range(100))

    def take(self: targets.CodecTarget, pieces: Sequence[bytes]) -> None:
        number = next(count)
        if number == 2:
            raise IndexError("beyond the end")
        if number == 4:
            time.sleep(60.0)
        if number == 6:
            raise targets.Unbounded("a million bytes")

    monkeypatch.setattr(targets.CodecTarget, "take", take)
    monkeypatch.setattr(fuzz, "_HANG_SECONDS", 0.5)
    assert main(["bench", "fuzz", "--streams", "8", "--seed", "5", "--first", "10", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["exceptions"], result["hangs"], result["unbounded"]) == (1, 1, 1)
    first = result["failures"][0]
    assert (first["target"], first["stream"]) == ("codec", 12)
    assert first["repeat"] == "servoid bench fuzz --seed 5 --first 10 --streams 3"
    assert "IndexError: beyond the end" in first["what"]


def test_streams_repeat_themselves_and_reach_the_parsers() -> None:
    """Noise alone would never pass a checksum."""
    assert stream(1, 2) == stream(1, 2) != stream(2, 2)
    parser = PacketParser()
    whole = sum(len(parser.feed(b"".join(stream(0, number)))) for number in range(300))
    assert whole > 300
    assert parser.bad_crc > 10


@pytest.mark.parametrize("fast", [True, False])
def test_the_bus_takes_whole_answers_one_after_the_other(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers that came before they were asked for are dropped unread, and nothing of the bus would be tried."""
    monkeypatch.setattr(targets, "_BUS_EVERY", 1)
    driver = targets.DriverTarget()
    (group,) = (group for group in driver._groups if group.fast == fast)
    for value in range(3):
        data = bytes([value] * WIDTH)
        plain = b"".join(codec.status(id, 0, data) for id in IDS)
        answer = codec.fast_status([(id, 0, data) for id in IDS]) if fast else plain
        driver.take([answer[:50], answer[50:]])
        assert all(group.fresh)
        assert group.data == [data] * len(IDS)
