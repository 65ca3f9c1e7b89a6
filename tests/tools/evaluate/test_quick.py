"""`servoid evaluate papers --quick`: what it means, without running an episode."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from servoid.tools.commands.evaluate import QUICK_EPISODES, QUICK_MINUTES, add_arguments, options_of
from servoid.tools.common.parser import Parser
from servoid.tools.common.worker_pool import Place
from servoid.tools.evaluate.episode import EpisodeJob, EpisodeResult
from servoid.tools.evaluate.runner import Options, evaluate
from servoid.tools.evaluate.spec import load_evaluation, select

PAPERS = load_evaluation("papers")
MAIN = {
    "uniphys/length", "uniphys/goal-near", "uniphys/goal-far", "uniphys/velocity", "uniphys/obstacle",
    "cloc/perturb", "cloc/forest", "cloc/inbetween",
}  # fmt: skip


def options(*words: str) -> Options:
    """What the command would evaluate."""
    parser = Parser()
    add_arguments(parser)
    return options_of(parser.parse_args(["papers", *words]), PAPERS)


def test_it_is_two_episodes_a_row_and_nine_minutes() -> None:
    quick = options("--quick")
    assert (quick.episodes, quick.minutes, quick.quick) == (2, 9.0, True)
    assert quick.seconds is None  # episodes are whole, but for those that say otherwise
    rows = [row.name for row in select(PAPERS.rows, [], quick=True)]
    assert set(rows) >= MAIN
    assert len(rows) < len(PAPERS.rows) / 2


@pytest.mark.slow
def test_what_is_said_beside_it_is_heeded() -> None:
    chosen = options("--quick", "--episodes", "5", "--minutes", "3")
    told = options("--quick", "--minutes", "0")  # tells what was done
    whole = options()
    assert (chosen.episodes, chosen.minutes) == (5, 3.0)
    assert (told.episodes, told.minutes) == (2, 0.0)
    assert (whole.episodes, whole.minutes, whole.quick) == (None, None, False)
    assert whole.out == Path("runs/papers")
    assert select(PAPERS.rows, [], quick=False) == list(PAPERS.rows)


def test_no_episode_begins_after_the_minutes_and_no_experiment_has_a_third(tmp_path: Path) -> None:
    jobs: list[EpisodeJob] = []
    deadlines: list[float] = []

    def do(job: EpisodeJob) -> EpisodeResult:
        jobs.append(job)
        return EpisodeResult(job, {"success": True, "fell": False, "outcome": "succeeded"})

    def pool(
        work: Callable[[EpisodeJob], EpisodeResult],
        some: Iterable[EpisodeJob],
        workers: int,
        deadline: float | None,
        place: Place[Any],
    ) -> Iterator[EpisodeResult]:
        assert deadline is not None
        deadlines.append(deadline)
        yield from map(work, some)

    some = [row for row in PAPERS.rows if row.name in ("uniphys/goal-near", "uniphys/velocity", "cloc/perturb")]
    chosen: dict[str, Any] = {"episodes": QUICK_EPISODES, "minutes": QUICK_MINUTES}
    options = Options(out=tmp_path, policy="gait", workers=1, quick=True, **chosen)
    evaluate(some, options, lambda _: None, do, pool, now=lambda: 1e9)
    assert [(job.settings.task, job.episode) for job in jobs] == [
        (task, episode) for episode in (0, 1) for task in ("goal-near", "velocity", "perturb")
    ]
    assert {job.settings.seconds for job in jobs if job.settings.task == "velocity"} == {61.0}
    assert deadlines == [1e9 + 60.0 * QUICK_MINUTES]


def test_rows_cut_for_it_are_those_that_say_so() -> None:
    cut = {
        row.experiment.task for row in select(PAPERS.rows, [], quick=True) if row.experiment.quick_seconds is not None
    }
    assert cut == {"velocity"}
