"""Plots say whose run they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.stack.control.gait import GaitPolicy
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.cli import main
from servoid.tools.commands.plot import title
from servoid.tools.common.pictures.video import middle_frames


class Marcher(GaitPolicy):
    """A policy of a program's own."""


def test_a_programs_own_policy_is_not_taken_for_the_default(tmp_path: Path) -> None:
    log = tmp_path / "mine.mcap"
    run(RunSettings("walk", seconds=0.1, seed=3, record=log), policy=Marcher(load_robot()))
    assert title(read_log(log)).startswith("walk with Marcher on op3, seed 3: ")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    run(RunSettings("goal", policy="gait", seconds=0.6, record=path))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 0.5, 0.12])
def test_logs_cut_anywhere_are_drawn(log: Path, share: float, tmp_path: Path) -> None:
    """Alone, over each other, and joint by joint."""
    data = log.read_bytes()
    cut = tmp_path / "b.mcap"
    cut.write_bytes(data[: round(share * len(data))])
    assert main(["plot", str(cut), "--out", str(tmp_path / "one.png")]) == 0
    assert main(["plot", str(log), str(cut), "--out", str(tmp_path / "two.png")]) == 0
    assert main(["plot", str(cut), "--joints", "l_knee,r_knee", "--out", str(tmp_path / "joints.png")]) == 0
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("one.png", "two.png", "joints.png"))


def test_a_strip_shows_the_middle_of_a_run(log: Path) -> None:
    run_of = read_log(log)
    shown = middle_frames(run_of, 4, seconds=0.2)
    place = run_of.column("/state", "displacement")[run_of.ticks("/state") >= run_of.ticks("/instruction")[0]]
    at = [int(np.argmin(np.abs(place - frame.place).sum(1))) for frame in shown]
    assert at == sorted(set(at))  # four moments, in their order
    assert at[0] == pytest.approx(len(place) / 2 - 5, abs=2.5)
    assert at[-1] == pytest.approx(len(place) / 2 + 5, abs=2.5)
    whole = middle_frames(run_of, 4, seconds=1000.0)
    np.testing.assert_array_equal(whole[0].place, place[0])
    assert np.abs(place[-3:] - whole[-1].place).sum(1).min() == 0.0


@pytest.mark.slow
def test_two_logs_have_a_file_of_their_own(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside the first, whose own plot is left alone."""
    assert main(["plot", str(log), str(log)]) == 0
    assert capsys.readouterr().out.strip().endswith("a-a.png")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--joints", "l_kne"], "no joint 'l_kne': did you mean 'l_knee'?"),
        (["--video", "a.avi"], "give a name that ends in .mp4"),
        (["--video", "a.mp4", "--video-size", "wide"], "such as 1280x720"),
        (["--strip", "a.jpg"], "give a name that ends in .png"),
        (["--strip", "a.png", "--strip-seconds", "0"], "--strip-seconds must be positive, not 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    log: Path,
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(log), *words]) == 2
    assert message in capsys.readouterr().err
