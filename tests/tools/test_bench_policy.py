from __future__ import annotations

import argparse
import json

import pytest

from hw.config import ConfigError
from policy.diffusion.settings import load_settings
from tools.bench import policy


def options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    policy.add_arguments(parser)
    return parser.parse_args(["--checkpoint", "random", "--width", "32", "--plans", "5", *words])


def test_it_prints_one_row_for_each_kind_of_guidance(capfd: pytest.CaptureFixture[str]) -> None:
    assert policy.main(options("--json")) == 0
    (line,) = capfd.readouterr().out.splitlines()
    rows = json.loads(line)["rows"]
    assert [(row["engine"], row["runtime"], row["guided"]) for row in rows] == [
        ("torch", "chunk", False),
        ("torch", "chunk", True),
        ("torch", "chunk", True),
    ]
    for row in rows:
        assert row["tokens"] == 39
        assert row["calls_per_plan"] == load_settings().steps + load_settings().lead
        assert 0 < row["call_median_ms"] <= row["call_p99_ms"]
        # A plan is at least its network calls.
        assert row["plan_median_ms"] > 3 * row["call_median_ms"]
        assert row["plan_p99_ms"] >= row["plan_median_ms"]
        assert row["plans_per_s"] > 0


def test_a_checkpoint_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ConfigError, match="no such checkpoint"):
        policy.main(options("--checkpoint", "no-such-one"))
