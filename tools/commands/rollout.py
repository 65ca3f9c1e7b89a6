"""Run a task many times in simulation and judge it by the truth.

Every episode is a `servoid run` of its own, with its own random stream: results do not depend on the number of workers,
and any episode can be repeated with `servoid run TASK --seed S`. An episode that cannot be done ends the rollout with
its error, after the figures of those that were.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common.confidence import wilson
from servoid.tools.common.exit_codes import exit_code, explain
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import add_gain_argument, add_recover_argument, add_set_argument, check_seed, settings
from servoid.tools.common.worker_pool import each

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="a name (servoid tasks), or FILE.py:Class")
    parser.add_argument("--episodes", type=int, default=50, help="(default: %(default)s)")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one a core)")
    parser.add_argument("--backend", default="sim", help="sim or virtual (default: %(default)s)")
    parser.add_argument("--robot", default="op3", help="name or file (default: %(default)s)")
    parser.add_argument(
        "--policy", default="diffusion", help="diffusion (default), expert, gait, or a file as in `run`"
    )
    parser.add_argument("--randomise", action="store_true", help="draw the robot anew for each episode")
    parser.add_argument("--seconds", type=float, help="instead of the task's own")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode's stream (default: %(default)s)")
    add_set_argument(parser)
    add_gain_argument(parser)
    add_recover_argument(parser)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        _check(args)
        begun = time.monotonic()
        rows: dict[int, dict[str, Any]] = {}
        failure: Exception | None = None
        try:
            for episode, row in run_all(args, settings(args)):
                rows[episode] = row
        except Exception as error:
            if not rows:
                raise
            failure = error  # raised below, when what was done is told
        summary = summarise(args, [rows[episode] for episode in sorted(rows)], time.monotonic() - begun)
        if failure is not None:
            summary |= {"error": explain(failure), "exit_code": exit_code(failure)}
        report.table(["figure", "value"], [[key, _text(value)] for key, value in summary.items()])
        report.result(summary)
        if failure is not None:
            raise failure
    return 0


def _check(args: argparse.Namespace) -> None:
    from servoid.stack.runtime.backends import backend_kind
    from servoid.stack.tasks import find

    if args.episodes < 1:
        raise ConfigError(f"--episodes: {args.episodes} is not a number of episodes; give 1 or more")
    if args.workers < 0:
        raise ConfigError(f"--workers: {args.workers} is not a number of processes; give 0 for one a core")
    check_seed(args.seed)
    if find(args.task).cls.steered:
        raise ConfigError(f"task '{args.task}' is steered by a person: use `servoid run {args.task}`")
    if not backend_kind(args.backend).simulated:
        raise ConfigError(f"backend '{args.backend}' has no truth to judge by: use a simulated one, or `servoid run`")


def run_all(args: argparse.Namespace, values: dict[str, str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """All episodes with their rows, as they are done by `--workers` processes. Bad settings are refused before any.

    Raises what the first episode raises that cannot be done; the others are given up then.
    """
    from tqdm import tqdm

    from servoid.hw.seeds import episode_seed
    from servoid.stack.runtime.run import RunSettings

    seeds = [episode_seed(args.seed, i) for i in range(args.episodes)]
    jobs = [
        RunSettings(
            task=args.task,
            backend=args.backend,
            robot=args.robot,
            policy=args.policy,
            randomise=args.randomise,
            seconds=args.seconds,
            seed=seed,
            gain=args.gain,
            set=values,
            recover=args.recover,
        )
        for seed in seeds
    ]
    workers = min(args.workers or os.cpu_count() or 1, len(jobs))
    if workers > 1:
        episode_check(jobs[0])
    done = each(_numbered, enumerate(jobs), workers)
    yield from tqdm(done, total=len(jobs), unit="episode", mininterval=2.0)


def _numbered(job: tuple[int, RunSettings]) -> tuple[int, dict[str, Any]]:
    from servoid.tools.evaluate.judge import judge

    return job[0], judge(job[1]).row


def episode_check(job: RunSettings) -> None:
    """Raise here, in the parent, what every episode would raise: an unknown task, policy, robot or key."""
    from dataclasses import replace

    from servoid.stack.runtime.run import run

    run(replace(job, seconds=0.1))


def summarise(args: argparse.Namespace, rows: list[dict[str, Any]], wall_seconds: float) -> dict[str, Any]:
    """What `--json` prints. Metrics are means over the episodes that have them."""
    import numpy as np

    n, successes = len(rows), sum(row["success"] for row in rows)
    measured = [{**row["metrics"], "odometry_error_m": row["odometry_error_m"]} for row in rows]
    metrics: dict[str, Any] = {}
    for name in sorted({name for row in measured for name in row}):
        values = np.array([row.get(name, np.nan) for row in measured], dtype=float)
        metrics[name] = float(np.nanmean(values)) if np.isfinite(values).any() else None
    return {
        "task": args.task,
        "policy": args.policy,
        "backend": args.backend,
        "robot": args.robot,
        "randomised": args.randomise,
        "episodes": n,
        "seed": args.seed,
        "success_rate": successes / n,
        "success_ci95": wilson(successes, n),
        "fall_rate": sum(row["fell"] for row in rows) / n,
        "aborted_rate": sum(row["aborted"] for row in rows) / n,
        "fell_ending_rate": sum(row["fell_ending"] for row in rows) / n,
        **(_recoveries(rows) if args.recover else {}),
        "mean_seconds": float(np.mean([row["seconds"] for row in rows])),
        "metrics": metrics,
        "wall_seconds": wall_seconds,
        "failed_seeds": [row["seed"] for row in rows if not row["success"]],
    }


def _recoveries(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Falls of all episodes, the share of them that the robot got up from, and the median time from lying still to
    standing."""
    import numpy as np

    falls, seconds = sum(row["falls"] for row in rows), [s for row in rows for s in row["stand_seconds"]]
    return {
        "falls": falls,
        "recovered_share": len(seconds) / falls if falls else None,
        "time_to_stand_s": float(np.median(seconds)) if seconds else None,
    }


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value[:10]) + (" ..." if len(value) > 10 else "")
    return str(value)
