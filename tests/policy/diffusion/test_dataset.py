from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from servoid.hw.robot.description import load_robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.features import Emphasis, Normaliser, raw_mirror, token_layout
from servoid.policy.recording import DatasetError, read_recording
from servoid.policy.text.captions import MOTIONS, motion_of
from servoid.policy.text.encoder import load_encoder

ROBOT = load_robot()
CONFIG = DenoiserConfig(54, 20, width=16)


@pytest.fixture
def copy(synthetic_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(synthetic_dataset, tmp_path / "copy"))


def edit(folder: Path, change: object, file: int = 1) -> None:
    path = folder / "data" / "chunk-000" / f"file-{file:03d}.parquet"
    pq.write_table(change(pq.read_table(path)), path)  # type: ignore[operator]


def test_a_window_pairs_the_action_of_a_tick_with_the_state_it_was_decided_on(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    assert len(recording.spans) == 12
    windows = Windows(recording, ROBOT, CONFIG)
    i = int(windows.training[57])
    states, actions = windows._gather(torch.tensor([i]), torch.tensor([False]))
    layout = token_layout(20)
    joints = states[0, :, layout.slice("position")].numpy()
    # The made-up expert's action is the next tick's pose: future labels are clean, past ones are what ran.
    np.testing.assert_allclose(actions[0, 3:], joints[4:], atol=1e-6)
    np.testing.assert_array_equal(actions[0, :3], recording.applied[i - 3 : i])
    assert np.abs(actions[0, :3].numpy() - joints[1:4]).max() > 0.03
    present = layout.split(states[0, 3])
    assert present["displacement"].abs().max() == 0
    assert present["heading"].tolist() == [1.0, 0.0]


def test_no_window_spans_two_episodes_and_held_out_episodes_are_not_trained_on(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    windows = Windows(recording, ROBOT, CONFIG)
    for part in (windows.training, windows.validation):
        first = recording.episode[part.numpy() - 3]
        np.testing.assert_array_equal(first, recording.episode[part.numpy() + 16])
    trained, kept = (set(recording.episode[p.numpy()].tolist()) for p in (windows.training, windows.validation))
    assert kept
    assert not trained & kept
    assert len(trained | kept) == 12
    # Each episode of 120 ticks has every window that fits.
    assert len(windows.training) + len(windows.validation) == 12 * (120 - 3 - 16)


def test_batches_are_normalised_and_half_of_them_mirrored(synthetic_dataset: Path) -> None:
    windows = Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, CONFIG)
    states, actions, text = windows.draw(2000, torch.Generator().manual_seed(0))
    assert text is None  # this model takes no instruction
    assert states.shape == (2000, 20, 54)
    assert actions.shape == (2000, 19, 20)
    assert states.mean((0, 1)).abs().max() < 0.2
    assert actions.std((0, 1)).max() < 1.3
    # Turning left and right are equally likely once half the windows are mirrored, whatever was recorded.
    assert windows.states.mean[token_layout(20).slice("angular_velocity")][2].abs() < 1e-4


def test_mirrored_windows_are_those_of_mirrored_rows(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    rows, joints = raw_mirror(ROBOT), Mirror.joints(ROBOT)
    image = replace(
        recording,
        raw=rows(recording.raw),
        action=joints(recording.action),
        applied=joints(recording.applied),
    )
    pick = Windows(recording, ROBOT, CONFIG).training[:50]
    flipped = Windows(recording, ROBOT, CONFIG)._gather(pick, torch.ones(50, dtype=torch.bool))
    plain = Windows(image, ROBOT, CONFIG)._gather(pick, torch.zeros(50, dtype=torch.bool))
    for a, b in zip(flipped, plain, strict=True):
        torch.testing.assert_close(a, b)


def test_windows_in_which_the_command_changes_on_the_way_are_left_out(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    command = recording.command.copy()
    command[60:120, 1] = 0.05  # half-way through the first episode
    windows = Windows(replace(recording, command=command), ROBOT, CONFIG)
    presents = torch.cat([windows.training, windows.validation])
    first = presents[presents < 120].tolist()
    # The present may be the first tick of a new command, and the last that a whole window of the old one follows.
    assert first == [*range(3, 45), *range(60, 104)]


def test_windows_are_told_what_was_asked_and_mirrored_ones_the_opposite(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    left = replace(recording, command=np.tile(np.float32([0.0, 0.0, 0.8]), (len(recording.command), 1)))
    reader = load_encoder("words")
    config = replace(CONFIG, text="words", text_size=reader.size)
    windows = Windows(left, ROBOT, config)
    _, _, text = windows.draw(400, torch.Generator().manual_seed(0))
    known = {
        name: reader.encode(MOTIONS[motion_of(np.array([0.0, 0.0, turn]), load_robot().walking.scale)].phrasings)
        for name, turn in (("left", 0.8), ("right", -0.8))
    }
    counts = {name: sum((row == rows).all(1).any() for row in text.numpy()) for name, rows in known.items()}
    assert sum(counts.values()) == 400
    assert 150 < counts["right"] < 250
    assert len(np.unique(text.numpy(), axis=0)) > 8  # in many words


def test_global_states_are_emphasised_and_recovered(synthetic_dataset: Path) -> None:
    windows = Windows(read_recording(synthetic_dataset, ROBOT), ROBOT, CONFIG)
    emphasis = Emphasis.of(Normaliser(windows.states.mean.numpy(), windows.states.std.numpy()), 20, 5.0, seed=0)
    rows = np.random.default_rng(0).normal(size=(500, 54)).astype(np.float32) * emphasis.std + emphasis.mean
    projected = emphasis.encode(rows)
    assert projected.shape == (500, 108)
    np.testing.assert_allclose(emphasis.decode(projected), rows, atol=1e-4)
    assert 0.8 < projected.std(0).mean() < 1.2
    assert (
        Emphasis.of(Normaliser(emphasis.mean, emphasis.std), 20, 5.0, seed=0).project.tolist()
        == emphasis.project.tolist()
    )
    # A deviation of one of a global feature moves the inputs more than that of a joint does.
    height, knee = token_layout(20).slice("height").start, token_layout(20).slice("position").start
    power = np.linalg.norm(emphasis.project, axis=1)
    assert power[height] > 1.5 * power[knee]


def test_a_missing_column_is_named(copy: Path) -> None:
    edit(copy, lambda table: table.drop_columns("action_applied"))
    with pytest.raises(DatasetError, match=r"file-001\.parquet: no column 'action_applied'"):
        read_recording(copy, ROBOT)


def test_joints_in_another_order_are_refused_by_name(copy: Path) -> None:
    """As many joints, of the same robot: only their names tell."""
    swapped = replace(ROBOT, joints=(ROBOT.joints[1], ROBOT.joints[0], *ROBOT.joints[2:]))
    first, second = ROBOT.names[:2]
    what = rf"entry 13 is position\.{first}, but position\.{second} is needed"
    with pytest.raises(DatasetError, match=rf"info\.json: 'observation\.state' is not that of op3: {what}"):
        read_recording(copy, swapped)
    path = copy / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"]["action_applied"]["names"].pop(3)
    path.write_text(json.dumps(info))
    with pytest.raises(DatasetError, match=f"'action_applied' .* 19 entries, 20 needed; missing: {ROBOT.names[3]}"):
        read_recording(copy, ROBOT)


def test_a_row_that_is_not_finite_is_named(copy: Path) -> None:
    def poison(table: pa.Table) -> pa.Table:
        values = np.stack(table.column("action").to_numpy())
        values[5, 3] = np.nan
        column = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 20)
        return table.set_column(table.column_names.index("action"), "action", column)

    edit(copy, poison)
    with pytest.raises(DatasetError, match="'action' is not finite in 1 rows, first in episode 6"):
        read_recording(copy, ROBOT)


def test_a_gap_in_an_episode_is_refused(copy: Path) -> None:
    edit(copy, lambda table: pa.concat_tables([table.slice(0, 20), table.slice(25)]))
    with pytest.raises(DatasetError, match="does not go on by one after frame"):
        read_recording(copy, ROBOT)


def test_a_truncated_file_another_rate_and_an_empty_folder_are_refused(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="servoid collect"):
        read_recording(tmp_path, ROBOT)
    with pytest.raises(DatasetError, match="runs at 100"):
        read_recording(copy, replace(ROBOT, rate=100))
    file = copy / "data" / "chunk-000" / "file-000.parquet"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(DatasetError, match=r"file-000\.parquet: not a parquet file"):
        read_recording(copy, ROBOT)


def test_episodes_that_are_too_short_are_refused(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    with pytest.raises(DatasetError, match="0 of 12 episodes are longer than the 134 ticks"):
        Windows(recording, ROBOT, DenoiserConfig(54, 20, width=16, horizon=130))
