from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.policy.diffusion import engines
from servoid.policy.diffusion.settings import load_settings
from servoid.tools.bench import policy


def options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    policy.add_arguments(parser)
    return parser.parse_args(["--checkpoint", "random", "--width", "32", "--plans", "5", *words])


@pytest.mark.slow
def test_it_prints_one_row_for_each_network_runtime_and_kind_of_guidance(capfd: pytest.CaptureFixture[str]) -> None:
    assert policy.main(options("--engine", "torch", "--shape", "2,12,6", "--json")) == 0
    (line,) = capfd.readouterr().out.splitlines()
    result = json.loads(line)
    rows = result["rows"]
    assert [(row["network"], row["runtime"], row["guided"], row["gradient"]) for row in rows] == [
        (network, runtime, gradient != "none", gradient)
        for network in ("random", "2,12,6")
        for runtime in ("chunked", "rolling")
        for gradient in ("none", "analytic", "network")
    ]
    chunked, rolling = load_settings(), load_settings("diffuse_cloc")
    assert result["plan_due_ms"] == pytest.approx(20), "a plan that takes longer than `delay` is late"
    assert len({(row["network"], row["call_median_ms"]) for row in rows}) == 2, "a call is the same in every runtime"
    for row in rows:
        settings = chunked if row["runtime"] == "chunked" else rolling
        assert row["engine"] == "torch"
        assert row["plan_due_ms"] == pytest.approx(1000 * settings.delay * 0.02)
        assert row["tokens"] == (39 if row["network"] == "random" else 2 + 12 + 1 + 6)
        assert row["calls_per_plan"] == settings.steps + settings.lead
        assert 0 < row["call_median_ms"] <= row["call_p99_ms"]
        assert row["plan_p99_ms"] >= row["plan_median_ms"] > 0
        assert row["plans_per_s"] == pytest.approx(1000 / row["plan_median_ms"])
        assert row["plan_cpu_ms"] > 0
        assert row["plan_per_pass"] > 1.0  # a plan is its calls and more
        # A way back through the network is one more pass.
        assert (row["plan_per_call"] > 1.2 * row["plan_per_pass"]) == (row["gradient"] == "network")
        assert row["gflops"] > 0
        assert row["peak_gflops"] == rows[0]["peak_gflops"] > 0


def test_without_a_delay_a_plan_is_due_before_the_next_one() -> None:
    assert policy.due_ms(replace(load_settings(), execution_horizon=4, delay=0), 0.02) == pytest.approx(80)


def test_operations_are_counted_as_the_layers_say() -> None:
    from servoid.hw.robot.description import load_robot

    args = options("--layers", "3", "--shape", "none")
    (network,) = policy._networks(args, load_robot())
    tokens, width, states, actions = 39, 32, 20, 19
    block = tokens * (4 * width * width + 8 * width * width) + 2 * tokens * tokens * width
    ends = states * (2 * 54 * width + width * width) + actions * 2 * 20 * width
    assert network.gflop == pytest.approx(2 * (3 * block + ends) / 1e9)


def test_an_engine_that_is_not_installed_is_skipped_and_named(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda package: None)
    words = "--shape", "none", "--runtime", "chunked", "--plans", "1"
    assert policy.main(options(*words, "--json")) == 0
    out, err = capfd.readouterr()
    result = json.loads(out)
    assert {row["engine"] for row in result["rows"]} == {"torch"}
    assert "pip install 'servoid[onnx]'" in result["skipped"]["random: onnx"]
    assert "skipped random: openvino" in err
    with pytest.raises(ConfigError, match="pip install"):  # one that was asked for
        policy.main(options(*words, "--engine", "onnx"))


@pytest.mark.slow
def test_another_engine_is_timed_beside_torch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    words = "--shape", "none", "--runtime", "rolling", "--engine", "onnx", "--plans", "2", "--json"
    assert policy.main(options(*words)) == 0
    rows = json.loads(capfd.readouterr().out)["rows"]
    assert {row["engine"] for row in rows} == {"onnx"}
    assert [row["gradient"] for row in rows] == ["none", "analytic", "network"]


def test_a_shape_that_is_none_is_an_error() -> None:
    with pytest.raises(ConfigError, match="three whole numbers"):
        policy.main(options("--shape", "4,32"))
    with pytest.raises(ConfigError, match="actions must be 1 to the horizon"):
        policy.main(options("--shape", "4,16,32"))


def test_a_checkpoint_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ConfigError, match="no such checkpoint"):
        policy.main(options("--checkpoint", "no-such-one"))
