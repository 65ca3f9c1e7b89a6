"""Policies by name, imported when they are asked for."""

from __future__ import annotations

from importlib import import_module

from hw.config import ConfigError, nearest
from hw.hal import Policy, Task
from hw.robot import Robot

POLICIES = {
    "diffusion": ("stack.diffusion_policy", "DiffusionPolicy"),
    "expert": ("stack.expert_policy", "ExpertPolicy"),
    "gait": ("stack.gait_policy", "GaitPolicy"),
}


def make_policy(name: str, robot: Robot, task: Task, realtime: bool) -> Policy:
    """A policy for a robot and a task. Raises ConfigError for an unknown name, or for a checkpoint that does not fit.

    With `realtime` a planner may run beside the loop; without, it answers at once, at the same tick.
    """
    if name not in POLICIES:
        raise ConfigError(f"unknown policy '{name}': {nearest(name, POLICIES)}")
    module, attribute = POLICIES[name]
    policy: Policy = getattr(import_module(module), attribute)(robot, task=task, realtime=realtime)
    return policy
