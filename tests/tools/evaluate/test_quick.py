"""`servoid evaluate papers --quick`: what it means, without running an episode."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from servoid.tools.cli import main
from servoid.tools.evaluate import papers
from servoid.tools.evaluate import runner as session
from servoid.tools.evaluate.episode import Done, Job
from servoid.tools.evaluate.runner import Options, evaluate
from servoid.tools.evaluate.spec import Row, select
from servoid.tools.evaluate.summary import Measured
from servoid.tools.evaluate.table import ROWS

MAIN = {
    "uniphys/length", "uniphys/goal-near", "uniphys/goal-far", "uniphys/velocity", "uniphys/obstacle",
    "cloc/perturb", "cloc/forest", "cloc/inbetween",
}  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], Options]]:
    """Rows and options that the command would evaluate."""
    seen: list[tuple[list[str], Options]] = []

    def note(rows: Sequence[Row], options: Options, say: Callable[[str], None]) -> dict[str, Measured]:
        seen.append(([row.name for row in rows], options))
        return {row.name: Measured() for row in rows}

    monkeypatch.setattr(papers, "evaluate", note)
    return seen


def test_it_is_two_episodes_a_row_and_nine_minutes(asked: list[tuple[list[str], Options]], tmp_path: Path) -> None:
    words = ["evaluate", "papers", "--out", str(tmp_path)]
    assert main([*words, "--quick"]) == 0
    ((rows, options),) = asked
    assert (options.episodes, options.minutes, options.quick) == (2, 9.0, True)
    assert options.seconds is None  # episodes are whole, but for those that say otherwise
    assert set(rows) >= MAIN
    assert rows == [row.name for row in select(ROWS, [], quick=True)]
    assert len(rows) < len(ROWS) / 2


def test_what_is_said_beside_it_is_heeded(asked: list[tuple[list[str], Options]], tmp_path: Path) -> None:
    words = ["evaluate", "papers", "--out", str(tmp_path)]
    assert main([*words, "--quick", "--episodes", "5", "--minutes", "3"]) == 0
    assert main([*words, "--quick", "--minutes", "0"]) == 0  # tells what was done
    assert main(words) == 0
    (_, chosen), (_, told), (rows, whole) = asked
    assert (chosen.episodes, chosen.minutes) == (5, 3.0)
    assert (told.episodes, told.minutes) == (2, 0.0)
    assert (whole.episodes, whole.minutes, whole.quick) == (None, None, False)
    assert rows == [row.name for row in ROWS]


def test_no_episode_begins_after_the_minutes_and_no_run_has_a_third(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    jobs: list[Job] = []
    left: list[float] = []

    def each(do: object, work: Iterable[Job], workers: int, deadline: float | None) -> Iterator[Done]:
        assert deadline is not None
        left.append(deadline - time.monotonic())
        for job in work:
            jobs.append(job)
            yield Done(job, {"success": True, "fell": False, "outcome": "succeeded"})

    monkeypatch.setattr(session, "each", each)
    some = [row for row in ROWS if row.name in ("uniphys/goal-near", "uniphys/velocity", "cloc/perturb")]
    options: dict[str, Any] = {"episodes": papers.QUICK_EPISODES, "minutes": papers.QUICK_MINUTES}
    evaluate(some, Options(out=tmp_path, policy="gait", workers=1, quick=True, **options), lambda _: None)
    assert [(job.settings.task, job.episode) for job in jobs] == [
        (task, episode) for episode in (0, 1) for task in ("goal-near", "velocity", "perturb")
    ]
    assert {job.settings.seconds for job in jobs if job.settings.task == "velocity"} == {61.0}
    assert left[0] == pytest.approx(540.0, abs=20.0)


def test_rows_cut_for_it_are_those_that_say_so() -> None:
    cut = {row.run.task for row in select(ROWS, [], quick=True) if row.run.quick_seconds is not None}
    assert cut == {"velocity"}
