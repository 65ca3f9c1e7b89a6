"""One evaluation: the rows that are asked for, the episodes that they lack, done on all processes, and kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.hw.seeds import evaluation_seed
from servoid.tools.common.cluster import workplace
from servoid.tools.common.exit_codes import explain
from servoid.tools.common.worker_pool import Place, each
from servoid.tools.evaluate.cache import EpisodeCache, key
from servoid.tools.evaluate.code_hash import everything_of, read_anew
from servoid.tools.evaluate.episode import EpisodeJob, EpisodeResult, do_episode
from servoid.tools.evaluate.policies import Policies, dependencies
from servoid.tools.evaluate.progress import EpisodeBar, Forecast
from servoid.tools.evaluate.report import Measured
from servoid.tools.evaluate.spec import Experiment, Row

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings

Work = Callable[[EpisodeJob], EpisodeResult]
Pool = Callable[[Work, Iterable[EpisodeJob], int, float | None, Place[Any]], Iterator[EpisodeResult]]


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
    ray: str | None = None  # address of a cluster to do it on
    minutes: float | None = None  # then stop, and go on another time; 0: do nothing, and tell what was done
    quick: bool = False  # cut the longest episodes
    fresh: bool = False  # do again what was done


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while episodes ran: `measured` is what was done until then."""

    def __init__(self, measured: Mapping[str, Measured]) -> None:
        super().__init__("interrupted: what was done is kept; the same command goes on")
        self.measured = measured


@dataclass
class _Prepared:
    """An experiment of one or more rows, with what was done of it."""

    experiment: Experiment
    settings: RunSettings
    policy: tuple[Mapping[str, Any], str | None]  # its fingerprint, and the hash of its file of settings
    limit: float  # s that an episode lasts at most
    episodes: int
    cache: EpisodeCache
    rows: list[str] = field(default_factory=list)
    refused: str | None = None

    def records(self) -> list[dict[str, Any]]:
        return [self.cache.records[i] for i in range(self.episodes) if i in self.cache.records]


def evaluate(
    rows: Sequence[Row],
    options: Options,
    say: Callable[[str], None] = print,
    work: Work = do_episode,
    pool: Pool = each,
    now: Callable[[], float] = time.monotonic,
) -> dict[str, Measured]:
    """Do the episodes that `rows` lack, and return what was measured by the rows' names.

    Episode i has the same seed in every row. Every experiment gets its first episode before any gets its second, so
    that an evaluation that is stopped has a bit of everything. A row that cannot be done says why; the others go on.
    Raises ConfigError for a robot or policy that there is not, or where nothing can be written, and Interrupted.
    """
    from servoid.policy.checkpoint import git_commit

    begun = now()
    read = read_anew(options.robot)
    policies = Policies(options.policy, options.out)
    measured, prepared = _prepare_all(rows, policies, options, say)
    jobs, commit = list(_jobs(prepared, options.seed)), git_commit()
    cached = sum(len(one.records()) for one in prepared)
    ahead = "" if options.minutes == 0 else f", {len(jobs)} are to be done"
    say(f"{len(rows)} rows, {len(prepared)} experiments: {cached} episodes are there{ahead}")
    deadline = None if options.minutes is None else begun + 60.0 * options.minutes
    idle = options.minutes == 0 or not jobs  # then there is nothing to start processes for
    left = [sum(job.experiment == number for job in jobs) for number in range(len(prepared))]
    inspect = partial(everything_of, [one.settings for one in prepared])
    interrupted = False
    with workplace(None if idle else options.ray, inspect, say) as place:
        workers = 1 if idle else min(options.workers or place.size, len(jobs))
        bar = EpisodeBar(Forecast([one.limit for one in prepared], left), workers, deadline)
        try:
            for result in pool(work, _jobs(prepared, options.seed), workers, deadline, place):
                one = prepared[result.job.experiment]
                if result.refused is not None:
                    one.refused = result.refused
                    bar.refused(result.job.experiment)
                    continue
                if (
                    _made_of(policies, one.experiment, one.settings.policy) != one.policy
                    or read_anew(options.robot) != read
                ):
                    raise ConfigError(
                        f"the policy of {', '.join(one.rows)}, the robot, the code or a file in configs/ changed while"
                        " episodes ran: finished ones are kept; run the same command again once the files no longer"
                        " change"
                    )
                one.cache.add(result.job.episode, {**result.record, "commit": commit})
                bar.done(result.job.experiment, result.wall_seconds)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            bar.close()
    for one in prepared:
        measured.update(dict.fromkeys(one.rows, Measured(one.records(), refused=one.refused)))
    if interrupted:
        raise Interrupted(measured)
    return measured


def _prepare_all(
    rows: Sequence[Row], policies: Policies, options: Options, say: Callable[[str], None]
) -> tuple[dict[str, Measured], list[_Prepared]]:
    """Why rows cannot be done, by their names, and the experiments of the others."""
    measured: dict[str, Measured] = {}
    prepared: dict[str, _Prepared] = {}  # by the names of their caches: others may come to the same episodes
    known: dict[str, str | Measured] = {}  # what an experiment came to
    for row in rows:
        if repr(row.experiment) not in known:
            try:
                training = policies.training(row.experiment)
                if training is None:
                    one = _prepare(row.experiment, policies, options, say)
                    prepared.setdefault(one.cache.path.name, one)
                    known[repr(row.experiment)] = one.cache.path.name
                else:
                    known[repr(row.experiment)] = Measured(training=training)
            except Exception as error:  # clips are recorded there: whatever ends that does not end the other rows
                known[repr(row.experiment)] = Measured(refused=explain(error))
        found = known[repr(row.experiment)]
        if isinstance(found, Measured):
            measured[row.name] = found
        else:
            prepared[found].rows.append(row.name)
    return measured, list(prepared.values())


def _prepare(experiment: Experiment, policies: Policies, options: Options, say: Callable[[str], None]) -> _Prepared:
    """Raises ConfigError where the experiment cannot be done."""
    from servoid.stack.runtime.run import RunSettings
    from servoid.stack.tasks import load_settings
    from servoid.tools.evaluate import clips

    chosen, recipe = dict(experiment.set), None
    if experiment.clips:
        number = experiment.clips
        recipe = key(clips.recipe(options.robot) | {"number": number})
        if options.minutes != 0:
            recorded = clips.record_clips(options.out / "clips", options.robot, number, say)
            chosen["clips"] = ":".join(map(str, recorded))
    own = load_settings(experiment.task, dict(experiment.set)).seconds
    limits = [own, options.seconds, experiment.quick_seconds if options.quick else None]
    shortest = min(limit for limit in limits if limit is not None)
    seconds = None if shortest == own else shortest
    kept = dependencies(experiment, policies, options.robot, options.seed, seconds, recipe)
    settings = RunSettings(
        task=experiment.task,
        backend=experiment.backend,
        robot=options.robot,
        policy=policies.name(experiment),
        randomise=experiment.randomise,
        recover=experiment.recover,
        seconds=seconds,
        set=chosen,
    )
    return _Prepared(
        experiment=experiment,
        settings=settings,
        policy=_made_of(policies, experiment, settings.policy),
        limit=shortest,
        episodes=options.episodes or experiment.episodes,
        cache=EpisodeCache(options.out / "episodes" / f"{key(kept)}.jsonl", kept, options.fresh),
    )


def _made_of(policies: Policies, experiment: Experiment, policy: str) -> tuple[Mapping[str, Any], str | None]:
    """What the policy of an experiment is made of, to be compared."""
    from servoid.stack.log.provenance import sha256

    return policies.fingerprint(experiment), sha256(Path(policy))


def _jobs(prepared: Sequence[_Prepared], seed: int) -> Iterator[EpisodeJob]:
    """Episodes that are to be done, in turns; those of an experiment that refuses are left out from then on."""
    for episode in range(max((one.episodes for one in prepared), default=0)):
        for number, one in enumerate(prepared):
            if episode < one.episodes and episode not in one.cache.records and one.refused is None:
                yield EpisodeJob(number, episode, replace(one.settings, seed=evaluation_seed(seed, episode)))
