"""Limits that nobody can have meant are refused, with file and line, before anything is connected."""

from __future__ import annotations

import re
from pathlib import Path
from shutil import copy

import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.plausible import cycle_seconds


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("homing_speed: 0.5", "homing_speed: 30", "limits.homing_speed: 30 rad/s is too fast to go home from any pose"),
        ("homing_speed: 0.5", "homing_speed: 1.2", "at most 1.14, a quarter of what a xm430-w350 can"),
        ("joint_speed: 4.5", "joint_speed: 45", "limits.joint_speed: 45 rad/s is more than the 4.55 that a xm430-w350"),
        ("joint_speed: 4.5", "joint_speed: 0.3", "limits.homing_speed: must not be above limits.joint_speed (0.3)"),
        (
            "temperature: 70 ",
            "temperature: 90 ",
            "limits.temperature: 90 C is above the 80 at which a xm430-w350 shuts",
        ),
        ("voltage: 10.0 ", "voltage: 5.0 ", "limits.voltage: 5 V is outside the 9.5 to 16 V that the servos work at"),
        ("derate_voltage: 10.5", "derate_voltage: 105", "limits.derate_voltage: 105 V is outside the 9.5 to 16 V"),
        ("tilt: 1.047", "tilt: 3.1", "limits.tilt: 3.1 rad is more than lying down"),
        (
            "stale: 3 ",
            "stale: 30 ",
            "limits.stale: 30 ticks are 0.60 s, and a robot 0.259 m tall topples in about 0.16",
        ),
        ("standing_height: 0.259", "standing_height: 25.9", "standing_height: 25.9 m is more than its legs reach"),
        (
            "range: [-1.5708, 1.5708], home: 0,",
            "range: [-3.2, 3.2], home: 0,",
            "range: head_pan: wider than the one turn",
        ),
        ("baud: 2000000", "baud: 57600", "bus.baud: at 57600 bit/s a control cycle of 20 servos takes 154.3 ms"),
        ("rate: 50 ", "rate: 400 ", "and a tick at rate 400 has 2.5, of which 2.0 for the bus: set 4500000 or more"),
        ("rate: 50 ", "rate: 4000 ", "of which 0.2 for the bus: lower the rate"),
    ],
)
def test_a_limit_that_cannot_be_meant_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    assert old in text
    path = tmp_path / "op3.yaml"
    path.write_text(text.replace(old, new, 1))
    copy(CONFIGS / "robots" / "op3.xml", tmp_path)
    with pytest.raises(ConfigError, match=re.escape(words)) as caught:
        load_robot(path)
    assert re.match(rf"{re.escape(str(path))}:\d+: ", str(caught.value))


def test_a_cycle_is_as_long_as_its_bytes() -> None:
    """The 568 bytes of 20 servos' present values and goals, with what is read beside them."""
    beside = (14 + 11 + 20) + (14 + 4 + 4 * (11 + 35)) + (14 + 4 + 4 * (11 + 3))
    assert cycle_seconds(20, 2_000_000) == pytest.approx((568 + beside) * 10 / 2_000_000)
    late = cycle_seconds(20, 2_000_000, board=False, return_delay=500e-6)
    assert late == pytest.approx((568 + beside - 45) * 10 / 2_000_000 + 28 * 500e-6)
