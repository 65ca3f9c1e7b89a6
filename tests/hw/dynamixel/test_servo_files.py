"""The shipped servos' files against the control tables of their models."""

from __future__ import annotations

import pytest

from servoid.hw.config import available
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.robot.description import load_servo


@pytest.mark.parametrize("name", available("servos"))
def test_a_servos_file_counts_as_its_model_does(name: str) -> None:
    """A unit of another model would make speeds, torques and supplies wrong on hardware, and right in simulation."""
    servo = load_servo(name)
    here = table(servo.model_number)
    assert here.name == servo.name == name
    assert servo.ticks_per_turn == 4096
    assert servo.velocity_unit == pytest.approx(here.item("present_velocity").scale, rel=1e-6)
    assert servo.voltage_unit == here.item("present_input_voltage").scale
    assert servo.max_temperature == here.item("temperature_limit").default
    low, high = here.item("min_voltage_limit").range or (0, 0)
    assert low * 0.1 <= servo.voltage_range[0]
    assert servo.voltage_range[1] <= high * 0.1
    if here.motor_current:
        assert servo.current_unit == pytest.approx(here.item("present_current").scale)
