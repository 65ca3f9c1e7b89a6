"""Policies by name, imported when they are asked for; of a checkpoint or a file of settings; or a user's own.

Those are found like tasks: by an entry point of the group `servoid.policies`, or as `FILE.py:Class`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import yaml

from servoid.hw.config import ConfigError, available, nearest
from servoid.hw.config import resolve as find
from servoid.hw.contracts.control import Policy
from servoid.hw.contracts.task import Task
from servoid.hw.plugins import Plugin, Portable, installed, load_plugin
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.policy.diffusion.settings import DiffusionSettings
from servoid.stack.control.base import BasePolicy

if TYPE_CHECKING:
    from servoid.policy.references.gait import GaitSettings
    from servoid.stack.control.closed_loop import ClosedLoopSettings
    from servoid.stack.control.diffusion import DiffusionPolicy

PlannerSettings: TypeAlias = "DiffusionSettings | ClosedLoopSettings"  # of a policy that plans
Maker = Callable[[str, Robot, Task, bool, tuple[int, ...]], Policy]
GROUP = "servoid.policies"  # of entry points


def _diffusion(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    return _planned(_planner(source), robot, task, realtime, shape)


def _planned(
    planner: DiffusionSettings, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]
) -> DiffusionPolicy:
    from servoid.stack.control.diffusion import diffusion_policy

    cost: Any = Portable(task.objective) if realtime else task.objective
    return diffusion_policy(robot, planner, cost, process=realtime, shape=shape)


def _planner(source: str) -> DiffusionSettings:
    """Settings of a diffusion policy. Raises ConfigError."""
    from servoid.policy.diffusion.settings import load_settings

    trained = source.endswith(".safetensors")
    return replace(load_settings(), checkpoint=source) if trained else load_settings(source)


def _expert(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.stack.control.tracker import ExpertPolicy

    policy: Policy = ExpertPolicy(robot, source, shape)
    return policy


def _carrier(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.stack.control.carrier import Carrier

    policy: Policy = Carrier(robot, shape)
    return policy


def _gait(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.stack.control.gait import GaitPolicy

    policy: Policy = GaitPolicy(robot, shape, _gait_settings(source, robot))
    return policy


def _gait_settings(source: str, robot: Robot) -> GaitSettings:
    """Raises ConfigError."""
    from servoid.policy.references.gait import gait_of, load_gait

    return gait_of(robot) if source == "gait" else load_gait(source)


def _clip(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.policy.motion.clip import load
    from servoid.stack.control.clip import ClipPolicy

    clip = load(Path(source), robot)
    if clip.about.begins != "upright":
        raise ConfigError(f"clip '{clip.name}' begins {clip.about.begins}, and a run begins standing")
    policy: Policy = ClipPolicy(robot, clip, shape)
    return policy


def _task_policy(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.policy.checkpoint import resolve
    from servoid.policy.priors.task_policy import TaskPolicy

    policy: Policy = TaskPolicy(robot, resolve(source, robot), shape)
    return policy


def _closed_loop(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    return _looped(_loop_settings(source), robot, realtime, shape)


def _looped(settings: ClosedLoopSettings, robot: Robot, realtime: bool, shape: tuple[int, ...]) -> Policy:
    from servoid.stack.control.closed_loop import closed_loop_policy

    policy: Policy = closed_loop_policy(robot, settings, process=realtime, shape=shape)
    return policy


def _loop_settings(source: str) -> ClosedLoopSettings:
    """Settings of planning in a closed loop. Raises ConfigError."""
    from servoid.stack.control.closed_loop import load_settings

    trained = source.endswith(".safetensors")
    return replace(load_settings(), checkpoint=source) if trained else load_settings(source)


# Policies of Servoid's own; besides there are the planner's other settings in configs/policies/.
POLICIES: dict[str, Maker] = {
    "carrier": _carrier,
    "carry": _task_policy,
    "diffusion": _diffusion,
    "dodgeball": _task_policy,
    "expert": _expert,
    "fast": _expert,
    "gait": _gait,
    "hands-on-head": _task_policy,
    "high-knees": _task_policy,
    "location": _task_policy,
    "looking-around": _task_policy,
    "speed": _task_policy,
    "steering": _task_policy,
    "zombie": _task_policy,
    "zombie-wide": _task_policy,
}
_KINDS: dict[str, Maker] = {  # of .safetensors files
    "diffusion": _diffusion,
    "tracker": _expert,
    "clip": _clip,
    "planner": _closed_loop,
    "task_policy": _task_policy,
}


def _own(source: str, robot: Robot, task: Task, realtime: bool, shape: tuple[int, ...]) -> Policy:
    """A policy of a user's own. Raises ConfigError with file and line where it cannot be made so."""
    plugin = _plugin(source)
    assert plugin is not None
    try:
        policy: Policy = plugin.cls(robot, shape) if shape else plugin.cls(robot)
    except TypeError as error:
        raise plugin.error(f"{plugin.cls.__name__}(robot{', shape' if shape else ''}): {error}") from error
    return policy


def _plugin(name: str) -> Plugin | None:
    return load_plugin(name, GROUP, BasePolicy, "policy")


def names() -> tuple[str, ...]:
    """Names of all policies: Servoid's own, its other settings of the planner, and those of installed packages."""
    return tuple(dict.fromkeys((*POLICIES, *available("policies"), *installed(GROUP))))


def check_policy(name: str) -> None:
    """Raises ConfigError, for an unknown name with the nearest one."""
    _maker(name)


def is_diffusion(name: str) -> bool:
    """Whether a name or a file is of the diffusion policy. Raises ConfigError for an unknown one."""
    return _maker(name) is _diffusion


def make_policy(
    name: str,
    robot: Robot,
    task: Task,
    realtime: bool,
    shape: tuple[int, ...] = (),
    planner: PlannerSettings | None = None,
) -> Policy:
    """A policy for a robot and a task, or for worlds of any leading `shape`.

    Raises ConfigError for an unknown name, or for a checkpoint that does not fit. `name` is one of `names`, the
    .safetensors file of a diffusion model, a tracker, a clip, a planner or a task policy, a .yaml file of settings of
    one that plans, or `FILE.py:Class`. With `realtime` a planner runs beside the loop; without, it answers at the tick
    that its plan is for. `planner` holds the settings of a recorded policy that plans: no file is read for them then.
    """
    if isinstance(planner, DiffusionSettings):
        return _planned(planner, robot, task, realtime, shape)
    if planner is not None:
        return _looped(planner, robot, realtime, shape)
    return _maker(name)(name, robot, task, realtime, shape)


def skills_known(name: str, robot: Robot, planner: PlannerSettings | None = None) -> tuple[str, ...]:
    """Names of the skills that a policy performs by itself, when it is told them: those that its network learned.

    `planner` are settings as in `make_policy`. Raises ConfigError.
    """
    from servoid.policy.checkpoint import read_header, resolve

    if planner is None and _maker(name) is not _diffusion:
        return ()
    settings = planner or _planner(name)
    if not isinstance(settings, DiffusionSettings):
        return ()
    return tuple(read_header(resolve(settings.checkpoint, robot)).get("skills", {}))


def sentences_known(name: str, robot: Robot, planner: PlannerSettings | None = None) -> tuple[tuple[str, ...], float]:
    """Sentences that the planner of a closed loop was trained with, where it reads others by the nearest of them, and
    how long from a request to the end of its plan [s]; none of another policy. `planner` are settings as in
    `make_policy`. Raises ConfigError."""
    from servoid.policy.checkpoint import read_header, resolve
    from servoid.policy.diffusion.prefix.frames import RATE

    if isinstance(planner, DiffusionSettings) or (planner is None and _maker(name) is not _closed_loop):
        return (), 0.0
    settings = planner or _loop_settings(name)
    head = read_header(resolve(settings.checkpoint, robot))
    if not settings.text_nearest or "sentences" not in head:
        return (), 0.0
    return tuple(head["sentences"]), head["config"]["frames"] / RATE + settings.delay * robot.dt


def policy_fingerprint(name: str, robot: Robot | None = None) -> dict[str, Any]:
    """Name of a policy and what it is made of, for the flight log: its checkpoint and that of odometry by their hashes,
    settings of the planner, of a closed loop with its tracker or of the robot's gait, and the file of a user's own.
    None for what it has not.

    `robot` is by default the shipped one. Raises ConfigError.
    """
    from servoid.policy.checkpoint import resolve
    from servoid.policy.tracker.network import gait_of_tracker
    from servoid.stack.log.provenance import described, sha256

    robot = robot or shipped_robot()
    maker = _maker(name)
    planner = _planner(name) if maker is _diffusion else None
    own = _plugin(name) if maker is _own else None
    loop = _loop_settings(name) if maker is _closed_loop else None
    named = name if maker in (_expert, _clip, _task_policy) else None
    if (planned := planner or loop) is not None:
        named = planned.checkpoint
    checkpoint = None if named is None else resolve(named, robot)
    gait = _gait_settings(name, robot) if maker is _gait else None
    if maker is _expert and checkpoint is not None:
        gait = gait_of_tracker(checkpoint, robot)
    return {
        "name": name,
        "checkpoint_sha256": None if checkpoint is None else sha256(checkpoint),
        "odometry_sha256": sha256(resolve("odometry", robot)),
        "planner": None if planner is None else described(planner),
        "closed_loop": None if loop is None else described(loop),
        "tracker_sha256": sha256(resolve(loop.tracker, robot)) if loop is not None and loop.tracker else None,
        "gait": None if gait is None else described(gait),
        "source": None if own is None else own.source(),
    }


def _of_settings(name: str) -> Maker:
    """Who takes a file of settings: planning in a closed loop, which names a tracker, be it none; a gait, which has
    feet that carry both; or the diffusion policy."""
    path = find("policies", name)
    try:
        keys = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else None
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        keys = None  # whoever loads it says what is wrong
    if isinstance(keys, dict) and "tracker" in keys:
        return _closed_loop
    return _gait if isinstance(keys, dict) and "double_support" in keys else _diffusion


def _maker(name: str) -> Maker:
    if name in POLICIES:
        return POLICIES[name]
    if name.endswith((".yaml", ".yml")) or name in available("policies"):
        return _of_settings(name)
    if name.endswith(".safetensors"):
        from servoid.policy.checkpoint import read_header

        kind = str(read_header(Path(name))["kind"])
        if kind not in _KINDS:
            raise ConfigError(f"{name}: a checkpoint of kind '{kind}' is not a policy; known: {', '.join(_KINDS)}")
        return _KINDS[kind]
    if _plugin(name) is not None:
        return _own
    file = Path(name)
    if file.suffix or file.name != name:
        what = "no file of a policy" if file.exists() else "no such file"
        raise ConfigError(
            f"{name}: {what}: give a checkpoint or a clip (.safetensors), settings of the diffusion policy (.yaml), "
            f"your own FILE.py:Class, or a name: {', '.join(names())}"
        )
    raise ConfigError(f"unknown policy '{name}': {nearest(name, names())}")
