"""The policies of an evaluation: the planner with the settings of each row, and what their episodes depend on."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from servoid.hw.config import ConfigError
from servoid.tools.evaluate.cache import depends_on, key
from servoid.tools.evaluate.spec import Experiment, OwnNetwork

if TYPE_CHECKING:
    from servoid.policy.diffusion.settings import DiffusionSettings

_DATA = "runs/walks"  # the dataset that the README shows how to record
_LAST = "last.safetensors"  # the newest network of a training run, beside its best
_WHATEVER = (
    "evaluate_every",
    "seed",
    "survival_seconds",
    "survival_worlds",
    "licence",
)  # of training: what does not make another kind of network


class Policies:
    """Makes the policies of experiments. Settings of the planner become files in `folder`/policies, as they are now."""

    def __init__(self, policy: str, folder: Path) -> None:
        """`policy` is the evaluated one, named as in `servoid run`. Raises ConfigError for an unknown one."""
        from servoid.stack.control.policies import check_policy

        check_policy(policy)
        self._policy, self._folder = policy, folder
        self._settings = _diffusion_settings(policy)

    def network(self, experiment: Experiment) -> Path | None:
        """Where the network of its own that an experiment needs is looked for."""
        own = experiment.network
        file = "policy.safetensors" if own is not None and own.policy else "best.safetensors"
        return None if own is None else self._folder / "networks" / own.name / file

    def training(self, experiment: Experiment) -> str | None:
        """How the network that an experiment lacks is trained; None where nothing is lacking. Raises ConfigError."""
        path = self.network(experiment)
        if experiment.network is None or path is None or path.is_file():
            return None
        return self._command(experiment.network, path)

    def _command(self, network: OwnNetwork, path: Path) -> str:
        """What trains a network and, before it, its latents; given again, it goes on with what was begun."""
        if network.policy:
            return f"`servoid train policy --out {path.parent} {network.train}`"
        options, before = network.train + _anew(path), ""
        if network.latents:
            latents = self._folder / "networks" / "latents" / "latent.safetensors"
            options += f" --latent {latents}"
            if _share(latents) != 1.0:
                before = f"`servoid train latent --data {_DATA} --out {latents.parent}{_anew(latents)}`, then "
        return f"{before}`servoid train diffusion --data {_DATA} --out {path.parent} {options}`"

    def name(self, experiment: Experiment) -> str:
        """An experiment's policy, as `servoid run --policy` takes it. Raises ConfigError where settings do not fit."""
        settings = self.settings(experiment)
        if settings is None:
            return self._other(experiment)
        values = asdict(settings)
        task = re.sub(r"\W+", "-", experiment.task)  # which may be a class in a file
        path = self._folder / "policies" / f"{task}-{key(values)}.yaml"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be written ({error.strerror}): choose another place with --out"
            ) from None
        return str(path)

    def settings(self, experiment: Experiment) -> DiffusionSettings | None:
        """Settings of an experiment's planner; None for another policy. Raises ConfigError for a variant of that."""
        from servoid.hw.overrides import override

        own, network, path = experiment.policy, experiment.network, self.network(experiment)
        learned = network is not None and network.policy
        if network is not None and path is not None:
            _check_training(path, network)
            self._check_whole(path, network)
        base = None if learned else self._settings if own is None else _diffusion_settings(own)
        if base is None:
            if experiment.plan or (network is not None and not learned):
                raise ConfigError(
                    f"policy '{own or self._policy}' has no such settings: this row is for diffusion models"
                )
            return None
        if path is not None:
            base = replace(base, checkpoint=str(path.resolve()))
        return override(base, dict(experiment.plan), "planner setting")

    def _other(self, experiment: Experiment) -> str:
        """The policy of an experiment that is for no diffusion model, as `servoid run --policy` takes it."""
        path = self.network(experiment)
        return experiment.policy or self._policy if path is None else str(path.resolve())

    def _check_whole(self, path: Path, network: OwnNetwork) -> None:
        """Raise ConfigError for a network whose training was not finished: the best so far is there from early on."""
        last = path if network.policy else path.with_name(_LAST)
        share = _share(path, last)
        if share is None:
            raise ConfigError(
                f"{last}: does not record that the training finished; train it again: {self._command(network, path)}"
            )
        if share < 1.0:
            raise ConfigError(
                f"{last}: only {share:.1%} of its training is done; continue it: {self._command(network, path)}"
            )

    def fingerprint(self, experiment: Experiment) -> dict[str, Any]:
        """Everything about the policy of an experiment that its episodes depend on: checkpoints by their hash."""
        from servoid.policy.checkpoint import resolve
        from servoid.stack.control.policies import policy_fingerprint
        from servoid.stack.log.provenance import sha256

        settings = self.settings(experiment)
        if settings is None:
            known = policy_fingerprint(self._other(experiment))
            return {name: value for name, value in known.items() if name != "name" or not known["checkpoint_sha256"]}
        values = asdict(settings)
        checkpoint = {"checkpoint": sha256(resolve(values["checkpoint"]))}
        return {"odometry": sha256(resolve("odometry")), "settings": values | checkpoint}


def _share(path: Path, last: Path | None = None) -> float | None:
    """How much of its budget a training has used, 0 to 1, by the newest network, which is beside its best, `path`; None
    where there is none, or an old one that does not say."""
    from servoid.policy.checkpoint import read_header

    last = last or path.with_name(_LAST)
    return read_header(last)["results"].get("share") if last.is_file() else None


def _anew(path: Path) -> str:
    """What a command must say besides where it cannot go on with what is there."""
    return " --no-resume" if path.is_file() and _share(path) is None else ""


@cache
def _check_training(path: Path, network: OwnNetwork) -> None:
    """Raise ConfigError for a network that was trained with other options than its row says."""
    from servoid.policy.checkpoint import read_header

    asked = _asked(network)
    header = read_header(path)
    given = {**({} if network.policy else header.get("config", {})), **header.get("training", {})}
    if "committed" in given:  # in headers of before it was called inference_delay
        given["inference_delay"] = given.pop("committed")
    whatever = (
        {*_WHATEVER, "minutes"} if asked.get("steps") else _WHATEVER
    )  # then they say when to evaluate, and no more
    for name, value in given.items():
        if name in asked and name not in whatever and asked[name] != value:
            option = "--" + name.replace("_", "-")
            raise ConfigError(
                f"{path}: trained with {option} {value}, but this row needs {asked[name]}: train it again"
            )


def _asked(network: OwnNetwork) -> dict[str, Any]:
    """The settings of a network's training, as its row gives them."""
    from servoid.tools.learn.flags import plain, read_settings
    from servoid.tools.learn.prior_settings import PolicyTraining
    from servoid.tools.learn.settings import DiffusionTraining
    from servoid.tools.learn.trainers import diffusion, policy

    parser, options = argparse.ArgumentParser(), ["--out", "", *shlex.split(network.train)]
    if network.policy:
        policy.add_arguments(parser)
        return plain(read_settings(parser.parse_args(options), PolicyTraining()))
    diffusion.add_arguments(parser)
    return plain(read_settings(parser.parse_args(["--data", "", *options]), DiffusionTraining()))


def _diffusion_settings(policy: str) -> DiffusionSettings | None:
    """Settings of the diffusion policy of that name, its checkpoint as a whole path; None for another policy."""
    from servoid.policy.checkpoint import read_header, resolve
    from servoid.policy.diffusion.settings import load_settings
    from servoid.stack.control.policies import is_diffusion

    if policy.endswith(".safetensors"):
        if read_header(Path(policy))["kind"] != "diffusion":
            return None
        settings = replace(load_settings(), checkpoint=policy)
    elif is_diffusion(policy):
        settings = load_settings(policy)
    else:
        return None
    return replace(settings, checkpoint=str(resolve(settings.checkpoint).resolve()))


def dependencies(
    experiment: Experiment, policies: Policies, robot: str, seed: int, seconds: float | None, clips: str | None
) -> Mapping[str, Any]:
    """What the episodes of an experiment depend on. Raises ConfigError."""
    from servoid.stack.runtime.run import RunSettings

    settings = RunSettings(
        task=experiment.task,
        backend=experiment.backend,
        robot=robot,
        randomise=experiment.randomise,
        recover=experiment.recover,
        seconds=seconds,
        seed=seed,
        set=dict(experiment.set),
    )
    return depends_on(settings, policies.fingerprint(experiment)) | {"clips": clips}
