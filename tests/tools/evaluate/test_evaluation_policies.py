"""Variants of the planner, networks of rows' own, and what episodes depend on."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.policy.checkpoint import read, resolve, write
from servoid.tools.evaluate.cache import key
from servoid.tools.evaluate.policies import Pilots, spec
from servoid.tools.evaluate.spec import Network, Run


def newest(folder: Path, share: float | None) -> None:
    """The newest network of a training that used so much of its budget; None: one that does not say."""
    head, tensors = read(resolve("diffusion"))
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "last.safetensors", tensors, {**head, "results": {} if share is None else {"share": share}})


def test_a_changed_checkpoint_setting_or_task_changes_what_episodes_depend_on(tmp_path: Path) -> None:
    checkpoint = tmp_path / "mine.safetensors"
    shutil.copy(resolve("diffusion"), checkpoint)

    def made_of(run: Run) -> str:
        return key(spec(run, Pilots(str(checkpoint), tmp_path), "op3", 0, None, None))

    run = Run("goal-near")
    before = made_of(run)
    assert made_of(Run("goal-near", episodes=7)) == before  # more of the same
    others = [
        made_of(Run("goal-near", set={"radius": "0.09"})),
        made_of(Run("goal-near", plan={"execution_horizon": "8"})),
        made_of(Run("goal-near", randomise=True)),
        made_of(Run("goal-near", backend="virtual")),
        made_of(Run("goal-near", policy="expert")),
        made_of(Run("goal-far")),
    ]
    elsewhere = tmp_path / "elsewhere" / "other.safetensors"
    elsewhere.parent.mkdir()
    shutil.copy(checkpoint, elsewhere)
    assert key(spec(run, Pilots(str(elsewhere), tmp_path), "op3", 0, None, None)) == before  # the same bytes
    checkpoint.write_bytes(checkpoint.read_bytes()[:-4] + b"\0\0\0\1")
    assert len({before, *others, made_of(run)}) == 8


def test_a_network_of_latents_wants_the_latents_first(tmp_path: Path) -> None:
    run, pilots = Run("survive", network=Network("z", "--mask causal", latents=True)), Pilots("diffusion", tmp_path)
    latents, command = tmp_path / "networks" / "latents" / "latent.safetensors", pilots.training(run)
    last = f"`servoid train diffusion --data runs/walks --out {tmp_path}/networks/z --mask causal --latent {latents}`"
    first = f"servoid train latent --data runs/walks --out {latents.parent}"
    assert command == f"`{first}`, then {last}"
    newest(latents.parent, 0.5)
    latents.touch()  # the best so far, of a training that goes on
    assert pilots.training(run) == f"`{first}`, then {last}"
    newest(latents.parent, None)
    assert pilots.training(run) == f"`{first} --no-resume`, then {last}"
    newest(latents.parent, 1.0)
    assert pilots.training(run) == last


def test_a_network_that_is_not_there_yet_is_a_command_to_train_it(tmp_path: Path) -> None:
    pilots = Pilots("diffusion", tmp_path)
    run = Run("goal-near", network=Network("full", "--width 128 --horizon 24"))
    train = f"servoid train diffusion --data runs/walks --out {tmp_path}/networks/full --width 128 --horizon 24"
    assert pilots.training(run) == f"`{train}`"
    path = tmp_path / "networks" / "full" / "best.safetensors"
    newest(path.parent, 1.0)
    shutil.copy(resolve("diffusion"), path)
    assert pilots.training(run) is None
    assert str(path.resolve()) in Path(pilots.name(run)).read_text()
    other = replace(run, network=Network("full", "--width 128 --horizon 24 --near-actions 16"))
    with pytest.raises(ConfigError, match="trained with --near-actions 8, and this row is of 16"):
        pilots.name(other)


def test_of_a_network_that_was_trained_by_steps_the_minutes_do_not_matter(tmp_path: Path) -> None:
    run = Run("goal-near", network=Network("full", "--width 128 --horizon 24 --steps 9"))
    head, tensors = read(resolve("diffusion"))
    for steps in (9, 8):
        folder = tmp_path / str(steps) / "networks" / "full"
        newest(folder, 1.0)
        training = {**head["training"], "steps": steps, "minutes": 5.0}
        write(folder / "best.safetensors", tensors, {**head, "training": training})
    assert Pilots("diffusion", tmp_path / "9").name(run)
    with pytest.raises(ConfigError, match="trained with --steps 8, and this row is of 9"):
        Pilots("diffusion", tmp_path / "8").name(run)


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (0.42, r"last\.safetensors: 42\.0% of its training are done: go on: `servoid train .*--horizon 24`"),
        (None, r"last\.safetensors does not say .* train anew: `servoid train .*--horizon 24 --no-resume`"),
    ],
)
def test_a_half_trained_network_fills_no_row(tmp_path: Path, share: float | None, told: str) -> None:
    """Its best so far is there from the first evaluation."""
    run = Run("goal-near", network=Network("full", "--width 128 --horizon 24"))
    newest(tmp_path / "networks" / "full", share)
    shutil.copy(resolve("diffusion"), tmp_path / "networks" / "full" / "best.safetensors")
    pilots = Pilots("diffusion", tmp_path)
    with pytest.raises(ConfigError, match=told):
        pilots.name(run)
    if share is None:
        (tmp_path / "networks" / "full" / "last.safetensors").unlink()
        with pytest.raises(ConfigError, match=told):
            pilots.fingerprint(run)


def test_variants_of_the_planner_are_files_that_the_policy_is_made_from(tmp_path: Path) -> None:
    from servoid.policy.diffusion.settings import load_settings

    pilots = Pilots("diffusion", tmp_path)
    assert load_settings(pilots.name(Run("goal"))).execution_horizon == load_settings().execution_horizon
    assert pilots.name(Run("goal", policy="expert")) == "expert"
    written = load_settings(pilots.name(Run("goal", plan={"execution_horizon": "8", "guidance.clip": "3"})))
    assert (written.execution_horizon, written.guidance.clip) == (8, 3.0)
    assert written.steps == load_settings().steps
    with pytest.raises(ConfigError, match="replann"):
        pilots.name(Run("goal", plan={"replann": "8"}))
