"""Learning the odometry's correction: what is recorded, and that fitting takes the error out."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
import torch

from servoid.hw.robot.description import load_robot
from servoid.stack.estimation.odometry import OFFSETS, OdometryFeatures
from servoid.tools.learn.trainers import odometry

ROBOT = load_robot()


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    return odometry.record(ROBOT, odometry.maker(ROBOT, "gait"), 6, 4.0, seed=0)


def test_a_recording_is_what_the_network_will_see(recorded: dict[str, np.ndarray]) -> None:
    size = OdometryFeatures(ROBOT).size
    assert recorded["rows"].shape == (6, 200, size)
    assert np.isfinite(recorded["rows"]).all()
    assert 0.02 < np.abs(recorded["errors"]).mean() < 0.5
    # A row looks back to the start of its own episode, never into the one before a fall.
    starts = recorded["starts"]
    assert (starts <= np.arange(200)).all()
    assert (np.diff(starts, axis=1) >= 0).all()
    changed = np.argwhere(np.diff(starts, axis=1) > 0)
    assert len(changed)  # 10 % noise and pushes: some gait falls
    for world, tick in changed:
        assert starts[world, tick + 1] == tick + 1


def test_fitting_takes_a_systematic_slip_out(recorded: dict[str, np.ndarray], capsys: pytest.CaptureFixture) -> None:
    threads = torch.get_num_threads()
    data = {**recorded, "errors": 0.3 * recorded["rows"][..., :3] + np.float32(0.1)}
    network = odometry.fit(data, steps=25, seed=0)
    torch.set_num_threads(threads)
    ticks = np.arange(30, 200, 10)
    windows = data["rows"][:, ticks[:, None] - OFFSETS].reshape(6, len(ticks), -1)
    slip = data["errors"][:, ticks]
    assert np.square(slip - network(windows)).mean() < 0.25 * np.square(slip).mean()
    assert "corrected: rms" in capsys.readouterr().out


def test_the_odometry_that_is_there_is_measured_and_nothing_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    given = []

    def drift(robot: object, drive: object, network: object, **options: object) -> odometry.Drift:
        given.append(network)
        return odometry.Drift(0.01, 0.02, 0.03, 64)

    monkeypatch.setattr(odometry, "drift", drift)
    parser = argparse.ArgumentParser()
    odometry.add_arguments(parser)
    out = tmp_path / "o.safetensors"
    assert odometry.main(parser.parse_args(["--policy", "--measure", "--out", str(out)])) == 0
    assert given[0] is None
    assert given[1] is not None
    assert "gait, corrected: displacement error 1.0 % of the path (median), 2.0 %" in capsys.readouterr().out
    assert not out.exists()


def test_walks_that_cover_no_metre_do_not_count() -> None:
    """Sway is no path: two seconds of walking sway a metre, and cover none."""
    result = odometry.drift(ROBOT, odometry.maker(ROBOT, "gait"), None, walks=4, seconds=2.0, seed=1)
    assert result.walks == 0
    assert np.isnan(result.p90)
