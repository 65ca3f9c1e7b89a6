"""Tasks that policies learn, by name; or a user's own, `FILE.py:Class`."""

from __future__ import annotations

from collections.abc import Mapping

from servoid.hw.config import ConfigError, nearest
from servoid.hw.plugins import load_plugin
from servoid.hw.robot.description import Robot
from servoid.stack.tasks.learned.base import LearnedTask, TaskState
from servoid.stack.tasks.learned.carry import Carry
from servoid.stack.tasks.learned.clip import PREFIX, ImitatedClip
from servoid.stack.tasks.learned.dodgeball import Dodgeball
from servoid.stack.tasks.learned.get_up import GettingUp, GettingUpByClips
from servoid.stack.tasks.learned.location import TargetLocation
from servoid.stack.tasks.learned.speed import TargetSpeed
from servoid.stack.tasks.learned.steering import TargetSteering

GROUP = "servoid.learned_tasks"  # of entry points
LEARNED_TASKS: Mapping[str, type[LearnedTask]] = {
    cls.name: cls
    for cls in (TargetSpeed, TargetSteering, TargetLocation, Dodgeball, Carry, GettingUp, GettingUpByClips)
}


def load_learned_task(name: str, robot: Robot) -> LearnedTask:
    """A task by its name, `clip:NAME` by that of a clip, or a user's own. Raises ConfigError with the nearest name, or
    what a class lacks."""
    if name.startswith(PREFIX):
        return ImitatedClip(robot, name.removeprefix(PREFIX))
    if name in LEARNED_TASKS:
        return LEARNED_TASKS[name](robot)
    plugin = load_plugin(name, GROUP, LearnedTask, "task")
    if plugin is None:
        raise ConfigError(f"unknown task '{name}': {nearest(name, LEARNED_TASKS)}")
    try:
        task: LearnedTask = plugin.cls(robot)
    except TypeError as error:  # one without a reward, say
        raise plugin.error(f"{plugin.cls.__name__}: {error}") from error
    return task


__all__ = ["LEARNED_TASKS", "LearnedTask", "TaskState", "load_learned_task"]
