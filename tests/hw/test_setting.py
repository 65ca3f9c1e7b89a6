"""Settings: the range that is shown is the one that is checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import pytest

from servoid.hw.setting import Range, Setting, check, explain


@dataclass(frozen=True)
class Inner:
    near: Annotated[float, Setting("how near", "m", least=0)] = 0.5


@dataclass(frozen=True)
class Outer:
    speed: Annotated[Range, Setting("how fast", "m/s", above=0)] = (0.1, 0.25)
    inner: Inner = field(default_factory=Inner)
    count: Annotated[int | None, Setting("how many", least=2, most=4)] = None
    plain: str = "text"


def test_every_setting_is_explained_those_of_parts_too() -> None:
    rows = [(row.key, row.value, row.text, row.unit, row.range) for row in explain(Outer())]
    assert rows == [
        ("speed", "0.1:0.25", "how fast", "m/s", "above 0"),
        ("count", "none", "how many", "", "2 to 4"),
        ("plain", "text", "", "", ""),
        ("inner.near", "0.5", "how near", "m", "at least 0"),
    ]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (Outer(speed=(0.0, 1.0)), "speed: must be positive, not 0"),
        (Outer(speed=(0.3, 0.1)), "speed: upside down: 0.3 is above 0.1; write low before high"),
        (Outer(count=5), "count: must be 2 to 4, not 5"),
        (Outer(count=1), "count: must be 2 to 4, not 1"),
        (Inner(-0.1), "near: must not be negative: -0.1"),
    ],
)
def test_a_value_outside_its_range_is_refused(settings: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check(settings)


def test_values_at_the_ends_and_none_are_taken() -> None:
    check(Outer(count=2))
    check(Outer(count=4))
    check(Inner(0.0))
