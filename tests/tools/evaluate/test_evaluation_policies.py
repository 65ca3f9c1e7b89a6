"""Variants of the planner, networks of rows' own, and what episodes depend on."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.policy.checkpoint import read, read_header, resolve, write
from servoid.tools.evaluate.cache import key
from servoid.tools.evaluate.policies import Policies, dependencies
from servoid.tools.evaluate.spec import Experiment, OwnNetwork

# As the shipped model was trained, by whose file a network of a row's own is tried here.
FULL = f"--minutes {read_header(resolve('diffusion'))['training']['minutes']:g} --width 128 --horizon 24"


def newest(folder: Path, share: float | None) -> None:
    """The newest network of a training that used so much of its budget; None: one that does not say."""
    head, tensors = read(resolve("diffusion"))
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "last.safetensors", tensors, {**head, "results": {} if share is None else {"share": share}})


def test_a_changed_checkpoint_setting_or_task_changes_what_episodes_depend_on(tmp_path: Path) -> None:
    checkpoint = tmp_path / "mine.safetensors"
    shutil.copy(resolve("diffusion"), checkpoint)

    def made_of(experiment: Experiment) -> str:
        return key(dependencies(experiment, Policies(str(checkpoint), tmp_path), "op3", 0, None, None))

    experiment = Experiment("goal-near")
    before = made_of(experiment)
    assert made_of(Experiment("goal-near", episodes=7)) == before  # more of the same
    others = [
        made_of(Experiment("goal-near", set={"radius": "0.09"})),
        made_of(Experiment("goal-near", plan={"execution_horizon": "8"})),
        made_of(Experiment("goal-near", randomise=True)),
        made_of(Experiment("goal-near", backend="virtual")),
        made_of(Experiment("goal-near", policy="expert")),
        made_of(Experiment("goal-far")),
    ]
    elsewhere = tmp_path / "elsewhere" / "other.safetensors"
    elsewhere.parent.mkdir()
    shutil.copy(checkpoint, elsewhere)
    assert (
        key(dependencies(experiment, Policies(str(elsewhere), tmp_path), "op3", 0, None, None)) == before
    )  # the same bytes
    checkpoint.write_bytes(checkpoint.read_bytes()[:-4] + b"\0\0\0\1")
    assert len({before, *others, made_of(experiment)}) == 8


def test_a_network_of_latents_wants_the_latents_first(tmp_path: Path) -> None:
    experiment, policies = (
        Experiment("survive", network=OwnNetwork("z", "--mask causal", latents=True)),
        Policies("diffusion", tmp_path),
    )
    latents, command = tmp_path / "networks" / "latents" / "latent.safetensors", policies.training(experiment)
    last = f"`servoid train diffusion --data runs/walks --out {tmp_path}/networks/z --mask causal --latent {latents}`"
    first = f"servoid train latent --data runs/walks --out {latents.parent}"
    assert command == f"`{first}`, then {last}"
    newest(latents.parent, 0.5)
    latents.touch()  # the best so far, of a training that goes on
    assert policies.training(experiment) == f"`{first}`, then {last}"
    newest(latents.parent, None)
    assert policies.training(experiment) == f"`{first} --no-resume`, then {last}"
    newest(latents.parent, 1.0)
    assert policies.training(experiment) == last


def test_a_task_policy_that_is_not_there_yet_is_a_command_to_train_it(tmp_path: Path) -> None:
    policies = Policies("diffusion", tmp_path)
    train = "--task speed --prior prior --config policy --rewards task=1 both=0"

    def experiment(name: str, rewards: dict[str, float], share: float) -> Experiment:
        path = tmp_path / "networks" / name / "policy.safetensors"
        path.parent.mkdir(parents=True)
        head, tensors = read(resolve("speed"))
        trained = {**head["training"], "rewards": {**head["training"]["rewards"], **rewards}}
        write(path, tensors, {**head, "training": trained, "results": {"share": share}})
        return Experiment("speed", network=OwnNetwork(name, train, policy=True))

    lacking = Experiment("speed", network=OwnNetwork("lacking", train, policy=True))
    assert policies.training(lacking) == f"`servoid train policy --out {tmp_path}/networks/lacking {train}`"
    ours = {"task": 1.0, "both": 0.0}
    with pytest.raises(ConfigError, match="trained with --rewards"):
        policies.name(experiment("other", {}, 1.0))
    with pytest.raises(ConfigError, match=r"only 50\.0% of its training"):
        policies.name(experiment("half", ours, 0.5))
    whole = experiment("whole", ours, 1.0)
    assert policies.training(whole) is None
    assert policies.name(whole) == str((tmp_path / "networks" / "whole" / "policy.safetensors").resolve())
    assert policies.fingerprint(whole)["checkpoint_sha256"]
    with pytest.raises(ConfigError, match="for diffusion models"):
        policies.name(replace(whole, plan={"delay": "2"}))


def test_a_network_that_is_not_there_yet_is_a_command_to_train_it(tmp_path: Path) -> None:
    policies = Policies("diffusion", tmp_path)
    experiment = Experiment("goal-near", network=OwnNetwork("full", FULL))
    train = f"servoid train diffusion --data runs/walks --out {tmp_path}/networks/full {FULL}"
    assert policies.training(experiment) == f"`{train}`"
    path = tmp_path / "networks" / "full" / "best.safetensors"
    newest(path.parent, 1.0)
    shutil.copy(resolve("diffusion"), path)
    assert policies.training(experiment) is None
    assert str(path.resolve()) in Path(policies.name(experiment)).read_text()
    other = replace(experiment, network=OwnNetwork("full", f"{FULL} --near-actions 16"))
    with pytest.raises(ConfigError, match="trained with --near-actions 8, but this row needs 16"):
        policies.name(other)


def test_of_a_network_that_was_trained_by_steps_the_minutes_do_not_matter(tmp_path: Path) -> None:
    experiment = Experiment("goal-near", network=OwnNetwork("full", "--width 128 --horizon 24 --steps 9"))
    head, tensors = read(resolve("diffusion"))
    for steps in (9, 8):
        folder = tmp_path / str(steps) / "networks" / "full"
        newest(folder, 1.0)
        training = {**head["training"], "steps": steps, "minutes": 5.0}
        write(folder / "best.safetensors", tensors, {**head, "training": training})
    assert Policies("diffusion", tmp_path / "9").name(experiment)
    with pytest.raises(ConfigError, match="trained with --steps 8, but this row needs 9"):
        Policies("diffusion", tmp_path / "8").name(experiment)


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (0.42, r"last\.safetensors: only 42\.0% of its training is done; continue it: `servoid train .*--horizon 24`"),
        (None, r"last\.safetensors: does not record .* train it again: `servoid train .*--horizon 24 --no-resume`"),
    ],
)
def test_a_half_trained_network_fills_no_row(tmp_path: Path, share: float | None, told: str) -> None:
    """Its best so far is there from the first evaluation."""
    experiment = Experiment("goal-near", network=OwnNetwork("full", FULL))
    newest(tmp_path / "networks" / "full", share)
    shutil.copy(resolve("diffusion"), tmp_path / "networks" / "full" / "best.safetensors")
    policies = Policies("diffusion", tmp_path)
    with pytest.raises(ConfigError, match=told):
        policies.name(experiment)
    if share is None:
        (tmp_path / "networks" / "full" / "last.safetensors").unlink()
        with pytest.raises(ConfigError, match=told):
            policies.fingerprint(experiment)


def test_variants_of_the_planner_are_files_that_the_policy_is_made_from(tmp_path: Path) -> None:
    from servoid.policy.diffusion.settings import load_settings

    policies = Policies("diffusion", tmp_path)
    assert load_settings(policies.name(Experiment("goal"))).execution_horizon == load_settings().execution_horizon
    assert policies.name(Experiment("goal", policy="expert")) == "expert"
    written = load_settings(policies.name(Experiment("goal", plan={"execution_horizon": "8", "guidance.clip": "3"})))
    assert (written.execution_horizon, written.guidance.clip) == (8, 3.0)
    assert written.steps == load_settings().steps
    with pytest.raises(ConfigError, match="replann"):
        policies.name(Experiment("goal", plan={"replann": "8"}))
