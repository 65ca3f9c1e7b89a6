"""What the robot is asked to do. A task is a small class and a file of settings, `configs/tasks/<name>.yaml`."""

from __future__ import annotations

from servoid.hw.config import ConfigError, load_yaml, nearest, resolve
from servoid.hw.contracts.task import Task
from servoid.hw.overrides import override
from servoid.hw.robot.description import Robot
from servoid.stack.tasks.base import BaseTask, Settings
from servoid.stack.tasks.cross import Cross
from servoid.stack.tasks.forest import Forest
from servoid.stack.tasks.goal import Goal
from servoid.stack.tasks.inbetween import Inbetween
from servoid.stack.tasks.obstacle import Obstacle
from servoid.stack.tasks.path import Path
from servoid.stack.tasks.stand import Stand
from servoid.stack.tasks.steer import Steer
from servoid.stack.tasks.survive import Survive
from servoid.stack.tasks.text import Text
from servoid.stack.tasks.velocity import Velocity
from servoid.stack.tasks.walk import Walk

_CLASSES: tuple[type[BaseTask], ...] = (
    Stand, Walk, Goal, Velocity, Path, Forest, Obstacle, Cross, Inbetween, Survive, Text, Steer,
)  # fmt: skip
_TASKS: dict[str, tuple[type[BaseTask], str]] = {
    **{task.name: (task, task.description) for task in _CLASSES},
    # The same classes by other files of settings.
    "goal-near": (Goal, "walk to a near point"),
    "goal-far": (Goal, "walk to a far point"),
    "perturb": (Walk, "walk ahead while being pushed once a second"),
}


def names() -> tuple[str, ...]:
    """Names of all tasks, in the order in which they are best tried."""
    return tuple(_TASKS)


def task_class(name: str) -> type[BaseTask]:
    """The class of a task. Raises ConfigError with the nearest name."""
    if name not in _TASKS:
        raise ConfigError(f"unknown task '{name}': {nearest(name, _TASKS)}")
    return _TASKS[name][0]


def description(name: str) -> str:
    """What a task asks, in a few words. Raises ConfigError with the nearest name."""
    task_class(name)
    return _TASKS[name][1]


def load_settings(name: str, settings: dict[str, str] | None = None) -> Settings:
    """A task's settings from its file, overridden by text as given to `--set key=value`. Raises ConfigError."""
    cls = task_class(name)
    base = load_yaml(resolve("tasks", name), cls.settings_type)
    return override(base, cls.complete(settings or {}))


def load_task(name: str, settings: dict[str, str] | None = None, dt: float = 0.02, robot: Robot | None = None) -> Task:
    """A task for one robot, to be `reset` before each episode. `dt` is the length of a control tick [s].

    Raises ConfigError for an unknown task or setting, a value that does not parse, or what `robot` cannot do.
    """
    task = task_class(name)(load_settings(name, settings), dt)
    task.name = name
    if robot is not None:
        task.check(robot)
    return task


__all__ = ["BaseTask", "Settings", "description", "load_settings", "load_task", "names", "task_class"]
