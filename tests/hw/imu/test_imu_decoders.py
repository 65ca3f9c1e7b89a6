"""Bytes of IMUs to samples: units and axes against the data sheets, and any garbage survived."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from imu_bytes import rvc, wit, wit_sample

from servoid.hw.imu import bno08x, witmotion
from servoid.hw.imu.bno08x import Bno08x
from servoid.hw.imu.reading import Decoder
from servoid.hw.imu.rotations import conjugate, multiply
from servoid.hw.imu.witmotion import WitMotion

G = 9.80665
# The example of the BNO080 data sheet, 1.3.5.2: yaw 0.01, pitch -1.10, roll 20.85 degrees; -371, -20, 977 mg.
EXAMPLE = bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")


def up_in_sensor(q: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(multiply(multiply(conjugate(q), (0.0, 0.0, 0.0, 1.0)), q)[1:])


def test_witmotion_units_and_axes() -> None:
    (first, second) = WitMotion().feed(wit_sample((2048, -1024, 2048), (16384, 0, -164)))
    assert first.number == second.number
    assert first.orientation is None
    assert second.specific_force == pytest.approx((G, -G / 2, G))
    assert second.angular_velocity == pytest.approx((math.radians(1000), 0.0, math.radians(-10.01)), rel=1e-3)
    assert second.orientation == pytest.approx((1, 0, 0, 0))


@pytest.mark.parametrize(
    ("angles", "up"),
    [
        ((0, 0, 8192), (0, 0, 1)),  # turned about the vertical
        ((8192, 0, 0), (0, math.sqrt(0.5), math.sqrt(0.5))),  # rolled 45 degrees to the right: up is to the left
        ((0, 8192, 0), (-math.sqrt(0.5), 0, math.sqrt(0.5))),  # nose down: up is behind
    ],
)
def test_witmotion_angles_and_quaternions_agree(angles: tuple[int, int, int], up: tuple[float, float, float]) -> None:
    decoder = WitMotion()
    sample = decoder.feed(wit_sample(angles=False) + wit(0x53, *angles, 0))[-1]
    assert sample.orientation is not None
    assert up_in_sensor(sample.orientation) == pytest.approx(up, abs=1e-3)
    counts = [round(value * 32767) for value in sample.orientation]
    again = decoder.feed(wit_sample(angles=False) + wit(0x59, *counts))[-1]
    assert again.orientation == pytest.approx(sample.orientation, abs=1e-3)
    after = decoder.feed(wit_sample(angles=False) + wit(0x53, 0, 0, 0, 0) + wit(0x59, *counts))[-1]
    assert after.orientation == pytest.approx(sample.orientation, abs=1e-3), "a quaternion is better than angles"


def test_a_quaternion_that_is_none_is_not_believed() -> None:
    decoder = WitMotion()
    (sample,) = decoder.feed(wit_sample(angles=False) + wit(0x59, 100, 0, 0, 0))
    assert sample.orientation is None
    assert decoder.bad == 1


def test_halves_of_different_witmotion_samples_are_not_joined() -> None:
    decoder = WitMotion()
    assert decoder.feed(wit(0x52, 1, 2, 3, 0)) == []
    assert decoder.feed(wit(0x51, 0, 0, 2048, 0)) == []
    assert len(decoder.feed(wit(0x52, 1, 2, 3, 0))) == 1
    assert decoder.feed(wit(0x52, 4, 5, 6, 0)) == []


def test_the_data_sheets_example_message() -> None:
    (sample,) = Bno08x().feed(EXAMPLE)
    assert sample.specific_force == pytest.approx((-3.638, -0.196, 9.581), abs=1e-3)
    assert np.isnan(sample.angular_velocity).all(), "one orientation is no angular velocity"
    assert sample.orientation is not None
    measured = np.array(sample.specific_force) / np.linalg.norm(sample.specific_force)
    assert up_in_sensor(sample.orientation) == pytest.approx(measured, abs=0.002), "its angles and its gravity agree"


@pytest.mark.parametrize(
    ("field", "axis", "sign"), [("yaw", 2, 1.0), ("yaw", 2, -1.0), ("pitch", 0, 1.0), ("roll", 1, 1.0)]
)
def test_an_rvc_angular_velocity_is_that_of_its_angles(field: str, axis: int, sign: float) -> None:
    decoder = Bno08x(sign if field == "yaw" else 1.0)
    stream = b"".join(rvc(250 + i, **{field: -17900 + 50 * i if field == "yaw" else 50 * i}) for i in range(12))
    samples = decoder.feed(stream)
    expected = np.zeros(3)
    expected[axis] = sign * math.radians(0.5) / 0.01
    assert len(samples) == 12
    assert all(np.isnan(sample.angular_velocity).all() for sample in samples[:2])
    for sample in samples[2:]:
        assert sample.angular_velocity == pytest.approx(expected, abs=1e-6)


def test_a_yaw_across_its_seam_is_no_spin() -> None:
    samples = Bno08x().feed(b"".join(rvc(i, yaw=(17990 + 10 * i + 18000) % 36000 - 18000) for i in range(5)))
    assert samples[-1].angular_velocity == pytest.approx((0, 0, math.radians(10)), abs=1e-6)


def test_no_angular_velocity_across_a_gap_and_a_repeated_message_counts_once() -> None:
    decoder = Bno08x()
    indices = [0, 1, 2, 2, 3, 5, 6, 7]
    samples = decoder.feed(b"".join(rvc(i, yaw=10 * i) for i in indices))
    assert [np.isnan(s.angular_velocity[2]) for s in samples] == [True, True, False, False, True, True, False]


GOOD = {
    "witmotion": [wit_sample((7 * i, -i, 2048 + i), (i, 0x55, -i)) for i in range(20)],
    "bno08x": [rvc(i, 170 * i, 0xAA, -i, (0xAAA, i, 1000)) for i in range(20)],
}


def make(kind: str) -> Decoder:
    return WitMotion() if kind == "witmotion" else Bno08x()


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(GOOD)), st.lists(st.integers(1, 40), min_size=1), st.binary(max_size=60))
def test_however_a_stream_is_cut_and_begun_its_samples_come(kind: str, sizes: list[int], before: bytes) -> None:
    stream = b"".join(GOOD[kind])
    whole = make(kind).feed(stream)
    decoder, came, at, i = make(kind), [], 0, 0
    for byte in range(0, len(before), 7):
        came += decoder.feed(before[byte : byte + 7])
    came.clear()
    while at < len(stream):
        came += decoder.feed(stream[at : at + sizes[i % len(sizes)]])
        at, i = at + sizes[i % len(sizes)], i + 1
    assert [s.raw for s in came][-15:] == [s.raw for s in whole][-15:], "garbage costs the first few at most"


@settings(max_examples=120, deadline=None)
@given(st.sampled_from(sorted(GOOD)), st.data())
def test_nothing_upsets_a_decoder_and_little_is_kept(kind: str, data: st.DataObject) -> None:
    """Random bytes, heads in plenty, and good streams with bytes flipped, lost and doubled."""
    head = b"\x55\x51" if kind == "witmotion" else b"\xaa\xaa"
    decoder = make(kind)
    pieces = st.one_of(
        st.binary(max_size=200),
        st.lists(st.sampled_from([head, head[:1], b"\0", b"\x55\x59"]), max_size=60).map(b"".join),
        st.sampled_from(GOOD[kind]).flatmap(
            lambda good: st.integers(0, len(good)).map(lambda n: good[:n] + good[n + 1 :])
        ),
        st.tuples(st.sampled_from(GOOD[kind]), st.integers(0, 32), st.integers(0, 255)).map(
            lambda t: t[0][: t[1]] + bytes([t[2]]) + t[0][t[1] + 1 :]
        ),
    )
    for piece in data.draw(st.lists(pieces, max_size=12)):
        for sample in decoder.feed(piece):
            assert np.isfinite(sample.specific_force).all()
            if sample.orientation is not None:
                assert np.linalg.norm(sample.orientation) == pytest.approx(1.0)
        assert len(decoder._rest) < 20  # type: ignore[attr-defined]
    good = b"".join(GOOD[kind])
    assert len({sample.number for sample in decoder.feed(good)}) >= 18, "it finds its way back"


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([witmotion, bno08x]), st.binary(max_size=300))
def test_every_byte_is_in_a_frame_or_garbage_or_kept(kind: object, data: bytes) -> None:
    scan = kind.frames(data)  # type: ignore[attr-defined]
    assert sum(map(len, scan.frames)) + scan.garbage + len(scan.rest) == len(data)
    assert data.endswith(scan.rest)
    assert kind.frames(scan.rest).rest == scan.rest  # type: ignore[attr-defined]


class Counted(bytes):
    """Bytes that count how often they are searched, and how many of them were copied."""

    searches = copied = 0

    def find(self, *args: Any) -> int:
        self.searches += 1
        return super().find(*args)

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        self.copied += len(part) if isinstance(part, bytes) else 1
        return part


@pytest.mark.parametrize("kind", sorted(GOOD))
def test_a_flood_of_heads_takes_time_in_proportion(kind: str) -> None:
    module = witmotion if kind == "witmotion" else bno08x
    flood = Counted((b"\x55\x51" if kind == "witmotion" else b"\xaa\xaa") * 10_000)
    assert module.frames(flood).garbage > 19_900
    assert flood.searches <= len(flood)
    assert flood.copied <= module.SIZE * len(flood)
