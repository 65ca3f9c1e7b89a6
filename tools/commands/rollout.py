"""Run a task many times in simulation and judge it by the truth.

Every episode is a `servoid run` of its own, with its own random stream: results do not depend on the number of workers,
and any episode can be repeated with `servoid run TASK --seed S`. Several policies (`--policy expert --policy gait`, or
`--policy expert,gait`) run the same episodes; each one's difference from the first is printed with its 95 % interval,
paired by seed.

With --out, every finished episode is kept as a line of JSON, and the same command continues where it stopped. With
--ray, episodes run on the machines of a Ray cluster, with the same results; those of a machine that dies run on
another. After Ctrl-C, or an episode that fails with an error, the figures of the finished episodes are printed.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common.cluster import add_ray_argument, workplace
from servoid.tools.common.compare import difference_table, differences, summarise, table
from servoid.tools.common.exit_codes import exit_code, explain
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import (
    add_gain_argument,
    add_recover_argument,
    add_set_argument,
    check_seed,
    out_of_reach,
    positive,
    settings,
)
from servoid.tools.common.worker_pool import each
from servoid.tools.evaluate.cache import EpisodeCache, depends_on, key
from servoid.tools.evaluate.code_hash import everything_of
from servoid.tools.evaluate.episode import EpisodeJob, EpisodeResult
from servoid.tools.evaluate.judge import judge
from servoid.tools.evaluate.progress import EpisodeBar, Forecast

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings

Rows = dict[int, dict[str, Any]]  # of a policy's episodes, by their numbers
Work = Callable[[EpisodeJob], EpisodeResult]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="task: a name (see servoid tasks) or FILE.py:Class")
    parser.add_argument(
        "--episodes", type=int, default=50, metavar="N", help="episodes of each policy (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: one per core)")
    add_ray_argument(parser)
    parser.add_argument("--backend", default="sim", metavar="NAME", help="sim or virtual (default: %(default)s)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: %(default)s)")
    parser.add_argument(
        "--policy",
        action="append",
        metavar="NAME|FILE",
        help="controller, as in `servoid run`; may be repeated, to compare (default: diffusion)",
    )
    parser.add_argument("--randomise", action="store_true", help="draw each robot's mass, friction, delays and more")
    parser.add_argument("--seconds", type=positive, metavar="S", help="length of an episode (default: the task's)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")
    add_set_argument(parser)
    add_gain_argument(parser)
    add_recover_argument(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to keep every episode in, and to continue from")
    parser.add_argument("--fresh", action="store_true", help="with --out: repeat all episodes")
    add_json_argument(parser)


def main(args: argparse.Namespace, work: Work | None = None) -> int:
    """`work` does an episode. Raises ConfigError, and what ended an episode, after the figures of the others."""
    with reporting(args.json) as report:
        names = policies(args.policy)
        _check(args)
        for text in out_of_reach(args):
            report.line(text)
        begun = time.monotonic()
        failure: BaseException | None = None
        with nullcontext() if args.out is None else locked(args.out):
            plan = [_prepare(args, name) for name in names]
            try:
                _run_all(plan, args, work or _do, report.line)
            except (Exception, KeyboardInterrupt) as error:
                if not any(one.rows for one in plan):
                    raise
                failure = error  # raised below, when what was done is told
        if isinstance(failure, KeyboardInterrupt) and args.out is not None:
            failure = KeyboardInterrupt("interrupted: what was done is kept; the same command goes on")
        result = _tell(report, args, plan) | {"wall_seconds": time.monotonic() - begun}
        if failure is not None:
            result |= {"error": explain(failure), "exit_code": exit_code(failure)}
        report.result(result)
        if failure is not None:
            raise failure
    return 0


def policies(given: Sequence[str] | None) -> list[str]:
    """Policies that were asked for, in their order. Raises ConfigError for one that is given twice, or empty."""
    names = [name for text in given or ["diffusion"] for name in text.split(",")]
    for name in names:
        if not name or names.count(name) > 1:
            raise ConfigError(f"--policy '{name}': " + ("given twice" if name else "name or file missing"))
    return names


def _check(args: argparse.Namespace) -> None:
    from servoid.stack.runtime.backends import backend_kind
    from servoid.stack.tasks import find

    if args.episodes < 1:
        raise ConfigError(f"--episodes must be at least 1, not {args.episodes}")
    if args.workers < 0:
        raise ConfigError(f"--workers must not be negative, not {args.workers}; 0 is one per core")
    check_seed(args.seed)
    if args.fresh and args.out is None:
        raise ConfigError("--fresh repeats the episodes in --out: name the folder with --out")
    if find(args.task).cls.steered:
        raise ConfigError(f"task '{args.task}' is steered by a person: use `servoid run {args.task}`")
    if not backend_kind(args.backend).simulated:
        raise ConfigError(f"backend '{args.backend}' has no truth to judge by: use a simulated one, or `servoid run`")


@dataclass(frozen=True)
class _Policy:
    """What one policy is to do, and what it has done."""

    settings: RunSettings  # of the rollout: its seed is not yet an episode's
    rows: Rows
    cache: EpisodeCache | None
    made_of: tuple[Any, ...]  # files that its episodes read: they must stay as they are


def _prepare(args: argparse.Namespace, name: str) -> _Policy:
    """Raises ConfigError for a bad choice, and where --out holds episodes of others."""
    from servoid.stack.runtime.run import RunSettings

    chosen = RunSettings(
        task=args.task,
        backend=args.backend,
        robot=args.robot,
        policy=name,
        randomise=args.randomise,
        seconds=args.seconds,
        seed=args.seed,
        gain=args.gain,
        set=settings(args),
        recover=args.recover,
    )
    if args.out is None:
        return _Policy(chosen, {}, None, ())
    made_of = _made_of(chosen)
    policy = {key: value for key, value in made_of[-1].items() if key != "name" or not made_of[-1]["checkpoint_sha256"]}
    cache = EpisodeCache(args.out / f"{_file_name(name)}.jsonl", depends_on(chosen, policy), args.fresh)
    rows = {i: row for i, row in cache.records.items() if i < args.episodes}
    return _Policy(chosen, rows, cache, made_of)


def _made_of(chosen: RunSettings) -> tuple[Any, ...]:
    from servoid.hw.robot.description import load_robot
    from servoid.stack.control.policies import policy_fingerprint
    from servoid.tools.evaluate.code_hash import read_anew

    return *read_anew(chosen.robot), policy_fingerprint(chosen.policy, load_robot(chosen.robot))


def _file_name(policy: str) -> str:
    """A policy's name, or for a file that and a hash, since others may be called so in other folders."""
    if re.fullmatch(r"[\w-]+", policy):
        return policy
    stem = re.sub(r"[^\w-]+", "-", Path(policy).stem)[:40]
    return f"{stem}-{key({'policy': policy})[:6]}"


def _run_all(plan: Sequence[_Policy], args: argparse.Namespace, work: Work, say: Callable[[str], None]) -> None:
    """Do all episodes that are lacking, on `--workers` processes; bad settings are refused before any.

    Raises what the first episode raises that cannot be done; the others are given up then.
    """
    from servoid.hw.seeds import episode_seed
    from servoid.stack.tasks import load_settings

    jobs = [
        EpisodeJob(number, i, replace(one.settings, seed=episode_seed(args.seed, i)))
        for i in range(args.episodes)
        for number, one in enumerate(plan)
        if i not in one.rows
    ]
    if not jobs:
        return
    limit = args.seconds or load_settings(args.task, settings(args)).seconds
    left = [sum(job.experiment == number for job in jobs) for number in range(len(plan))]
    with workplace(args.ray, partial(everything_of, [one.settings for one in plan]), say) as place:
        workers = min(args.workers or place.size, len(jobs))
        if workers > 1 or len(plan) > 1:
            for number in {job.experiment: job for job in jobs}.values():
                episode_check(number.settings)
        bar = EpisodeBar(Forecast([limit] * len(plan), left), workers, None)
        try:
            for done in each(work, jobs, workers, place=place):
                _keep(plan[done.job.experiment], done)
                bar.done(done.job.experiment, done.wall_seconds)
        finally:
            bar.close()


def _keep(one: _Policy, done: EpisodeResult) -> None:
    """Raises ConfigError where what the episodes depend on has changed meanwhile."""
    if one.cache is not None:
        if _made_of(one.settings) != one.made_of:
            raise ConfigError(
                f"policy '{one.settings.policy}', the robot, the code or a file in configs/ changed while "
                "episodes ran: what was done before is kept"
            )
        one.cache.add(done.job.episode, done.record)
    one.rows[done.job.episode] = done.record


def _do(job: EpisodeJob) -> EpisodeResult:
    begun = time.monotonic()
    return EpisodeResult(job, judge(job.settings).row, wall_seconds=time.monotonic() - begun)


def episode_check(job: RunSettings) -> None:
    """Raise here, in the parent, what every episode would raise: an unknown task, policy, robot or key."""
    from servoid.stack.runtime.run import run

    run(replace(job, seconds=0.1))


def _tell(report: Report, args: argparse.Namespace, plan: Sequence[_Policy]) -> dict[str, Any]:
    """Print the figures, and return what `--json` prints."""
    done = {one.settings.policy: [one.rows[i] for i in sorted(one.rows)] for one in plan if one.rows}
    found = {name: summarise(rows) for name, rows in done.items()}
    chosen: dict[str, Any] = {name: vars(args)[name] for name in ("task", "backend", "robot", "seed")}
    chosen |= {"randomised": args.randomise} | ({} if args.out is None else {"out": args.out})
    report.table(*table(found))
    report.line("± standard deviation over episodes; (95 % interval, Wilson)")
    for name, summary in found.items():
        if seeds := summary["failed_seeds"]:
            shown = " ".join(map(str, seeds[:10])) + (" ..." if len(seeds) > 10 else "")
            report.line(f"seeds that failed with {name}: {shown}")
        if causes := summary["falls_by"]:
            shown = "; ".join(f"{count} {cause}" for cause, count in list(causes.items())[:5])
            report.line(f"falls with {name}, as they began: {shown}" + ("; ..." if len(causes) > 5 else ""))
    if len(plan) == 1:
        return chosen | {"policy": plan[0].settings.policy} | found[plan[0].settings.policy]
    return chosen | {"policies": found, "differences": _tell_differences(report, done)}


def _tell_differences(report: Report, done: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Those of each policy to the first."""
    if not done:
        return []
    first, *others = done
    results = []
    for name in others:
        apart = differences(done[name], done[first])
        report.line()
        report.line(f"{name} minus {first}, by seed:")
        report.table(*difference_table(apart))
        results.append({"policy": name, "minus": first, "figures": apart})
    if others:
        report.line("95 % intervals: bootstrap of the differences; - where there are too few, or all are equal")
    return results
