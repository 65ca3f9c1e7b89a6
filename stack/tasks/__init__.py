"""What the robot is asked to do. A task is a small class and a file of settings, `configs/tasks/<name>.yaml`."""

from __future__ import annotations

from hw.config import ConfigError, load_yaml, nearest, resolve
from hw.hal import Task
from hw.overrides import override
from hw.robot import Robot
from stack.tasks.base import BaseTask, Settings
from stack.tasks.goal import Goal
from stack.tasks.stand import Stand
from stack.tasks.walk import Walk

_TASKS: dict[str, type[BaseTask]] = {task.name: task for task in (Stand, Walk, Goal)}


def names() -> tuple[str, ...]:
    """Names of all tasks, in the order in which they are best tried."""
    return tuple(_TASKS)


def task_class(name: str) -> type[BaseTask]:
    """The class of a task. Raises ConfigError with the nearest name."""
    if name not in _TASKS:
        raise ConfigError(f"unknown task '{name}': {nearest(name, _TASKS)}")
    return _TASKS[name]


def load_settings(name: str, settings: dict[str, str] | None = None) -> Settings:
    """A task's settings from its file, overridden by text as given to `--set key=value`. Raises ConfigError."""
    cls = task_class(name)
    base = load_yaml(resolve("tasks", name), cls.settings_type)
    return override(base, cls.complete(settings or {}))


def load_task(
    name: str, settings: dict[str, str] | None = None, dt: float = 0.02, robot: Robot | None = None
) -> Task:
    """A task for one robot, to be `reset` before each episode. `dt` is the length of a control tick [s].

    Raises ConfigError for an unknown task or setting, a value that does not parse, or what `robot` cannot do.
    """
    task = task_class(name)(load_settings(name, settings), dt)
    task.name = name
    if robot is not None:
        task.check(robot)
    return task


__all__ = ["BaseTask", "Settings", "load_settings", "load_task", "names", "task_class"]
