"""The policies of an evaluation: the planner with the settings of each row, and what their episodes depend on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from hw.config import ConfigError
from tools.evaluate.cache import key
from tools.evaluate.rows import Run

if TYPE_CHECKING:
    from policy.diffusion.settings import DiffusionSettings

EXPERT = "expert"


class Pilots:
    """Makes the policies that runs name. Variants of the planner become files of settings in `folder`/policies."""

    def __init__(self, policy: str, folder: Path) -> None:
        """`policy` is the evaluated one, named as in `servoid run`. Raises ConfigError for an unknown one."""
        from stack.policies import check_policy

        check_policy(policy)
        self._policy, self._folder = policy, folder
        self._settings = _diffusion_settings(policy)

    def network(self, run: Run) -> Path | None:
        """Where the network of its own that a run needs is looked for."""
        return None if run.network is None else self._folder / "networks" / run.network.name / "best.safetensors"

    def training(self, run: Run, data: str = "runs/walks") -> str | None:
        """How the network that a run lacks is trained; None where nothing is lacking."""
        path = self.network(run)
        if run.network is None or path is None or path.is_file():
            return None
        if run.network.train is None:
            return f"`servoid train diffusion` cannot make it; put one at {path}"
        return f"`servoid train diffusion --data {data} --out {path.parent} {run.network.train}`"

    def name(self, run: Run) -> str:
        """The policy of a run, as `servoid run --policy` takes it. Raises ConfigError for settings that do not fit."""
        if run.policy == EXPERT:
            return EXPERT
        if not run.plan and run.network is None:
            return self._policy
        settings = self.settings(run)
        assert settings is not None  # `settings` refuses variants of other policies
        values = asdict(settings)
        path = self._folder / "policies" / f"{run.task}-{key(values)}.yaml"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be written ({error.strerror}): choose another place with --out"
            ) from None
        return str(path)

    def settings(self, run: Run) -> DiffusionSettings | None:
        """Settings of the planner of a run; None for another policy. Raises ConfigError for a variant of that."""
        from hw.overrides import override

        if run.policy == EXPERT:
            return None
        if self._settings is None:
            if run.plan or run.network is not None:
                raise ConfigError(f"policy '{self._policy}' has no such settings: this row is for diffusion models")
            return None
        base, path = self._settings, self.network(run)
        if path is not None:
            base = replace(base, checkpoint=str(path.resolve()))
        return override(base, dict(run.plan), "planner setting")

    def fingerprint(self, run: Run) -> dict[str, Any]:
        """Everything about the policy of a run that its episodes depend on: checkpoints by their hash."""
        from policy.checkpoint import resolve
        from policy.gait import load_gait
        from stack.policies import policy_fingerprint
        from stack.provenance import sha256

        settings = self.settings(run)
        odometry = {"odometry": sha256(resolve("odometry"))}
        if settings is None:
            name = EXPERT if run.policy == EXPERT else self._policy
            known = policy_fingerprint(name)
            return {**odometry, "checkpoint": known["checkpoint_sha256"], "gait": asdict(load_gait())}
        values = asdict(settings)
        return {**odometry, "settings": values | {"checkpoint": sha256(resolve(values["checkpoint"]))}}


def _diffusion_settings(policy: str) -> DiffusionSettings | None:
    """Settings of the diffusion policy of that name, its checkpoint as a whole path; None for another policy."""
    from policy.checkpoint import read_header, resolve
    from policy.diffusion.settings import load_settings

    if policy.endswith(".safetensors"):
        if read_header(Path(policy))["kind"] != "diffusion":
            return None
        settings = replace(load_settings(), checkpoint=policy)
    elif policy == "diffusion" or policy.endswith((".yaml", ".yml")):
        settings = load_settings(policy)
    else:
        return None
    return replace(settings, checkpoint=str(resolve(settings.checkpoint).resolve()))


def task_spec(run: Run, seconds: float | None) -> dict[str, Any]:
    """Everything about the task of a run that its episodes depend on, the code that judges them included.

    Raises ConfigError for an unknown task or setting.
    """
    import sys

    from policy.text import captions
    from stack import tasks
    from stack.provenance import described, sha256
    from stack.tasks import approach, guidance, measures

    task = tasks.task_class(run.task)
    own = [
        *(cls.__module__ for cls in task.__mro__ if cls.__module__.startswith("stack.")),
        *getattr(task, "helpers", ()),
    ]
    modules = [*(sys.modules[name] for name in own), approach, captions, guidance, measures]
    sources = {module.__name__: sha256(Path(str(module.__file__))) for module in modules}
    return {
        "task": run.task,
        "settings": described(tasks.load_settings(run.task, dict(run.set))),
        "seconds": seconds,
        "sources": sources,
    }


def spec(
    run: Run, pilots: Pilots, robot: str, seed: int, seconds: float | None, clips: str | None
) -> Mapping[str, Any]:
    """What the episodes of a run depend on: the same spec, the same episodes. Raises ConfigError."""
    from hw.robot import load_robot
    from stack.provenance import fingerprint, versions

    return {
        "task": task_spec(run, seconds),
        "policy": pilots.fingerprint(run),
        "robot": fingerprint(load_robot(robot)),
        "backend": run.backend,
        "randomise": run.randomise,
        "seed": seed,
        "clips": clips,
        "versions": versions(),
    }
