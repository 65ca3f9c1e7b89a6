"""The table's logic: values, intervals, figures to reach, and rows that have none."""

from __future__ import annotations

import math
import shlex
from dataclasses import replace

import pytest

from servoid.hw.config import ConfigError
from servoid.tools.common.parser import Parser
from servoid.tools.evaluate.metrics import METRICS, Metric
from servoid.tools.evaluate.report import Measured, as_csv, cells, markdown, number, table
from servoid.tools.evaluate.spec import Beside, Experiment, Row, load_evaluation, select

ROWS = load_evaluation("papers").rows
GOAL, LOWEST = Experiment("goal"), Metric("ticks", lower=True)
SHARE = Row("a/share", "Share", GOAL, METRICS["success"], "A", 0.95, figure=0.9)
FALLS = Row("a/falls", "Falls", GOAL, METRICS["falls"], "A", 0.16, figure=0.16)
ERROR = Row("a/error", "Error", GOAL, Metric("error_m", "m", lower=True), "A", 0.1, figure=0.05)
TWICE = Row("a/twice", "Twice", GOAL, LOWEST, "A", figure=Beside("a/expert", 1.2))
EXPERT = Row("a/expert", "Expert", Experiment("goal", policy="expert"), LOWEST, "A")


def records(n: int, good: int) -> list[dict]:
    return [
        {"success": i < good, "fell": i >= good, "ticks": 100 + i, "metrics": {"error_m": 0.04}, "outcome": "succeeded"}
        for i in range(n)
    ]


def one(row: Row, measured: Measured) -> dict:
    (line,) = table([row], {row.name: measured})
    return line


def test_a_share_has_wilsons_interval_and_is_held_against_its_figure() -> None:
    line = one(SHARE, Measured(records(200, 190)))
    assert (line["value"], line["episodes"], line["reached"]) == (0.95, 200, True)
    assert line["ci95"] == pytest.approx([0.9104, 0.9726], abs=5e-4)
    assert one(SHARE, Measured(records(200, 179)))["reached"] is False


def test_less_is_better_where_it_is() -> None:
    assert one(FALLS, Measured(records(100, 84)))["reached"] is True
    assert one(FALLS, Measured(records(100, 83)))["reached"] is False


def test_a_robot_that_cannot_go_on_has_not_stayed_up() -> None:
    """Else a guard that stops every run, or a robot that never comes up, would be one that never falls."""
    some = [{**record, "fell": False, "outcome": "stopped"} for record in records(10, 0)]
    for row in ROWS:
        if row.metric.of == "fell_or_broken_off":
            line = one(row, Measured(some))
            assert (line["value"], line["reached"] is True) == (1.0, False), row.name
            assert "broken off" in row.title


def test_episodes_without_the_figure_do_not_count_and_are_told() -> None:
    some = records(5, 5)
    some[0]["metrics"] = {}
    some[1]["metrics"]["error_m"] = math.nan
    some[2]["metrics"]["error_m"] = None  # as it comes back from a file
    line = one(ERROR, Measured(some))
    assert (line["episodes"], line["value"]) == (2, pytest.approx(0.04))
    assert "3 had ended before there was anything to measure" in line["note"]


def test_a_figure_of_what_came_before_a_fall_says_so() -> None:
    some = records(5, 3)
    some[0]["outcome"] = "stopped"
    some[4]["metrics"] = {}  # it fell before there was anything to measure
    assert "2 fell or were stopped, and count until then" in one(ERROR, Measured(some))["note"]
    assert "until then" not in one(ERROR, Measured(records(5, 5)))["note"]
    whole = replace(ERROR, metric=replace(ERROR.metric, unfinished="whole"))
    for row in (SHARE, FALLS, whole):
        assert "until then" not in one(row, Measured(some))["note"], row.name
    rows = {row.name: row.metric for row in ROWS}
    whole = {name for name, metric in rows.items() if metric.unfinished == "whole"}
    assert {"uniphys/length", "uniphys/velocity", "text/followed"} <= whole
    assert not any(name.startswith("motion/") for name in whole)


def test_times_of_those_that_succeeded_say_how_many_did_not() -> None:
    (row,) = (row for row in ROWS if row.name == "cloc/rolling-both-seconds")
    some = [
        {**record, "metrics": {"seconds_to_goal": 9.0 if record["success"] else math.nan}} for record in records(5, 3)
    ]
    line = one(row, Measured(some))
    assert (line["episodes"], line["note"]) == (
        3,
        "of those that succeeded; 2 did not succeed; no interval: fewer than 4 episodes",
    )


def test_a_time_that_no_episode_came_to_was_not_reached() -> None:
    (row,) = (row for row in ROWS if row.name == "cloc/forest-seconds")
    line = one(row, Measured(records(5, 0)))
    assert (line["value"], line["reached"]) == (None, False)


def test_a_metric_that_the_task_does_not_have_is_not_taken_for_episodes_that_ended_early() -> None:
    line = one(replace(ERROR, metric=Metric("eror_m")), Measured(records(5, 5)))
    assert "the task measures no 'eror_m', but " in line["note"]
    assert ", error_m, ever_fell, fell_ending, fell_or_broken_off, " in line["note"]
    assert "had ended" not in line["note"]


def test_a_figure_may_be_another_rows_value() -> None:
    lines = table([TWICE, EXPERT], {"a/twice": Measured(records(3, 3)), "a/expert": Measured(records(1, 1))})
    assert lines[0]["figure"] == pytest.approx(120.0)
    assert lines[0]["reached"] is True
    assert lines[1]["reached"] is None  # no figure was set
    lines = table([TWICE, EXPERT], {"a/twice": Measured(records(3, 3)), "a/expert": Measured()})
    assert (lines[0]["figure"], lines[0]["reached"]) == (None, None)


@pytest.mark.parametrize(
    ("measured", "told"),
    [
        (
            Measured(training="`servoid train diffusion --mask full`"),
            "needs training: `servoid train diffusion --mask full`",
        ),
        (Measured(refused="unknown setting 'x'"), "unknown setting 'x'"),
        (Measured(), "no time was left"),
    ],
)
def test_what_was_not_measured_has_no_value_and_says_why(measured: Measured, told: str) -> None:
    """Nor that its figure was not reached, which nobody knows."""
    line = one(SHARE, measured)
    assert (line["value"], line["ci95"], line["episodes"], line["reached"]) == (None, None, 0, None)
    assert told in line["note"]
    assert "none" in cells(line)


def test_an_episode_that_the_guard_broke_off_is_told() -> None:
    some = records(4, 4)
    some[3]["outcome"] = "stopped"
    assert "1 stopped by the guard" in one(SHARE, Measured(some))["note"]


def test_a_mean_without_an_interval_says_why() -> None:
    lengths = Row("a/length", "Length", GOAL, Metric("ticks"))
    assert "no interval: fewer than 4 episodes" in one(lengths, Measured(records(3, 3)))["note"]
    same = one(lengths, Measured([{**record, "ticks": 3000} for record in records(6, 6)]))
    assert (same["value"], same["ci95"]) == (3000.0, None)
    assert "no interval: all values are equal" in same["note"]
    assert (
        "no interval" not in one(lengths, Measured(records(4, 4)))["note"] + one(SHARE, Measured(records(1, 1)))["note"]
    )


def test_markdown_and_csv_hold_what_the_table_does() -> None:
    line = one(SHARE, Measured(records(200, 190))) | {"note": "a | b"}
    page = markdown("Papers", ["policy: x"], [line], ["![p](p.png)"])
    assert "| A | Share | 0.95 | at least 0.9 | 0.95 | 0.91 to 0.973 | 200 | yes | a \\| b |" in page
    head, row = as_csv([line]).splitlines()
    assert head.startswith("paper,row,name,published")
    assert row.startswith("A,Share,a/share,0.95,")


def test_numbers_keep_all_digits_before_the_point() -> None:
    """3000 ticks are not 3e+03."""
    values = {2999.6: "3000", 1000.0: "1000", 999.4: "999", 0.12345: "0.123", -3000.0: "-3000"}
    assert {value: number(value, 3) for value in values} == values
    assert number(float("inf"), 3) == "inf"


def test_what_is_finer_than_the_resolution_is_not_compared() -> None:
    """A robot that always has a foot on the ground floats by nothing: 2e-7 mm against 0 is no shortfall."""
    metric = Metric("x_mm", "mm", lower=True, resolution=0.001)
    assert metric.values([{"metrics": {"x_mm": value}} for value in (2.4e-7, 0.0, 0.0312)]) == pytest.approx(
        [0.0, 0.0, 0.031]
    )


def test_rows_are_chosen_by_pattern_and_bring_what_they_are_held_against() -> None:
    rows = [SHARE, FALLS, TWICE, EXPERT]
    assert [row.name for row in select(rows, ["a/tw*"], quick=False)] == ["a/twice", "a/expert"]
    assert select(rows, [], quick=True) == rows
    with pytest.raises(ConfigError, match="the nearest are a/share"):
        select(rows, ["a/sharee"], quick=False)


@pytest.mark.slow
def test_every_row_can_be_told_apart_and_is_of_a_task_that_there_is() -> None:
    from servoid.stack.tasks import load_settings

    assert len({row.name for row in ROWS}) == len(ROWS)
    for row in ROWS:
        load_settings(row.experiment.task, dict(row.experiment.set))
        assert row.experiment.episodes >= 50
    for row in ROWS:
        if isinstance(row.figure, Beside):
            assert row.figure.row in {other.name for other in ROWS}


def test_the_main_rows_are_repeated_on_the_randomised_robot_and_four_on_the_virtual_one() -> None:
    randomised = [row for row in ROWS if row.name.endswith("@randomised")]
    assert len(randomised) == 8
    assert all(row.experiment.randomise for row in randomised)
    assert sum(row.experiment.backend == "virtual" for row in ROWS) == 4
    quick = select(ROWS, [], quick=True)
    assert not any(
        row.experiment.randomise or row.experiment.backend != "sim" or row.experiment.network for row in quick
    )
    undelayed = [row for row in ROWS if row.name.endswith("@no-delay")]
    assert len(undelayed) == 8
    assert all(row.experiment.plan["delay"] == "0" for row in undelayed)
    assert not any(row.name.startswith("calls/") or row in undelayed for row in quick)


def test_networks_are_named_apart() -> None:
    """Two networks in one folder would be measured as one."""
    trained = [row.experiment.network for row in ROWS if row.experiment.network is not None]
    assert len({network.name for network in trained}) == len(set(trained))


def test_commands_that_train_networks_can_be_typed() -> None:
    from servoid.policy.diffusion.model.masks import MASKS
    from servoid.tools.learn.flags import read_settings
    from servoid.tools.learn.settings import DiffusionTraining
    from servoid.tools.learn.trainers import diffusion

    parser = Parser()
    diffusion.add_arguments(parser)
    for row in ROWS:
        if row.experiment.network is not None:
            words = shlex.split(f"--data runs/walks --out runs/x {row.experiment.network.train}")
            asked = read_settings(parser.parse_args(words), DiffusionTraining())
            assert asked.mask in MASKS, row.name
            assert (asked.steps, asked.width) == (15_000, 128)  # equal ones, whatever the load of the machine was


def test_stabilisation_is_about_as_noisy_as_the_papers() -> None:
    """Levels of other schedules do not compare: 3 of our 20 is far noisier than UniPhys's 3 of 50."""
    import numpy as np

    from servoid.policy.diffusion.schedule import cosine_signal
    from servoid.policy.diffusion.settings import load_settings

    theirs = np.sqrt(1.0 - cosine_signal(50)[3])
    stable = [
        int(row.experiment.plan["stabilization_level"])
        for row in ROWS
        if row.experiment.plan.get("stabilization_level", "0") != "0"
    ]
    for level in {load_settings("uniphys").stabilization_level, *stable}:
        assert np.sqrt(1.0 - cosine_signal(20)[level]) == pytest.approx(theirs, rel=0.2)


def test_rows_of_the_forest_that_are_compared_differ_in_their_network_alone() -> None:
    forest = [row for row in ROWS if row.experiment.task == "forest" and row.metric.share]
    trained = {row.name: row.experiment for row in forest if row.experiment.network is not None}
    assert {"cloc/reference", "cloc/horizon-16", "cloc/horizon-64", "cloc/actions-1"} <= trained.keys()
    assert {run.plan["schedule"] for run in trained.values()} == {"rolling"}  # those of the paper's table roll
    assert len({repr(run.plan) for run in trained.values()}) == 1
    assert trained["cloc/reference"] == trained["cloc/actions-16"]  # trained once, measured once
    for name, run in trained.items():
        train = run.network.train if run.network is not None else None
        same = [other for other, run in trained.items() if run.network is not None and run.network.train == train]
        assert set(same) - {name} <= {"cloc/reference", "cloc/actions-16"}, same


def test_each_network_of_the_forest_is_pushed_too() -> None:
    rows = {row.name: row for row in ROWS}
    forest = [row for row in ROWS if row.experiment.task == "forest" and row.experiment.network is not None]
    for row in (row for row in forest if row.metric.share):
        timed, pushed = rows[f"{row.name}-seconds"], rows[f"{row.name}-perturb"]
        assert (timed.experiment, timed.published_unit) == (row.experiment, "s of a human")
        assert pushed.experiment == replace(row.experiment, task="perturb", randomise=True)
        assert (pushed.metric, pushed.published) == (rows["cloc/perturb"].metric, None)
        assert pushed.note.startswith("not in the paper's table")


def test_without_rolling_nothing_goes_over_from_plan_to_plan() -> None:
    rows = {row.name: row for row in ROWS}
    none, both = rows["cloc/rolling-none"], rows["cloc/rolling-both"]
    assert none.experiment.plan["schedule"] == "full_sequence"  # `rolling` from any level keeps the noise of each frame
    assert "noise of its own" in none.note
    for key in ("execution_horizon", "delay"):
        assert none.experiment.plan[key] == both.experiment.plan[key]


def test_motion_is_measured_on_episodes_that_are_done_anyway_and_beside_the_expert() -> None:
    rows = {row.name: row for row in ROWS}
    table3 = {"floating": {"goal-far": 16.78, "velocity": 19.04}, "jerk": {"goal-far": 1.5, "velocity": 2.0}}
    for name, main in (("goal-far", "uniphys/goal-far"), ("velocity", "uniphys/velocity")):
        for kind in ("floating", "jerk", "foot-slip"):
            row, expert = rows[f"motion/{kind}-{name}"], rows[f"motion/{kind}-{name}-expert"]
            assert row.experiment == rows[main].experiment
            assert expert.experiment.policy == "expert"
            assert (row.metric, expert.published) == (expert.metric, None)
            assert row.published == table3.get(kind, {}).get(name)
            assert row.figure == Beside(expert.name, 1.2)


def test_settings_of_the_planner_are_those_that_there_are() -> None:
    from servoid.hw.overrides import override
    from servoid.policy.diffusion.settings import DiffusionSettings

    for row in ROWS:
        override(DiffusionSettings(), dict(row.experiment.plan))
    assert sum(bool(row.experiment.plan) for row in ROWS) > 10
