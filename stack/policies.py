"""Policies by name, imported when they are asked for."""

from __future__ import annotations

from collections.abc import Callable

from hw.config import ConfigError, nearest
from hw.hal import Policy, Task
from hw.robot import Robot


def _diffusion(robot: Robot, task: Task, realtime: bool) -> Policy:
    from stack.diffusion_policy import diffusion_policy

    return diffusion_policy(robot, cost=task.cost, process=realtime)


def _expert(robot: Robot, task: Task, realtime: bool) -> Policy:
    from stack.expert_policy import ExpertPolicy

    policy: Policy = ExpertPolicy(robot, task=task, realtime=realtime)
    return policy


def _gait(robot: Robot, task: Task, realtime: bool) -> Policy:
    from stack.gait_policy import GaitPolicy

    policy: Policy = GaitPolicy(robot, task=task, realtime=realtime)
    return policy


POLICIES: dict[str, Callable[[Robot, Task, bool], Policy]] = {
    "diffusion": _diffusion,
    "expert": _expert,
    "gait": _gait,
}


def check_policy(name: str) -> None:
    """Raises ConfigError with the nearest name."""
    if name not in POLICIES:
        raise ConfigError(f"unknown policy '{name}': {nearest(name, POLICIES)}")


def make_policy(name: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    """A policy for a robot and a task. Raises ConfigError for an unknown name, or for a checkpoint that does not fit.

    With `realtime` a planner runs beside the loop; without, it answers at the tick that its plan is for.
    """
    check_policy(name)
    return POLICIES[name](robot, task, realtime)


def policy_fingerprint(name: str) -> dict[str, str | None]:
    """Name of a policy and the hash of its checkpoint, where it has one, for the flight log."""
    from policy.checkpoint import resolve
    from stack.provenance import sha256

    checkpoint = None
    if name == "expert":
        checkpoint = resolve("expert")
    elif name == "diffusion":
        from policy.diffusion.settings import load_settings

        checkpoint = resolve(load_settings().checkpoint)
    return {"name": name, "checkpoint_sha256": None if checkpoint is None else sha256(checkpoint)}
