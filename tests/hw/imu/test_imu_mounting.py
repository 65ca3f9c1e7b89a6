"""However an IMU is mounted, its readings are those of the base."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servoid.hw.imu.mounting import Mounting
from servoid.hw.imu.rotations import conjugate, multiply, turn_between, yaw_pitch_roll

QUARTER = math.pi / 2


@pytest.mark.parametrize(
    ("angles", "sensor", "base"),
    [
        ((0, 0, QUARTER), (1, 0, 0), (0, 1, 0)),  # its x points to the robot's left
        ((QUARTER, 0, 0), (0, 1, 0), (0, 0, 1)),  # on its side: its y points up
        ((0, QUARTER, 0), (1, 0, 0), (0, 0, -1)),  # nose down
        ((QUARTER, 0, QUARTER), (0, 1, 0), (0, 0, 1)),  # roll first, then yaw
        ((math.pi, 0, 0), (0, 0, 1), (0, 0, -1)),  # upside down
    ],
)
def test_axes(angles: tuple[float, float, float], sensor: tuple[int, ...], base: tuple[int, ...]) -> None:
    mounting = Mounting(angles=angles)
    assert mounting.to_base(np.array(sensor)) == pytest.approx(base, abs=1e-12)
    assert mounting.to_sensor(np.array(base)) == pytest.approx(sensor, abs=1e-12)


@pytest.mark.parametrize("signs", [(1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0)])
def test_orientation_goes_with_the_axes(signs: tuple[float, float, float]) -> None:
    """Up as the sensor sees it, put into the base, is up as the base's orientation says."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        mounting = Mounting(signs, tuple(rng.uniform(-3, 3, 3)))
        sensor = yaw_pitch_roll(*rng.uniform(-3, 3, 3))
        up = (0.0, 0.0, 0.0, 1.0)
        seen = np.array(multiply(multiply(conjugate(sensor), up), sensor)[1:])
        w, x, y, z = mounting.orientation(sensor)
        base = (float(w), float(x), float(y), float(z))
        expected = np.array(multiply(multiply(conjugate(base), up), base)[1:])
        np.testing.assert_allclose(mounting.to_base(seen), expected, atol=1e-12)


def test_mirrored_axes_have_no_orientation_and_the_boards_signs_are_exact() -> None:
    assert np.isnan(Mounting((1.0, 1.0, -1.0)).orientation((1.0, 0.0, 0.0, 0.0))).all()
    vector = np.array([0.1234567, -3.3, 9.81])
    np.testing.assert_array_equal(Mounting((-1.0, -1.0, 1.0)).to_base(vector), [-0.1234567, 3.3, 9.81])


def test_a_turn_is_found_the_shorter_way() -> None:
    before = yaw_pitch_roll(3.1, 0.2, -0.1)
    for angle in (1e-9, 0.01, 3.0):
        after = multiply(before, yaw_pitch_roll(0.0, 0.0, angle))
        assert turn_between(before, after) == pytest.approx((angle, 0, 0), abs=1e-9)
        opposite = tuple(-value for value in after)
        assert turn_between(before, opposite) == pytest.approx((angle, 0, 0), abs=1e-9)  # type: ignore[arg-type]
