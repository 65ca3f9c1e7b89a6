"""One episode of an evaluation: what a rollout keeps of it, how the motion was made, and its path."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.tools.common.exit_codes import explain

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.policy.priors.score_matching.model import Style
    from servoid.stack.runtime.run import RunSettings
    from servoid.tools.evaluate.judge import Judged

_PRIOR, _STYLES = "prior", "styles"  # that tell the manner, and that of a style
PATH_STEP = 0.2  # s between the points of a path that is kept


@dataclass(frozen=True)
class EpisodeJob:
    """An episode to be done, by the numbers of its experiment and of itself."""

    experiment: int
    episode: int
    settings: RunSettings


@dataclass(frozen=True)
class EpisodeResult:
    """An episode's record, or why the experiment cannot be done."""

    job: EpisodeJob
    record: dict[str, Any]
    refused: str | None = None
    wall_seconds: float = 0.0


def do_episode(job: EpisodeJob, do: Callable[[RunSettings], dict[str, Any]] | None = None) -> EpisodeResult:
    """Do an episode with `do`, which is `record` where nothing else is said. One that cannot be done, for whatever
    reason, is an answer too: the other rows go on."""
    begun = time.monotonic()
    try:
        return EpisodeResult(job, (do or record)(job.settings), wall_seconds=time.monotonic() - begun)
    except Exception as error:
        if os.environ.get("SERVOID_DEBUG") == "1":
            traceback.print_exc()
        return EpisodeResult(job, {}, explain(error))


def record(settings: RunSettings) -> dict[str, Any]:
    """Do an episode and keep what any row could ask of it. Raises ConfigError."""
    from servoid.hw.robot.description import load_robot
    from servoid.stack.tasks.learned.run import LearnedRun
    from servoid.tools.common.motion_quality import quality
    from servoid.tools.evaluate.judge import judge

    judged = judge(settings)
    trace, assignment = judged.trace, judged.assignment
    limit = round(assignment.task.seconds / trace.dt)
    goal = assignment.episode.goal if trace.goal is None else trace.goal[-1]
    return {
        **judged.row,
        "ticks": min(judged.ground_truth.upright, limit),
        "manner": _manner(judged, settings) if isinstance(assignment.task, LearnedRun) else {},
        "motion": quality(judged.ground_truth.poses(), load_robot(settings.robot)),
        "path": _points(trace.displacement[:, :2], trace.dt),
        "goal": None if goal is None else np.round(goal, 3),
        "pillars": _still(trace),
        "spheres": _rolling(trace),
        "others": _walking(trace),
    }


def _manner(judged: Judged, settings: RunSettings) -> dict[str, float]:
    """What a prior of this robot says of it, and of the policy's style; nothing, where it has none."""
    from servoid.hw.robot.description import load_robot
    from servoid.policy import checkpoint
    from servoid.policy.priors.score_matching.judged import manner_of
    from servoid.policy.priors.score_matching.model import load_prior
    from servoid.sim.kinematics import limbs_of

    body = load_robot(settings.robot)
    style = _style(settings.policy, body)
    try:
        path = checkpoint.resolve(_PRIOR if style.lower is None else _STYLES, body)
    except checkpoint.CheckpointError:
        return {}
    return manner_of(np.array(judged.estimates), load_prior(path, body, limbs_of(body)), style)


def _style(policy: str, robot: Robot) -> Style:
    """That a task policy learned; any, where it is none."""
    from servoid.policy import checkpoint
    from servoid.policy.priors.score_matching.model import Style

    try:
        style = checkpoint.read_header(checkpoint.resolve(policy, robot)).get("config", {}).get("style")
    except checkpoint.CheckpointError:
        style = None
    return Style(**style) if style else Style()


def _points(places: Array, dt: float) -> Array:
    """Places `(ticks, 2)`, one for each step of time, and the last one, to the millimetre."""
    step = max(round(PATH_STEP / dt), 1)
    thinned = np.concatenate([places[:-1:step], places[-1:]]) if len(places) else places
    return np.round(thinned, 3)


def _still(trace: Trace) -> Array:
    """Obstacles `(n, 3)` m that stayed where they were: x, y, radius."""
    if trace.obstacles is None or not len(trace.obstacles):
        return np.zeros((0, 3))
    return np.round(trace.obstacles[0][~_moved(trace.obstacles)], 3)


def _rolling(trace: Trace) -> list[dict[str, Any]]:
    """Radius and path of each obstacle that moved."""
    if trace.obstacles is None or not len(trace.obstacles):
        return []
    moving = trace.obstacles[:, _moved(trace.obstacles)]
    return [
        {"radius": float(moving[0, i, 2]), "path": _points(moving[:, i, :2], trace.dt)} for i in range(moving.shape[1])
    ]


def _walking(trace: Trace) -> list[Array]:
    """Paths of the other robots."""
    return [] if trace.robots is None else [_points(path[:, :2], trace.dt) for path in trace.robots.swapaxes(0, 1)]


def _moved(obstacles: Array) -> Array:
    """Which of the obstacles `(ticks, n, 3)` are not where they were at the start."""
    apart = np.linalg.norm(obstacles[-1, :, :2] - obstacles[0, :, :2], axis=-1)
    result: Array = apart > 1e-6
    return result
