"""A dataset in parts, or in several goes, is what it would be at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from servoid.hw.robot.description import load_robot
from servoid.hw.seeds import episode_seed
from servoid.policy.recording import read_recording
from servoid.tools import cli
from servoid.tools.learn.collect.parts import FleetRecipe, KeptParts, Part, record, what_records
from servoid.tools.learn.collect.skills import Commands
from servoid.tools.learn.dataset.reader import read_dataset

COMMAND = "collect --policy gait --plain-odometry --worlds 8 --frames 1500 --seconds 5 --threads 1 --json --out"


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_parts_that_were_interrupted_go_on_and_are_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, part = tmp_path / "whole", tmp_path / "in-turn"
    words = [*COMMAND.replace("--frames 1500", "--frames 1000 --parts 2").split()]
    assert cli.main([*words, str(whole)]) == 0
    how = FleetRecipe("op3", "gait", "tracker", False, 8, 5.0, 0.4, (0.2, 0.6), True, 1)
    made_of = {**what_records(how), "options": [0, 1000, 2, repr(how)]}
    first = record(Part(0, episode_seed(0, 0), 500, how))
    KeptParts(part, {**made_of, "code": "another"}).add(first)
    capsys.readouterr()
    assert cli.main([*words, str(part)]) == 2
    assert "recorded with others of these: code; go on as before, or remove that folder" in capsys.readouterr().out
    KeptParts(part, {**made_of, "code": "another"}).remove()
    KeptParts(part, made_of).add(first)  # as a command leaves it that is interrupted in its second part
    assert cli.main([*words, str(part)]) == 0
    ours, theirs = files(part), files(whole)
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if ours[name] != theirs[name]] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in-turn", "whole"]


def test_another_seed_is_appended_and_the_same_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "walks"
    words = [*COMMAND.replace("--frames 1500", "--frames 500").split(), str(out)]
    assert cli.main(words) == 0
    before = read_dataset(out)
    assert cli.main([*words, "--append", "--seed", "1"]) == 0
    after = read_dataset(out)
    assert after.info["total_frames"] >= before.info["total_frames"] + 500
    said = yaml.safe_load((out / "meta" / "servoid.yaml").read_text())
    assert (said["seed"], [one["seed"] for one in said["appended_to"]]) == (1, [0])
    capsys.readouterr()
    for seed in ("0", "1"):
        assert cli.main([*words, "--append", "--seed", seed]) == 2
        assert f"seed {seed} is in {out} already" in capsys.readouterr().out


def test_what_a_task_policy_does_is_data_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = "collect --worlds 3 --frames 500 --seconds 4 --noise 0 0 --threads 1 --json --out"
    assert cli.main([*command.split(), str(tmp_path / "walks"), "--policy", "speed"]) == 0
    recording = read_recording(tmp_path / "walks", load_robot())
    assert len(recording.action) >= 500
    assert recording.command.any()
    capsys.readouterr()
    assert cli.main([*command.split(), str(tmp_path / "none"), "--policy", "dodgeball"]) == 2
    assert "is asked for a ball, and what is collected asks for velocity" in capsys.readouterr().out


def test_one_velocity_is_asked_after_it_stood() -> None:
    commands = Commands(load_robot(), 4, always=(0.3, 0.0, 0.0))
    commands.begin(np.arange(4))
    rngs = [np.random.default_rng(i) for i in range(4)]
    commands.advance(rngs)
    assert not commands.velocity.any()
    for _ in range(400):
        commands.advance(rngs)
        assert {tuple(row) for row in commands.velocity} <= {(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)}
    assert commands.velocity == pytest.approx(np.tile([0.3, 0.0, 0.0], (4, 1)))
