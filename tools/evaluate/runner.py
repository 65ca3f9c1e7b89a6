"""One evaluation: the rows that are asked for, the episodes that they lack, done on all processes, and kept."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common.exit_codes import explain
from servoid.tools.common.worker_pool import each
from servoid.tools.evaluate.cache import EpisodeCache, key
from servoid.tools.evaluate.code_hash import read_anew
from servoid.tools.evaluate.episode import Job, do, episode_seed
from servoid.tools.evaluate.policies import Pilots, spec
from servoid.tools.evaluate.spec import Row, Run
from servoid.tools.evaluate.summary import Measured

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings


@dataclass(frozen=True)
class Options:
    """What to evaluate and how. `episodes` and `seconds` are instead of the rows' own."""

    out: Path
    policy: str = "diffusion"
    robot: str = "op3"
    seed: int = 0
    episodes: int | None = None
    seconds: float | None = None  # at most so long an episode: for a try, since figures mean little then
    workers: int = 0
    minutes: float | None = None  # then stop, and go on another time; 0: do nothing, and tell what was done
    quick: bool = False  # cut the longest episodes
    fresh: bool = False  # do again what was done


@dataclass
class _Work:
    """A run of one or more rows, with what was done of it."""

    run: Run
    settings: RunSettings
    pilot: tuple[Mapping[str, Any], str | None]  # fingerprint of the policy, and the hash of its file of settings
    episodes: int
    cache: EpisodeCache
    rows: list[str] = field(default_factory=list)
    refused: str | None = None

    def records(self) -> list[dict[str, Any]]:
        return [self.cache.records[i] for i in range(self.episodes) if i in self.cache.records]


def evaluate(rows: Sequence[Row], options: Options, say: Any = print) -> dict[str, Measured]:
    """Do the episodes that `rows` lack, and return what was measured by the rows' names.

    Episode i has the same seed in every row. Every run gets its first episode before any gets its second, so that an
    evaluation that is stopped has a bit of everything. A row that cannot be done says why; the others go on. Raises
    ConfigError for a robot or policy that there is not, or where nothing can be written.
    """
    from servoid.policy.checkpoint import git_commit

    begun = time.monotonic()
    read = read_anew(options.robot)
    pilots = Pilots(options.policy, options.out)
    works: dict[str, _Work] = {}
    measured: dict[str, Measured] = {}
    prepared: dict[str, str | Exception] = {}  # key of the work of a run, or why there is none
    for row in rows:
        if repr(row.run) not in prepared:
            try:
                training = pilots.training(row.run)
                if training is not None:
                    measured[row.name] = Measured(training=training)
                    continue
                work = _prepare(row.run, pilots, options)
                prepared[repr(row.run)] = work.cache.path.name
                works.setdefault(work.cache.path.name, work)
            except Exception as error:  # clips are recorded there: whatever ends that does not end the other rows
                prepared[repr(row.run)] = error
        found = prepared[repr(row.run)]
        if isinstance(found, Exception):
            measured[row.name] = Measured(refused=explain(found))
        else:
            works[found].rows.append(row.name)
    runs, commit = list(works.values()), git_commit()
    jobs = list(_jobs(runs, options.seed))
    cached = sum(len(work.records()) for work in runs)
    ahead = "" if options.minutes == 0 else f", {len(jobs)} are to be done"
    say(f"{len(rows)} rows, {len(runs)} runs: {cached} episodes are there{ahead}")
    deadline = None if options.minutes is None else begun + 60.0 * options.minutes
    # With no time at all there is nothing to start processes for.
    workers = 1 if options.minutes == 0 else max(min(options.workers or os.cpu_count() or 1, len(jobs)), 1)
    for done in _progress(each(do, _jobs(runs, options.seed), workers, deadline), len(jobs)):
        work = runs[done.job.run]
        if done.refused is not None:
            work.refused = done.refused
        else:
            if _pilot(pilots, work.run, work.settings.policy) != work.pilot or read_anew(options.robot) != read:
                raise ConfigError(
                    f"the policy of {', '.join(work.rows)}, the robot, the code or a file in configs/ changed while"
                    " episodes ran: what was done is kept; give the same command again when the files stay as they are"
                )
            work.cache.add(done.job.episode, {**done.record, "commit": commit})
    for work in runs:
        result = Measured(work.records(), refused=work.refused)
        measured.update(dict.fromkeys(work.rows, result))
    return measured


def _prepare(run: Run, pilots: Pilots, options: Options) -> _Work:
    """Raises ConfigError where the run cannot be done."""
    from servoid.stack.runtime.run import RunSettings
    from servoid.stack.tasks import load_settings
    from servoid.tools.evaluate import clips

    chosen, recipe = dict(run.set), None
    if run.clips:
        recipe = key(clips.recipe(options.robot) | {"number": run.clips})
        recorded = [] if options.minutes == 0 else clips.record_clips(options.out / "clips", options.robot, run.clips)
        chosen["clips"] = ":".join(map(str, recorded))
    own = load_settings(run.task, dict(run.set)).seconds
    limits = [own, options.seconds, run.quick_seconds if options.quick else None]
    shortest = min(limit for limit in limits if limit is not None)
    seconds = None if shortest == own else shortest
    kept = spec(run, pilots, options.robot, options.seed, seconds, recipe)
    settings = RunSettings(
        task=run.task,
        backend=run.backend,
        robot=options.robot,
        policy=pilots.name(run),
        randomise=run.randomise,
        seconds=seconds,
        set=chosen,
    )
    cache = EpisodeCache(options.out / "episodes", kept, options.fresh)
    pilot = _pilot(pilots, run, settings.policy)
    return _Work(run, settings, pilot, options.episodes or run.episodes, cache)


def _pilot(pilots: Pilots, run: Run, policy: str) -> tuple[Mapping[str, Any], str | None]:
    """What the policy of a run is made of, to be compared."""
    from servoid.stack.log.provenance import sha256

    return pilots.fingerprint(run), sha256(Path(policy))


def _jobs(runs: Sequence[_Work], seed: int) -> Iterator[Job]:
    """Episodes that are to be done, in turns; those of a run that refuses are left out from then on."""
    for episode in range(max((work.episodes for work in runs), default=0)):
        for number, work in enumerate(runs):
            if episode < work.episodes and episode not in work.cache.records and work.refused is None:
                yield Job(number, episode, replace(work.settings, seed=episode_seed(seed, episode)))


def _progress(done: Iterator[Any], total: int) -> Iterator[Any]:
    from tqdm import tqdm

    yield from tqdm(done, total=total, unit="episode", mininterval=2.0, disable=total == 0)
