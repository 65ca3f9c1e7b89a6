"""What `servoid collect` records, and what it leaves behind when something goes wrong."""

from __future__ import annotations

import errno
import json
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.features import raw_layout
from servoid.policy.recording import read_recording
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.gait import GaitPolicy
from servoid.tools import cli
from servoid.tools.learn.collect.disturbances import Disturbances, DisturbanceSettings, joint_noise
from servoid.tools.learn.collect.episode_cutter import EpisodeCutter
from servoid.tools.learn.collect.skills import SKILLS, skills_of
from servoid.tools.learn.dataset.lerobot import DatasetWriter
from servoid.tools.learn.dataset.schema import Feature, Schema

TICKS = 250  # 5 s
COMMAND = "collect --policy gait --plain-odometry --worlds 8 --frames 1500 --seconds 5 --threads 1 --json --out"


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collect") / "walks"
    assert cli.main([*COMMAND.split(), str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def table(collected: Path) -> pa.Table:
    return pq.read_table(collected / "data" / "chunk-000" / "file-000.parquet")


def matrix(table: pa.Table, name: str) -> Array:
    return np.array(table.column(name).to_pylist())


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# -- the format ----------------------------------------------------------------------------------------------------


def test_schema_is_that_of_info(collected: Path, table: pa.Table, robot: Robot) -> None:
    info = json.loads((collected / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "op3", 50)
    assert info["total_frames"] == table.num_rows >= 1500
    assert info["splits"] == {"train": f"0:{info['total_episodes']}"}
    assert list(info["features"]) == table.column_names
    for name, feature in info["features"].items():
        dtype = table.schema.field(name).type
        assert feature["shape"] == [dtype.list_size if pa.types.is_fixed_size_list(dtype) else 1]
        scalar = dtype.value_type if pa.types.is_fixed_size_list(dtype) else dtype
        assert str(scalar).replace("float", "float32") == feature["dtype"] or str(scalar) == feature["dtype"]
        if feature["names"]:
            assert len(feature["names"]) == len(set(feature["names"])) == feature["shape"][0]
    assert info["features"]["action"]["names"] == list(robot.names)
    names = info["features"]["observation.state"]["names"]
    layout = raw_layout(len(robot.joints))
    assert names[layout.slice("yaw")] == ["yaw"]
    assert names[layout.slice("joint_velocity")] == [f"joint_velocity.{joint}" for joint in robot.names]
    assert (collected / info["data_path"].format(chunk_index=0, file_index=0)).is_file()


def test_episode_table_finds_every_frame(collected: Path, table: pa.Table) -> None:
    episodes = pq.read_table(collected / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    texts = pq.read_table(collected / "meta" / "tasks.parquet")
    tasks = dict(zip(texts["task_index"].to_pylist(), texts["task"].to_pylist(), strict=True))
    end = 0
    for i, episode in enumerate(episodes):
        assert episode["dataset_from_index"] == end
        end = episode["dataset_to_index"]
        rows = table.slice(episode["dataset_from_index"], episode["length"])
        assert end - episode["dataset_from_index"] == episode["length"]
        assert set(rows["episode_index"].to_pylist()) == {i} == {episode["episode_index"]}
        assert {tasks[t] for t in rows["task_index"].to_pylist()} == set(episode["tasks"])
        assert rows["frame_index"].to_pylist() == list(range(episode["length"]))
        np.testing.assert_allclose(rows["timestamp"], np.arange(episode["length"]) / 50, atol=1e-6)
        np.testing.assert_allclose(episode["stats/action/mean"], matrix(rows, "action").mean(0), atol=1e-6)
    assert end == table.num_rows
    assert table["index"].to_pylist() == list(range(end))


def test_statistics_are_those_of_all_frames(collected: Path, table: pa.Table) -> None:
    stats = json.loads((collected / "meta" / "stats.json").read_text())
    assert list(stats) == table.column_names
    for name in ("observation.state", "command", "index"):
        values = matrix(table, name).reshape(table.num_rows, -1).astype(float)
        for key, expected in (("min", values.min(0)), ("max", values.max(0)), ("std", values.std(0))):
            np.testing.assert_allclose(stats[name][key], expected, atol=1e-5, err_msg=f"{name} {key}")
        np.testing.assert_allclose(stats[name]["mean"], values.mean(0), atol=1e-6)
        assert stats[name]["count"] == [table.num_rows]


def test_tasks_are_a_pandas_index(collected: Path) -> None:
    """The format's reader looks tasks up in the index of a data frame."""
    tasks = pq.read_table(collected / "meta" / "tasks.parquet")
    pandas = json.loads(tasks.schema.metadata[b"pandas"])
    assert pandas["index_columns"] == ["task"]
    assert [column["field_name"] for column in pandas["columns"]] == tasks.column_names
    assert tasks["task"].to_pylist() == [skill.text for skill in SKILLS]


def test_provenance(collected: Path) -> None:
    said = yaml.safe_load((collected / "meta" / "servoid.yaml").read_text())
    info = json.loads((collected / "meta" / "info.json").read_text())
    assert said["licence"] == "Apache-2.0"
    assert (said["seed"], said["robot"], said["policy"]) == (0, "op3", {"name": "gait"})
    assert said["result"]["frames"] == info["total_frames"]
    assert "when read" in said["mirroring"]
    assert said["disturbances"]["ankle"] == 0.11


# -- the content ---------------------------------------------------------------------------------------------------


def test_training_reads_it_back(collected: Path, table: pa.Table, robot: Robot) -> None:
    recording = read_recording(collected, robot)
    assert len(recording.raw) == table.num_rows
    np.testing.assert_array_equal(recording.applied, matrix(table, "action_applied").astype(np.float32))
    assert ((recording.spans[:, 1] - recording.spans[:, 0]) >= 100).all()  # 2 s
    position = recording.raw[:, raw_layout(len(robot.joints)).slice("position")]
    # A state and the action decided on it share a row: the joints lag what was applied before, not after.
    first = recording.spans[:, 0]
    np.testing.assert_allclose(position[first], np.tile(robot.home, (len(first), 1)), atol=0.08)


def test_labels_are_clean_and_within_limits(collected: Path, robot: Robot) -> None:
    recording = read_recording(collected, robot)
    step = robot.limits.joint_speed * robot.dt + 1e-6
    noisy = 0
    for first, end in recording.spans:
        action, applied = recording.action[first:end], recording.applied[first:end]
        assert (action >= robot.lower + robot.limits.margin - 1e-6).all()
        assert (action <= robot.upper - robot.limits.margin + 1e-6).all()
        assert (np.abs(np.diff(applied, axis=0)) <= step).all()
        assert (np.abs(action[1:] - applied[:-1]) <= step).all()  # limited from what ran, as the guard does
        different = (action != applied).any(1)
        assert different.all() or not different.any()  # a noisy episode, or a quiet one
        noisy += bool(different.all())
    assert 0 < noisy < len(recording.spans)


def test_command_and_task_go_together_and_last(table: pa.Table, robot: Robot) -> None:
    command, task = matrix(table, "command"), table["task_index"].to_numpy()
    for number, skill in enumerate(skills_of(robot)):
        rows = command[task == number]
        inside = np.zeros(len(rows), bool)
        for box in skill.boxes:
            low, high = np.transpose([box.forward, box.left, box.turn])
            inside |= ((rows >= low - 1e-6) & (rows <= high + 1e-6)).all(1)
        assert inside.all(), skill.name
    changes = (np.diff(command, axis=0) != 0).any(1)
    same_episode = np.diff(table["episode_index"].to_numpy()) == 0
    at = np.flatnonzero(changes & same_episode)
    assert len(at) > 0
    episode = table["episode_index"].to_numpy()
    whole = episode[at[1:]] == episode[at[:-1]]
    gaps, skill_of = np.diff(at)[whole], task[at[1:]][whole]  # the command that ends at a change began at the last
    shortest = np.array([round(skill.seconds[0] * 50) for skill in SKILLS])
    assert (gaps >= shortest[skill_of]).all()


@pytest.mark.slow
def test_same_options_same_files(collected: Path, tmp_path: Path) -> None:
    again, other, quiet = tmp_path / "again", tmp_path / "other", tmp_path / "quiet"
    assert cli.main([*COMMAND.split(), str(again)]) == 0
    assert cli.main([*COMMAND.split(), str(other), "--seed", "1"]) == 0
    assert cli.main([*COMMAND.split(), str(quiet), "--noise", "0", "0"]) == 0
    ours, theirs = files(collected), files(again)
    assert ours.keys() == theirs.keys()
    # The commit is read from a tree that may have changed meanwhile.
    assert [name for name in ours if ours[name] != theirs[name] and name != "meta/servoid.yaml"] == []
    recording = read_recording(quiet, load_robot())
    np.testing.assert_array_equal(recording.action, recording.applied)
    assert files(other)["data/chunk-000/file-000.parquet"] != ours["data/chunk-000/file-000.parquet"]


class Faller(GaitPolicy):
    """Stands; after `at` ticks it throws its limbs out in the worlds `who`. Notes how long each episode was."""

    def __init__(self, fleet: Fleet, at: int, who: Array) -> None:
        super().__init__(fleet.robot, (fleet.n,))
        self.at, self.who = at, who
        self.tick = np.zeros(fleet.n, int)
        self.ends: list[int] = []

    def reset(self, where: Array | None, seeds: Array) -> None:
        assert where is not None
        self.ends += self.tick[where & (self.tick > 0)].tolist()
        self.tick[where] = 0
        super().reset(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        target = super().act(state, applied, Instruction(0 * instruction.velocity))
        target[self.who & (self.tick >= self.at)] += 1.2 * np.sign(np.arange(target.shape[1]) % 2 - 0.5)
        self.tick += 1
        return target


def test_falls_lose_their_last_second(robot: Robot) -> None:
    fleet = Fleet(robot, 4, None, threads=1)
    driver = Faller(fleet, 180, np.array([False, True, False, True]))
    calm = DisturbanceSettings(noisy_share=0.0, pushed_share=0.0)
    cutter = EpisodeCutter(fleet, driver, calm, TICKS / 50)
    episodes = list(cutter.episodes(760))  # more than before the standing ones end
    assert (cutter.begun, cutter.fell) == (6, 2)
    assert all(180 < end < TICKS for end in driver.ends)
    lengths = [len(episode.skill) for episode in episodes]
    assert lengths == [*(end - 50 for end in driver.ends), TICKS, TICKS]  # in the order in which they ended
    state = np.concatenate([episode.columns["observation.state"] for episode in episodes])
    gravity = state[:, raw_layout(len(robot.joints)).slice("gravity")]
    assert (gravity[:, 2] < -0.95).all()


def test_episodes_under_way_end_early_but_whole(robot: Robot) -> None:
    """The frames that were asked for come, though no episode has reached its end."""
    fleet = Fleet(robot, 2, None, threads=1)
    driver = Faller(fleet, 10**6, np.ones(2, bool))
    cutter = EpisodeCutter(fleet, driver, DisturbanceSettings(noisy_share=0.0, pushed_share=0.0), 20.0)
    told: list[int] = []
    episodes = list(cutter.episodes(220, told.append))
    assert [len(episode.skill) for episode in episodes] == [110, 110]
    assert driver.tick.tolist() == [160, 160]  # their last second is not kept: they may have been falling
    assert told[-1] == 220
    assert told == sorted(told)


def test_policy_that_always_falls_is_given_up(robot: Robot) -> None:
    fleet = Fleet(robot, 2, None, threads=1)
    cutter = EpisodeCutter(fleet, Faller(fleet, 0, np.ones(2, bool)), DisturbanceSettings(), 3.0)
    with pytest.raises(ConfigError, match="--policy"):
        list(cutter.episodes(10_000))


def test_skills_are_asked_as_fast_as_the_robot_goes(robot: Robot) -> None:
    """A command that no robot of this size can follow would be recorded beside what it did instead."""
    small = replace(robot, walking=replace(robot.walking, forward=0.2, sideways=0.03))
    for ours, theirs in zip(skills_of(robot), skills_of(small), strict=True):
        for box, smaller in zip(ours.boxes, theirs.boxes, strict=True):
            assert smaller.forward == pytest.approx(0.4 * np.array(box.forward))
            assert smaller.left == pytest.approx(np.clip(0.4 * np.array(box.left), -0.03, 0.03))
            assert smaller.turn == box.turn


def test_noise_rises_to_the_feet_and_pushes_keep_their_pace(robot: Robot) -> None:
    settings = DisturbanceSettings(pushed_share=1.0)
    sizes = dict(zip(robot.names, joint_noise(robot, settings), strict=True))
    assert sizes["l_el"] < sizes["r_hip_pitch"] < sizes["r_knee"] < sizes["l_ank_pitch"] == sizes["r_ank_roll"]
    n, ticks = 200, 500
    rngs = [np.random.default_rng(i) for i in range(n)]
    disturbances = Disturbances(robot, n, settings)
    disturbances.reset(np.arange(n), rngs)
    drawn = np.array([disturbances.noise(rngs) for _ in range(100)])  # (ticks, n, joints)
    noisy = disturbances.scale > 0
    assert 0.65 < noisy.mean() < 0.85
    assert not drawn[:, ~noisy].any()
    white = noisy & (disturbances.slow_scale == 0)
    spread = (drawn[:, white] / disturbances.scale[white, None]).std((0, 1))
    np.testing.assert_allclose(spread, joint_noise(robot, settings), rtol=0.05)
    slow = disturbances.slow_scale > 0
    lag = (drawn[1:] * drawn[:-1]).mean((0, 2)) / (drawn**2).mean((0, 2)).clip(1e-9)
    assert lag[slow].mean() > 0.1 > np.abs(lag[white]).mean()
    pushes = np.array([disturbances.push(rngs) for _ in range(ticks)])
    speed = np.linalg.norm(pushes, axis=-1)
    hardest = settings.push_speed[1] * robot.walking.forward
    assert 0.93 * hardest < speed.max() <= hardest
    count = (speed > 0).sum(0)
    assert count.min() >= ticks / 50 / 3 - 1
    assert count.max() <= ticks / 50


# -- what goes wrong -----------------------------------------------------------------------------------------------


def writer(out: Path, force: bool = False) -> DatasetWriter:
    return DatasetWriter(out, Schema("r", 50, {"x": Feature(("a", "b"))}, ("t",)), force)


def rows(count: int, seed: int = 0) -> dict[str, Array]:
    return {"x": np.random.default_rng(seed).standard_normal((count, 2)).astype(np.float32)}


def write(out: Path, episodes: int, force: bool = False) -> None:
    with writer(out, force) as w:
        for seed in range(episodes):
            w.add(rows(1000, seed), np.zeros(1000, int))
        w.finish()


def test_a_dataset_is_replaced_only_when_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "d"
    for seed in (0, 1):
        with writer(out, force=seed == 1) as w:
            w.add(rows(10, seed), np.zeros(10, int))
            w.finish({"note.txt": str(seed)})
    assert (out / "meta" / "note.txt").read_text() == "1"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d"]
    assert sorted(p.name for p in out.iterdir()) == ["data", "meta"]
    assert cli.main([*COMMAND.split(), str(out)]) == 2
    assert "--force" in json.loads(capsys.readouterr().out)["error"]
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").touch()
    with pytest.raises(ConfigError, match="something other"):
        writer(tmp_path / "photos", force=True)


def test_full_disk_leaves_nothing_that_looks_whole(tmp_path: Path) -> None:
    out = tmp_path / "d"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))  # a file that cannot grow: the kernel refuses for real
    try:
        with pytest.raises(ConfigError, match=r"d: the dataset cannot be written: .*make room"):
            write(out, 100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_full_disk_at_the_end_keeps_the_old_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "d"
    write(out, 1)
    before = files(out)
    monkeypatch.setattr(pq, "write_table", _no_space)  # as the metadata is written
    with pytest.raises(ConfigError, match="No space left"):
        write(out, 2, force=True)
    assert files(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["d"]


def _no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pq, "write_table", _interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "d", 1)
    assert list(tmp_path.iterdir()) == []


def _interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_files_are_split_by_size_and_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servoid.tools.learn.dataset.lerobot.FILE_MEGABYTES", 0.1)
    out = tmp_path / "d"
    write(out, 6)
    episodes = pq.read_table(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert len({e["data/file_index"] for e in episodes}) > 1
    for e in episodes:
        table = pq.read_table(out / "data" / f"chunk-000/file-{e['data/file_index']:03d}.parquet")
        ours = table.filter(pa.compute.equal(table["episode_index"], e["episode_index"]))
        np.testing.assert_array_equal(ours["x"].to_pylist(), rows(1000, e["episode_index"])["x"])


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--frames 0", "--frames"),
        ("--worlds 0", "--worlds"),
        ("--randomise 25", "must be between 0 and 1"),
        ("--noise 1.3 0.5", "the lower one first"),
        ("--seconds 2", "at least 3 s"),
        ("--policy exprt", "no such checkpoint"),
        ("--ray auto", "say in how many with --parts"),
        ("--append --force", "drop one of them"),
        ("--crouched 2", "must be between 0 and 1"),
        ("--crouched 0.5 --skills", "walks upright"),
        ("--style zombie", "how the expert walks upright"),
        ("--style zomby --policy expert", "did you mean 'zombie'"),
    ],
)
def test_options_that_cannot_be(option: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*COMMAND.split(), str(tmp_path / "d"), *option.split()]) == 2
    assert message in json.loads(capsys.readouterr().out)["error"]
    assert list(tmp_path.iterdir()) == []
