"""The bench of the training world prints what a person compares."""

from __future__ import annotations

import argparse
import json

import pytest

from servoid.tools.bench import sim


def test_it_prints_both_speeds(capfd: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    sim.add_arguments(parser)
    assert sim.main(parser.parse_args(["--worlds", "8", "--ticks", "3", "--json"])) == 0
    (line,) = capfd.readouterr().out.splitlines()
    values = json.loads(line)
    assert values["worlds"] == 8
    assert values["threads"] >= 1
    assert values["steps_per_s"] > 0
    assert values["raw_steps_per_s"] > 0
    assert values["ratio"] == pytest.approx(values["steps_per_s"] / values["raw_steps_per_s"])
