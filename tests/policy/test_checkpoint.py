from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from servoid.hw.robot.description import Robot, load_robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError

ROBOT = load_robot()


def head(**changes: Any) -> dict[str, Any]:
    made = checkpoint.header(
        "test", ROBOT, config={"width": 3}, data="made up", licence="Apache-2.0", results={"s": 1.0}
    )
    return made | changes


def test_header_and_tensors_come_back(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    weight = np.arange(6, dtype=np.float32).reshape(2, 3)
    checkpoint.write(path, {"weight": weight.T}, head())
    got, tensors = checkpoint.read(path)
    assert got == head()
    np.testing.assert_array_equal(tensors["weight"], weight.T)
    assert checkpoint.read_header(path) == head()
    assert got["joints"] == list(ROBOT.names)


def other_rate(robot: Robot) -> Robot:
    return replace(robot, rate=100)


def other_order(robot: Robot) -> Robot:
    a, b, *rest = robot.joints
    return replace(robot, joints=(b, a, *rest))


def fewer_joints(robot: Robot) -> Robot:
    return replace(robot, joints=robot.joints[1:])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (other_rate, "runs at 100"),
        (other_order, "entry 0 is head_pan, but head_tilt is needed"),
        (fewer_joints, "not known here: head_pan"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused_with_the_reason(tmp_path: Path, change: Any, reason: str) -> None:
    with pytest.raises(CheckpointError, match=reason) as error:
        checkpoint.check(tmp_path / "net.safetensors", head(), "test", change(ROBOT))
    assert "net.safetensors" in str(error.value)
    assert "train" not in str(error.value)
    with pytest.raises(CheckpointError, match=reason) as error:
        checkpoint.check(tmp_path / "odometry.safetensors", head() | {"kind": "odometry"}, "odometry", change(ROBOT))
    command = f"servoid train odometry --policy gait --robot FILE --out {ROBOT.folder}/odometry.safetensors"
    assert str(error.value).endswith(f"; train it once: {command}"), (
        "into its own folder: it never replaces another robot's"
    )


def test_a_checkpoint_of_another_robot_is_not_written_over(tmp_path: Path) -> None:
    """An odometry that was trained for a robot of one's own replaced the OP3's."""
    path = tmp_path / "odometry.safetensors"
    checkpoint.write(path, {}, head())
    checkpoint.write(path, {}, head())
    for attempt in (
        lambda: checkpoint.check_out(path, ["knee"]),
        lambda: checkpoint.write(path, {}, head() | {"joints": []}),
    ):
        with pytest.raises(CheckpointError, match="is a checkpoint of op3, which has other joints"):
            attempt()


def test_a_robots_own_folder_comes_before_what_is_shipped(tmp_path: Path) -> None:
    robot = replace(ROBOT, folder=str(tmp_path))
    assert checkpoint.resolve("odometry", robot) == checkpoint.CHECKPOINTS / "odometry.safetensors"
    checkpoint.write(tmp_path / "odometry.safetensors", {}, head())
    assert checkpoint.resolve("odometry", robot) == tmp_path / "odometry.safetensors"
    assert checkpoint.resolve("odometry") == checkpoint.CHECKPOINTS / "odometry.safetensors"


def test_another_kind_is_refused_and_another_name_of_the_robot_is_not() -> None:
    with pytest.raises(CheckpointError, match="holds a test network, but a diffusion network is needed"):
        checkpoint.check(Path("net"), head(), "diffusion", ROBOT)
    checkpoint.check(Path("net"), head(), "test", replace(ROBOT, name="op3-of-mine"))


def test_a_layout_that_differs_is_refused() -> None:
    ours = [["gravity", 3], ["yaw", 1]]
    checkpoint.check_layout(Path("net"), "token", ours, ours)
    with pytest.raises(CheckpointError, match=r"entry 1 is yaw\(2\), but yaw\(1\) is needed"):
        checkpoint.check_layout(Path("net"), "token", [["gravity", 3], ["yaw", 2]], ours)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_a_truncated_file_is_a_clear_error(tmp_path: Path, share: float) -> None:
    path = tmp_path / "cut.safetensors"
    checkpoint.write(path, {"weight": np.zeros((50, 50), np.float32)}, head())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"cut\.safetensors: not a checkpoint, or a truncated one"):
        checkpoint.read(path)


def test_foreign_files_are_clear_errors(tmp_path: Path) -> None:
    text = tmp_path / "text.safetensors"
    text.write_text("these are not weights")
    with pytest.raises(CheckpointError, match=r"text\.safetensors"):
        checkpoint.read(text)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"w": np.zeros(3, np.float32)}, foreign)
    with pytest.raises(CheckpointError, match="without the header of this project"):
        checkpoint.read(foreign)
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        checkpoint.read(tmp_path / "missing.safetensors")


def test_an_incomplete_header_and_a_newer_format_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    incomplete = head()
    del incomplete["licence"]
    with pytest.raises(CheckpointError, match="lacks licence"):
        checkpoint.write(path, {}, incomplete)
    checkpoint.write(path, {}, head(format=checkpoint.FORMAT + 1))
    with pytest.raises(CheckpointError, match="newer than this program"):
        checkpoint.read(path)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "net.safetensors"
    checkpoint.write(path, {"w": np.ones(2, np.float32)}, head())

    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CheckpointError, match="No space left"):
        checkpoint.write(path, {"w": np.zeros(2, np.float32)}, head())
    np.testing.assert_array_equal(checkpoint.read(path)[1]["w"], 1)


def test_an_unknown_name_is_answered_with_the_nearest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "CHECKPOINTS", tmp_path)
    with pytest.raises(CheckpointError, match="none is shipped"):
        checkpoint.resolve("diffusion")
    (tmp_path / "diffusion.safetensors").touch()
    assert checkpoint.resolve("diffusion") == tmp_path / "diffusion.safetensors"
    with pytest.raises(CheckpointError, match="did you mean 'diffusion'"):
        checkpoint.resolve("difusion")
