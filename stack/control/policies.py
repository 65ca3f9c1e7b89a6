"""Policies by name, imported when they are asked for; or from a file of one's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.control import Policy
from servoid.hw.contracts.task import Task
from servoid.hw.robot.description import Robot

if TYPE_CHECKING:
    from servoid.policy.diffusion.settings import DiffusionSettings

Maker = Callable[[str, Robot, Task, bool], Policy]


def _diffusion(source: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    from servoid.stack.control.diffusion import diffusion_policy

    cost = task.cost if task.guides else None
    return diffusion_policy(robot, _planner(source), cost, process=realtime)


def _planner(source: str) -> DiffusionSettings:
    """Settings of a diffusion policy. Raises ConfigError."""
    from servoid.policy.diffusion.settings import load_settings

    trained = source.endswith(".safetensors")
    return replace(load_settings(), checkpoint=source) if trained else load_settings(source)


def _expert(source: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    from servoid.stack.control.tracker import ExpertPolicy

    policy: Policy = ExpertPolicy(robot, source)
    return policy


def _gait(source: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    from servoid.stack.control.gait import GaitPolicy

    policy: Policy = GaitPolicy(robot)
    return policy


POLICIES: dict[str, Maker] = {"diffusion": _diffusion, "expert": _expert, "gait": _gait}
_KINDS: dict[str, Maker] = {"diffusion": _diffusion, "tracker": _expert}  # of checkpoints


def check_policy(name: str) -> None:
    """Raises ConfigError, for an unknown name with the nearest one."""
    _maker(name)


def make_policy(name: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    """A policy for a robot and a task. Raises ConfigError for an unknown name, or for a checkpoint that does not fit.

    `name` is one of POLICIES, the .safetensors file of a diffusion model or a tracker, or a .yaml file of diffusion
    settings. With `realtime` a planner runs beside the loop; without, it answers at the tick that its plan is for.
    """
    return _maker(name)(name, robot, task, realtime)


def policy_fingerprint(name: str) -> dict[str, Any]:
    """Name of a policy and what it is made of, for the flight log: its checkpoint and that of odometry by their hashes,
    settings of the planner or of the gait. None for what it has not. Raises ConfigError."""
    from servoid.policy.checkpoint import resolve
    from servoid.policy.references.gait import load_gait
    from servoid.stack.log.provenance import described, sha256

    planner = _planner(name) if _maker(name) is _diffusion else None
    checkpoint = None if name == "gait" else resolve(name if planner is None else planner.checkpoint)
    return {
        "name": name,
        "checkpoint_sha256": None if checkpoint is None else sha256(checkpoint),
        "odometry_sha256": sha256(resolve("odometry")),
        "planner": None if planner is None else described(planner),
        "gait": described(load_gait()) if planner is None else None,
    }


def _maker(name: str) -> Maker:
    if name in POLICIES:
        return POLICIES[name]
    if name.endswith((".yaml", ".yml")):
        return _diffusion
    if name.endswith(".safetensors"):
        from servoid.policy.checkpoint import read_header

        kind = str(read_header(Path(name))["kind"])
        if kind not in _KINDS:
            raise ConfigError(f"{name}: a checkpoint of kind '{kind}' is no policy; there are {', '.join(_KINDS)}")
        return _KINDS[kind]
    raise ConfigError(f"unknown policy '{name}': {nearest(name, POLICIES)}")
