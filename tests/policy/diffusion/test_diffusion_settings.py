from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoid.hw.config import CONFIGS, ConfigError, load_yaml
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.settings import DiffusionSettings, GuidanceSettings, Rolling, load_settings

NETWORK = DenoiserConfig(108, 20)


def refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=match):
        load_settings(str(path))


def test_unknown_names_are_refused_with_the_line_and_the_nearest_one(tmp_path: Path) -> None:
    refused(
        tmp_path,
        "steps: 5\nschedule: roling\n",
        r"mine\.yaml:2: no schedule is called 'roling': did you mean 'rolling'",
    )
    refused(
        tmp_path, "pyramid:\n  shape: pyramide\n", r"pyramid: no shape is called 'pyramide': did you mean 'pyramid'"
    )
    refused(tmp_path, "guidance:\n  choose: worst\n", "choose must be 'mean' or 'best', not 'worst'")
    refused(tmp_path, "rolling:\n  level: 3\n", "rolling.level: unknown key")


def test_keys_that_were_renamed_say_what_they_are_called_now(tmp_path: Path) -> None:
    """Files of users hold them, and the nearest known name is no help."""
    refused(tmp_path, "steps: 5\nreplan: 4\n", r"mine\.yaml:2: replan: this key is called 'execution_horizon' now")
    refused(tmp_path, "stabilise: 1\n", "this key is called 'stabilization_level' now")
    refused(tmp_path, "gradual:\n  spread: 3\n", "gradual: this key is called 'pyramid' now")
    refused(tmp_path, "schedule: gradual\n", "the schedule 'gradual' is called 'pyramid' now")


def test_numbers_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    refused(tmp_path, "eta: 1.5\n", r"eta must be 0 \(DDIM\) to 1 \(DDPM\), not 1.5")
    refused(tmp_path, "guidance:\n  samples: 0\n", "samples must be at least 1")
    refused(tmp_path, "guidance:\n  weight: inf\n", "finite")
    refused(tmp_path, "autoregressive:\n  block: 0\n", "at least 1 frame")
    with pytest.raises(ValueError, match="weight must be a number"):
        GuidanceSettings(weight=float("nan"))


def test_what_a_checkpoint_does_not_have_is_refused_with_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"horizon is 32, but this checkpoint takes 1 to 16 .* --horizon 32"):
        DiffusionSettings(horizon=32).check(NETWORK)
    with pytest.raises(ConfigError, match="history is 6, but this checkpoint takes 1 to 4"):
        DiffusionSettings(history=6).check(NETWORK)
    with pytest.raises(ConfigError, match=r"execution_horizon .* delay = 6 ticks, but this one has actions for 5"):
        DiffusionSettings(horizon=5, execution_horizon=4, delay=2).check(NETWORK)
    with pytest.raises(ConfigError, match="level of 1 to 20, not 30"):
        DiffusionSettings(schedule="rolling", rolling=Rolling(state_level=30)).check(NETWORK)
    with pytest.raises(ConfigError, match="stabilization_level must be at most 20"):
        DiffusionSettings(stabilization_level=21).check(NETWORK)


@pytest.mark.parametrize(
    ("shape", "training", "expected"),
    [
        ({}, {"committed": 2}, (5, 4, 2)),
        ({}, {"committed": 1}, (5, 4, 1)),
        ({}, {"inference_delay": 1}, (5, 4, 1)),
        ({"actions": 3}, {"committed": 2}, (5, 2, 1)),
        ({"actions": 1}, {"committed": 2}, (5, 1, 0)),
        ({}, {"committed": 2, "far_actions": 0.0, "near_actions": 5}, (5, 3, 2)),
        ({}, {"far_actions": 0.0, "near_actions": 1}, (5, 1, 0)),
        ({"levels": 4}, {"committed": 2}, (4, 4, 2)),
    ],
)
def test_settings_are_fitted_to_what_a_network_can_do(
    shape: dict[str, int], training: dict[str, Any], expected: tuple[int, int, int]
) -> None:
    network = DenoiserConfig(108, 20, **shape)
    settings = DiffusionSettings(steps=5, execution_horizon=4, delay=2).fitted(network, training)
    assert (settings.steps, settings.execution_horizon, settings.delay) == expected
    settings.check(network, training)


def test_every_file_of_diffusion_settings_loads_and_fits_the_default_network() -> None:
    files = [path for path in (CONFIGS / "policies").glob("*.yaml") if "\nschedule:" in path.read_text()]
    assert len(files) >= 2
    for path in files:
        load_yaml(path, DiffusionSettings).check(NETWORK)


@pytest.mark.parametrize("schedule", ["full_sequence", "autoregressive", "pyramid", "rolling"])
def test_a_shorter_history_and_horizon_leave_the_rest_as_noise(schedule: str) -> None:
    settings = DiffusionSettings(schedule=schedule, history=2, horizon=8)
    matrix = settings.matrix(NETWORK, fresh=1)
    states, actions = settings.used(NETWORK)
    assert NETWORK.state_ticks[states].tolist() == list(range(-1, 9))
    assert NETWORK.action_ticks[actions].tolist() == list(range(-1, 8))
    assert (matrix.states[:, ~states] == 20).all()
    assert (matrix.actions[:, ~actions] == 20).all()
    assert not matrix.states[-1, states].any()
    assert not matrix.actions[-1, actions].any()
    if schedule == "rolling":  # what is fresh is the last frame of the plan, not of the network
        assert matrix.states[0, np.flatnonzero(NETWORK.state_ticks == 8)] == 20
        levels = matrix.states[0, (NETWORK.state_ticks > 0) & states]
        assert (np.diff(levels) >= 0).all()
        assert levels[0] == 14
        flat = DiffusionSettings(schedule=schedule, horizon=8, rolling=Rolling(ramp=1)).matrix(NETWORK, fresh=1)
        assert flat.states[0, np.flatnonzero(NETWORK.state_ticks == 7)] == 14
