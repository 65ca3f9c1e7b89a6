"""Settings of trainings: one default each, which flags, help and files have."""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType

import pytest

from servoid.hw.config import CONFIGS, ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.motion.library import Library
from servoid.tools.common.parser import Parser
from servoid.tools.learn.flags import TITLES, add_setting_flags, plain, read_settings
from servoid.tools.learn.planner_settings import PlannerTraining
from servoid.tools.learn.settings import (
    DiffusionTraining,
    LatentTraining,
    OdometryTraining,
    TrackerTraining,
    TrainingRun,
)
from servoid.tools.learn.trainers import diffusion, latent, odometry, planner, tracker

CLIPS = tuple(name for name in Library(load_robot()).names if name != "push-ups")
METHODS: list[tuple[ModuleType, TrainingRun]] = [
    (tracker, TrackerTraining()),
    (odometry, OdometryTraining()),
    (latent, LatentTraining()),
    (diffusion, DiffusionTraining()),
    (planner, PlannerTraining()),
]


def parser_of(verb: ModuleType) -> argparse.ArgumentParser:
    parser = Parser(prog="servoid train x")
    verb.add_arguments(parser)
    return parser


def read(base: TrainingRun, *words: str) -> TrainingRun:
    parser = Parser(prog="servoid train x")
    run = parser.add_argument_group("run")
    run.add_argument("--config")
    add_setting_flags(parser, base, run)
    return read_settings(parser.parse_args(words), base)


@pytest.mark.parametrize(("verb", "base"), METHODS, ids=lambda value: getattr(value, "__name__", ""))
def test_the_help_groups_every_setting_with_its_default(verb: ModuleType, base: TrainingRun) -> None:
    text = parser_of(verb).format_help()
    titles = [line.removesuffix(":") for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert {"run", "network"} < set(titles)
    assert set(titles) - {"options"} <= set(TITLES.values())
    for f in fields(base):
        assert f"--{f.name.replace('_', '-')} " in text, f.name
    where = text.index("\nrun:")
    assert where < text.index("  --out") < text.index("\nnetwork:")
    assert text.count("(default:") >= len(fields(base)) - 1  # a table of rewards has none


@pytest.mark.parametrize("base", [base for _, base in METHODS], ids=lambda base: type(base).__name__)
def test_flags_that_are_not_given_change_nothing(base: TrainingRun) -> None:
    assert read(base) == base


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("width: 64\nhorizon: 8\nmonotone: 0.1\n")
    settings = read(DiffusionTraining(), "--config", str(file), "--width", "32", "--steps", "5")
    assert settings == replace(DiffusionTraining(), width=32, horizon=8, monotone=0.1, steps=5)
    assert read(LatentTraining(), "--beta", "0.1", "0.2") == replace(LatentTraining(), beta=(0.1, 0.2))
    assert read(TrackerTraining(), "--noise", "0.3", "0.1", "--plain-odometry", "--hidden", "32", "16") == replace(
        TrackerTraining(), noise=(0.3, 0.1), plain_odometry=True, hidden=(32, 16)
    )
    changed = read(TrackerTraining(), "--rewards", "slip=-1", "fall=-3")
    assert isinstance(changed, TrackerTraining)
    assert changed.rewards == {**TrackerTraining().rewards, "slip": -1.0, "fall": -3.0}


def test_minutes_that_are_typed_count_where_steps_are_the_default() -> None:
    assert read(OdometryTraining(), "--minutes", "2").budget == 0
    assert read(OdometryTraining(), "--minutes", "2", "--steps", "7").budget == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("minutes: 60\nwidht: 3\n", r"mine.yaml:2: widht: unknown key; did you mean 'width'"),
        ("minutes: 60\nwidth: wide\n", r"mine.yaml:2: width: expected a whole number"),
        ("minutes: 60\nmonotone: 0.8\n", r"mine.yaml:2: monotone must be a share of 0 to 0\.5, not 0\.8"),
        ("history: 1\n", r"mine.yaml:1: history must be at least 2"),
        ("mask: casual\n", r"mine.yaml:1: mask: unknown attention mask 'casual'"),
        ("precision: fp64\n", r"mine.yaml:1: precision: expected one of bf16, fp32"),
    ],
)
def test_a_file_is_refused_by_line_and_key(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read(DiffusionTraining(), "--config", str(tmp_path / "mine.yaml"))


def test_a_reward_that_is_no_term_is_refused_by_file_line_and_nearest_name(tmp_path: Path) -> None:
    text = (CONFIGS / "training" / "expert.yaml").read_text().replace("  slip: -0.5", "  slipp: -0.5")
    (tmp_path / "tracker.yaml").write_text(text)
    line = text.splitlines().index("  slipp: -0.5") + 1
    with pytest.raises(ConfigError, match=rf"tracker.yaml:{line}: .*slipp: no such reward term; did you mean 'slip'"):
        read(TrackerTraining(), "--config", str(tmp_path / "tracker.yaml"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--committed", "17"], "--inference-delay must be 0 to the horizon of 16 ticks"),
        (["--forcing", "1"], "monotone must be a share of 0 to 0, not 0.25, with --forcing 1"),
        (["--near-actions", "0"], "--near-actions must be at least 1 tick"),
        (["--minutes", "0"], "--minutes must be positive"),
        (["--seed", "-1"], "--seed must not be negative"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_flag(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(DiffusionTraining(), *words)


@pytest.mark.parametrize(
    ("base", "changes"),
    [
        (TrackerTraining(), {"minutes": 180.0, "samples": 8.5e6, "clips": CLIPS}),
        (DiffusionTraining(), {"minutes": 60.0, "width": 128, "horizon": 24}),
        (LatentTraining(), {}),
        (OdometryTraining(), {"worlds": 300, "seconds": 45.0, "steps": 5000, "floor": 0.5}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_shipped_files_differ_from_the_defaults_where_they_say_so_alone(
    base: TrainingRun, changes: dict[str, float]
) -> None:
    name = type(base).__name__.removesuffix("Training").lower()
    assert load_yaml(CONFIGS / "training" / f"{name}.yaml", type(base)) == replace(base, **changes)  # type: ignore[arg-type]


def test_shipped_files_are_of_the_networks_that_ship() -> None:
    made = load_yaml(CONFIGS / "training" / "expert.yaml", TrackerTraining)
    head = read_header(resolve("expert"))
    assert head["config"] == {"hidden": list(made.hidden), "rewards": made.rewards}
    assert made == replace(TrackerTraining(), minutes=200.0, samples=40e6, clip_share=0.0, hardest_push=0.9)
    made = load_yaml(CONFIGS / "training" / "tracker.yaml", TrackerTraining)
    known = read_header(resolve("tracker"))["training"]
    # Settings that there are since are as they were then, without a name.
    assert {**plain(TrackerTraining()), **known} == plain(made)
    model, head = (
        load_yaml(CONFIGS / "training" / "diffusion.yaml", DiffusionTraining),
        read_header(resolve("diffusion")),
    )
    trained = {**head["config"], **head["training"]}
    differ = {name for name, value in plain(model).items() if trained.get(name, value) != value}
    assert differ == {"minutes", "evaluate_every"}  # it was trained in two turns
    walks = load_yaml(CONFIGS / "training" / "odometry.yaml", OdometryTraining)
    assert f"{walks.worlds} randomised worlds, {walks.seconds:g} s of" in read_header(resolve("odometry"))["data"]
