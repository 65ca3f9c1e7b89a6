"""One run in simulation, judged by the truth: what rollouts and evaluations keep of it."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.backend import Backend, Simulation
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Assignment, Trace

if TYPE_CHECKING:
    from servoid.stack.log.tick import TickRecord
    from servoid.stack.runtime.run import RunSettings
    from servoid.tools.common.ground_truth import GroundTruth

ENDED = ("succeeded", "failed", "timed_out")  # outcomes of runs whose task ended by itself


@dataclass(frozen=True)
class Judged:
    """One run as the truth saw it."""

    row: dict[str, Any]  # what a rollout keeps of it
    assignment: Assignment
    trace: Trace
    ground_truth: GroundTruth
    estimates: list[Array]  # raw rows of what the robot knew, a tick of the task each


def judge(job: RunSettings) -> Judged:
    """One run, with everything that the truth shows of it.

    One that the guard broke off is no success, however far it came, and one that never began has no metrics but those
    that count what was left undone. One that may recover `fell` where it did not get up again. Raises KeyboardInterrupt
    where the run was told to end, by a Ctrl-C that it took for itself: that is no episode, and there shall be none
    after it.
    """
    from servoid.hw.robot.description import load_robot
    from servoid.policy.features import raw_row
    from servoid.stack.runtime.run import prepare, run
    from servoid.tools.common.ground_truth import GroundTruth

    assignment, backend = prepare(job)
    robot, episode = load_robot(job.robot), assignment.episode
    ground_truth = GroundTruth(
        simulation(backend), robot.dt, recover=job.recover, low=episode.low, seated=episode.seated
    )
    estimates: list[Array] = []

    def watch(record: TickRecord) -> None:
        ground_truth(record)
        if record.proposal.instruction is not None and record.state is not None:
            estimates.append(raw_row(record.state))

    result = run(job, backend=backend, on_tick=watch)
    _give_memory_back()
    if result.interrupted:
        raise KeyboardInterrupt
    trace = ground_truth.trace()
    began, undone = len(trace.yaw) > 0, assignment.task.counts_undone
    metrics = assignment.metrics(trace) if began or undone else {}
    fell = trace.fallen or result.outcome == "fell"
    row = {
        "seed": job.seed,
        "outcome": result.outcome,
        "success": result.outcome in ENDED and bool(assignment.success(trace)),
        "fell": fell,
        "aborted": not fell and result.outcome not in ENDED,
        "fell_ending": ground_truth.fell_ending,
        "fall": None if ground_truth.down is None else ground_truth.down.cause(robot),
        "seconds": result.seconds,
        "metrics": {name: value for name, value in metrics.items() if began or name in undone},
        "odometry_error_m": ground_truth.odometry_error(result.trace),
    }
    if ground_truth.falls is not None:
        row |= {"falls": ground_truth.falls.falls, "stand_seconds": ground_truth.falls.seconds}
    return Judged(row, assignment, trace, ground_truth, estimates)


def _give_memory_back() -> None:
    """Hand what a run has freed back to the system: the C library keeps some 20 MB of each planner."""
    with suppress(OSError, AttributeError):  # another C library than glibc
        ctypes.CDLL(None).malloc_trim(0)


def simulation(backend: Backend) -> Simulation:
    """What a simulated body knows. Raises ConfigError for another: an episode is judged by the truth."""
    if backend.simulation is None:
        raise ConfigError(f"backend '{backend.name}' has no truth to judge by: use a simulated one, or `servoid run`")
    return backend.simulation
