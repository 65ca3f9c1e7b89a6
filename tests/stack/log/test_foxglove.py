"""What viewers of logs see: plain numbers under the schemas that they know, at the time of day when it happened."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from test_recorder import ROBOT, record, tick_record

from servoid.stack.log.foxglove import VIEWS, line, views
from servoid.stack.safety.event import Event


@pytest.fixture
def told(tmp_path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Topic -> log time and message."""
    record(tmp_path / "a.mcap")
    found = defaultdict(list)
    with (tmp_path / "a.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found[channel.topic].append((message.log_time, json.loads(message.data)))
    return found


def test_a_run_of_seconds_spans_seconds_of_today(
    told: dict[str, list[tuple[int, dict[str, Any]]]], tmp_path: Path
) -> None:
    """It spanned an hour in 1970: the header's time was 0, and the ticks' that of the machine's uptime."""
    times = [at for messages in told.values() for at, _ in messages]
    assert (max(times) - min(times)) * 1e-9 == pytest.approx(99 * ROBOT.dt, abs=1e-3)
    assert abs(min(times) * 1e-9 - (tmp_path / "a.mcap").stat().st_mtime) < 3600
    clock = [message["time_ns"] for _, message in told["/observation"]]
    assert clock == [i * 20_000_000 for i in range(100)], "the body's own clock is kept beside it"


def test_joints_are_plain_numbers_under_their_names(told: dict[str, list[tuple[int, dict[str, Any]]]]) -> None:
    at, message = told["/view/joints"][3]
    records = [tick_record(i, rng) for rng in [np.random.default_rng(0)] for i in range(4)]
    assert message["timestamp"] == {"sec": at // 10**9, "nsec": at % 10**9}
    assert [joint["name"] for joint in message["joints"]] == list(ROBOT.names)
    positions = [joint["position"] for joint in message["joints"]]
    np.testing.assert_allclose(positions, records[3].observation.position, atol=1e-5)
    targets = [joint["position"] for joint in told["/view/targets"][3][1]["joints"]]
    np.testing.assert_allclose(targets, records[3].command.position, atol=1e-5)
    assert len(told["/view/frames"]) == len(told["/view/motion"]) == 100


def test_what_was_not_measured_is_left_out() -> None:
    messages = dict(views(tick_record(1, np.random.default_rng(0)), ROBOT.names, 5))
    assert messages["/view/health"]["temperature"] == {}
    json.dumps(messages, allow_nan=False)


def test_every_message_is_what_its_schema_says(told: dict[str, list[tuple[int, dict[str, Any]]]]) -> None:
    def fits(value: Any, schema: dict[str, Any]) -> bool:
        match schema["type"]:
            case "object":
                known = schema.get("properties") or {key: {"type": "number"} for key in value}
                return value.keys() <= known.keys() and all(fits(item, known[key]) for key, item in value.items())
            case "array":
                return all(fits(item, schema["items"]) for item in value)
            case "integer":
                return isinstance(value, int)
            case "number":
                return isinstance(value, int | float)
        return isinstance(value, str)

    assert told.keys() >= VIEWS.keys()
    for topic, (_, schema) in VIEWS.items():
        assert all(fits(message, schema) for _, message in told[topic]), topic
    assert not fits({"timestamp": {"sec": 0.5}}, VIEWS["/view/log"][1]), "a check that lets all pass is none"


def test_events_are_log_lines_with_a_level() -> None:
    fell = line(Event(4, 0.08, "servo", "l_knee", "overload"), 2_500_000_000)[1]
    assert fell["message"] == "l_knee: overload"
    assert fell["level"] > line(Event(4, 0.08, "phase", None, "running"), 0)[1]["level"]
    assert fell["timestamp"] == {"sec": 2, "nsec": 500_000_000}
