"""Tasks: what they ask, what they cost, and how a finished run is judged."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from task_bodies import Drawn

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import caption
from servoid.policy.trajectory import Trajectory
from servoid.stack.navigation.go_to_point import SpeedProfile
from servoid.stack.tasks import find, load_settings, load_task, names
from servoid.stack.tasks.terms import metrics as measures
from servoid.stack.tasks.terms.motion import integrate_twist, twist_cost
from servoid.stack.tasks.terms.weights import Weights

DT = 0.02
NOTHING = Percept(source="task", age=0.0)


def state(
    x: float = 0.0, y: float = 0.0, yaw: float = 0.0, velocity: tuple[float, ...] = (0, 0, 0), tick: int = 0
) -> State:
    half = 0.5 * yaw
    return State(
        time_ns=round(tick * DT * 1e9),
        orientation=np.array([np.cos(half), 0, 0, np.sin(half)]),
        gravity=np.array([0, 0, -1.0]),
        yaw=np.array(yaw),
        angular_velocity=np.zeros(3),
        velocity=np.array(velocity, dtype=float),
        displacement=np.array([x, y, 0.26]),
        position=np.zeros(20),
        joint_velocity=np.zeros(20),
        contact=np.ones(2),
    )


def trace(
    velocity: Array, command: Array | None = None, displacement: Array | None = None, fallen: bool = False
) -> Trace:
    """A run straight ahead along x with the given planar velocities `(ticks, 2)`."""
    full = np.pad(velocity, ((0, 0), (0, 1)))
    ticks = len(velocity)
    return Trace(
        dt=DT,
        displacement=np.cumsum(full, axis=0) * DT if displacement is None else displacement,
        yaw=np.zeros(ticks),
        velocity=full,
        yaw_rate=np.zeros(ticks),
        command=np.zeros((ticks, 3)) if command is None else command,
        fallen=fallen,
    )


# --- settings


def test_tasks_load_without_torch_or_mujoco() -> None:
    code = (
        "import sys; from servoid.stack.tasks import load_task; load_task('goal'); "
        "print({'torch', 'mujoco'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"


def test_every_task_has_a_file_that_agrees_with_its_defaults() -> None:
    """A default that differs from the file would be a figure that a reader of either believes wrongly."""
    assert names()[:3] == ("stand", "walk", "goal")
    for name in names():
        settings = load_settings(name)
        if find(name).cls.name == name:  # the others are the same class with other settings
            files = {"seconds", "cost", "alone"} & {f.name for f in fields(settings)}
            assert settings == type(settings)(**{key: getattr(settings, key) for key in files}), name
    assert [load_task(name).seconds for name in names()[:3]] == [10.0, 30.0, 60.0]
    assert {load_task(name).name for name in names()} == set(names())


def test_unknown_task_and_setting_offer_the_nearest() -> None:
    with pytest.raises(ConfigError, match="unknown task 'gaol': did you mean 'goal'"):
        load_task("gaol")
    with pytest.raises(ConfigError, match="unknown setting 'radus': did you mean 'radius'"):
        load_task("goal", {"radus": "1"})
    with pytest.raises(ConfigError, match=r"--set push=hard: expected a number"):
        load_task("walk", {"push": "hard"})
    with pytest.raises(ConfigError, match=r"--set vx=0\.3:0\.1: vx: upside down"):
        load_task("walk", {"vx": "0.3:0.1"})
    with pytest.raises(ConfigError, match="seconds: must be positive"):
        load_task("walk", {"seconds": "0"})
    with pytest.raises(ConfigError, match="did you mean 'velocity'"):
        load_task("walk", {"cost.velocty": "2"})
    assert load_settings("walk", {"cost.velocity": "2"}).cost.velocity == 2.0


# --- walk


def commands(settings: dict[str, str], seed: int = 0) -> Array:
    task = Drawn(load_task("walk", settings, DT), seed)
    return np.array([task.instruct(tick, state(), NOTHING).velocity for tick in range(1500)])


@pytest.mark.slow
def test_walk_draws_a_command_every_five_seconds_within_its_ranges() -> None:
    drawn = np.concatenate([commands({}, seed) for seed in range(40)])
    changes = np.flatnonzero(np.any(np.diff(drawn[:1500], axis=0) != 0, axis=1)) + 1
    assert changes.tolist() == [250, 500, 750, 1000, 1250]
    low, high = np.array([-0.1, -0.1, -0.8]), np.array([0.3, 0.1, 0.8])
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    np.testing.assert_allclose(drawn.min(axis=0), low, atol=0.05 * (high - low).max())
    np.testing.assert_allclose(drawn.max(axis=0), high, atol=0.05 * (high - low).max())


def test_walk_fixed_components_leave_the_others_at_zero() -> None:
    np.testing.assert_array_equal(np.unique(commands({"vx": "0.6"}), axis=0), [[0.6, 0, 0]])
    partly = commands({"vx": "0:0.2", "yaw_rate": "0.3"})
    assert np.unique(partly[:, 0]).size == 6
    assert np.unique(partly[:, 1:], axis=0).tolist() == [[0.0, 0.3]]


def test_walk_episodes_follow_the_generator_alone() -> None:
    np.testing.assert_array_equal(commands({}, 3), commands({}, 3))
    assert not np.array_equal(commands({}, 3), commands({}, 4))
    np.testing.assert_array_equal(commands({}, 3), commands({"push": "0.3"}, 3))  # pushed or not: the same walk


def pushes(settings: dict[str, str], seed: int = 0) -> dict[int, Array]:
    task = Drawn(load_task("walk", settings, DT), seed)
    return {tick: push for tick, push in task.episode.pushes.items() if tick < 1500}


def test_pushes_come_every_second_in_all_directions() -> None:
    assert pushes({}) == {}
    drawn = pushes({"push": "0.3"})
    assert list(drawn) == list(range(50, 1500, 50))
    np.testing.assert_allclose([np.linalg.norm(push) for push in drawn.values()], 0.3)
    assert len({(push[0] > 0, push[1] > 0) for push in drawn.values()}) == 4
    sizes = [np.linalg.norm(push) for seed in range(20) for push in pushes({"push": "0:0.4"}, seed).values()]
    assert max(sizes) <= 0.4
    assert np.mean(sizes) == pytest.approx(0.2, abs=0.02)


def test_velocity_error_ignores_sway_and_settling_but_not_bias() -> None:
    ticks = np.arange(1500)
    command = np.zeros((1500, 3))
    command[:, 0] = np.where(ticks < 750, 0.2, -0.1)
    sway = 0.1 * np.sin(2 * np.pi * ticks / 24)  # one gait cycle is 24 ticks
    velocity = np.stack([command[:, 0], sway], axis=-1)
    velocity[750:850, 0] = 0.2  # slow to follow: within the 2 s that do not count
    assert measures.velocity_error(trace(velocity, command), 0.48) == pytest.approx(0.0, abs=1e-12)
    biased = velocity + np.array([0.03, -0.04])
    assert measures.velocity_error(trace(biased, command), 0.48) == pytest.approx(0.05)
    late = velocity.copy()
    late[850:874, 0] += 0.29  # one whole cycle of the 27 + 27 that count
    assert measures.velocity_error(trace(late, command), 0.48) == pytest.approx(0.29 / 54)
    assert np.isnan(measures.velocity_error(trace(velocity[:100], command[:100]), 0.48))


def test_top_speed_is_that_of_two_seconds() -> None:
    velocity = np.zeros((500, 2))
    velocity[100:200, 0] = 0.5
    velocity[300:320, 0] = 2.0  # a stumble forward is not walking
    assert measures.top_speed(trace(velocity)) == pytest.approx(0.5)
    assert np.isnan(measures.top_speed(trace(velocity[:50])))


def test_different_motions_are_counted_once_a_robot_is_left_alone() -> None:
    """Two seconds each: what it was told at first, and what lasted less, is none of its own."""
    velocity = np.zeros((1000, 2))
    velocity[:200, 0] = -0.1  # told
    velocity[200:400, 0] = velocity[800:, 0] = 0.2
    velocity[600:800, 1] = 0.1
    assert Drawn(load_task("survive", {}, DT)).metrics(trace(velocity))["motions"] == 3.0


def test_walk_fails_by_falling() -> None:
    task = Drawn(load_task("walk", {}, DT))
    run = trace(np.full((1500, 2), [0.1, 0.0]), np.full((1500, 3), [0.1, 0.0, 0.0]))
    assert task.success(run)
    assert not task.success(replace(run, fallen=True))
    assert task.metrics(run)["distance_m"] == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize(("name", "asked", "slow"), [("walk", 0.3, 0.25), ("perturb", 0.2, 0.1)])
def test_walking_is_not_standing_still(name: str, asked: float, slow: float) -> None:
    task, command = Drawn(load_task(name, {}, DT)), np.full((1500, 3), [asked, 0.0, 0.0])
    assert task.success(trace(np.full((1500, 2), [slow, 0.0]), command))
    still = trace(np.zeros((1500, 2)), command)
    assert not task.success(still)
    assert task.success(replace(still, command=np.zeros((1500, 3))))  # nothing else was asked
    assert Drawn(load_task("survive", {}, DT)).success(still)  # nothing is asked there
    assert Drawn(load_task(name, {"tolerance": "none"}, DT)).success(still)
    short = trace(np.zeros((50, 2)), command[:50])
    assert task.success(short)  # no cycle of it counts


# --- stand


def test_stand_allows_ten_centimetres() -> None:
    task = Drawn(load_task("stand", {}, DT))
    assert task.instruct(0, state(), NOTHING).velocity.tolist() == [0, 0, 0]
    still = np.zeros((500, 3))
    still[:, 0] = 5.0  # where it began does not matter
    near, far = still.copy(), still.copy()
    near[200, 1], far[200, 1] = 0.09, 0.11  # coming back does not excuse it
    velocity = np.zeros((500, 2))
    assert task.success(trace(velocity, displacement=near))
    assert not task.success(trace(velocity, displacement=far))
    assert not task.success(trace(velocity, displacement=near, fallen=True))


# --- goal


@pytest.mark.parametrize("distance", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("bearing", np.linspace(-np.pi, np.pi, 13))
def test_goal_profile_drives_a_point_to_any_bearing(distance: float, bearing: float) -> None:
    """A body that does what it is told, half a second late, arrives, stops and stays."""
    x, y = distance * np.cos(bearing), distance * np.sin(bearing)
    task = Drawn(load_task("goal", {"x": str(x), "y": str(y)}, DT))
    pose, velocity, rows = np.zeros(3), np.zeros(3), []
    profile = SpeedProfile()
    for tick in range(3000):
        now = state(pose[0], pose[1], pose[2], tuple(velocity), tick)
        command = task.instruct(tick, now, task.percept(now)).velocity
        assert -profile.reverse <= command[0] <= profile.speed
        assert abs(command[1]) <= profile.lateral
        assert abs(command[2]) <= profile.yaw_rate
        velocity = velocity + (command - velocity) * DT / 0.25
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + DT * np.array(
            [cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1], velocity[2]]
        )
        rows.append(np.concatenate([pose, velocity]))
        if task.done(now):
            break
    table = np.array(rows)
    run = replace(
        trace(table[:, 3:5]), displacement=np.pad(table[:, :2], ((0, 0), (0, 1))), yaw=table[:, 2], yaw_rate=table[:, 5]
    )
    assert len(table) * DT < 20.0
    assert task.success(run)
    result = task.metrics(run)
    assert result["final_distance_m"] < 0.07
    assert result["path_m"] < 1.5 * distance + 0.1
    assert result["seconds_to_goal"] < len(table) * DT - 0.5


def test_goal_is_drawn_at_every_bearing_and_told_in_the_heading_frame() -> None:
    task, goals = load_task("goal", {}, DT), []
    for seed in range(200):
        goals.append(Drawn(task, seed).percept(state()).goal)
    distance = np.linalg.norm(goals, axis=1)
    assert distance.min() >= 0.5
    assert distance.max() <= 1.5
    assert np.ptp(distance) > 0.9
    counts = np.bincount((np.arctan2(*np.transpose(goals)) // (np.pi / 2) + 2).astype(int))
    assert counts.min() > 30
    task = Drawn(load_task("goal", {"x": "1", "y": "2"}, DT))
    now = state(1.0, 1.0, np.pi / 2)
    np.testing.assert_allclose(task.instruct(0, now, task.percept(now)).goal, [1.0, 0.0], atol=1e-12)


def test_goal_stops_with_hysteresis() -> None:
    """Without it an estimate that wanders by a millimetre would start and stop the robot at every tick."""
    task = Drawn(load_task("goal", {"x": "1", "arrive": "0.04", "leave": "0.07"}, DT))
    moving = []
    for tick, x in enumerate([0.95, 0.97, 0.94, 0.935, 0.92, 0.94]):
        now = state(x, tick=tick)
        moving.append(bool(task.instruct(tick, now, task.percept(now)).velocity.any()))
    assert moving == [True, False, False, False, True, True]


def test_goal_is_not_done_while_moving() -> None:
    task = Drawn(load_task("goal", {"x": "0.02"}, DT))
    for tick in range(200):
        now = state(velocity=(0.11, 0, 0) if tick < 100 else (0, 0, 0), tick=tick)
        task.instruct(tick, now, task.percept(now))
        done = task.done(now)
        assert done == (tick >= 155), tick  # 1 s after the 0.2 s average is down to 0.05 m/s
        if done:
            break


def test_goal_success_needs_place_and_rest() -> None:
    task = Drawn(load_task("goal", {"x": "1"}, DT))
    there = np.tile([1.05, 0.0, 0.0], (200, 1))
    noise = np.random.default_rng(0).normal(scale=0.05, size=(200, 2))
    assert task.success(trace(noise, displacement=there))  # an estimate's noise is not motion
    assert not task.success(trace(noise + np.array([0.1, 0]), displacement=there))
    assert not task.success(trace(noise, displacement=there + np.array([0.1, 0, 0])))
    assert not task.success(trace(noise, displacement=there, fallen=True))
    assert not task.success(trace(noise[:20], displacement=there[:20]))  # not yet standing for 1 s
    assert not task.success(trace(noise[:0], displacement=there[:0]))


# --- guidance


def test_constant_twist_equals_small_steps() -> None:
    times = np.linspace(0.1, 3.0, 7)
    for twist in ([0.3, 0.1, 0.8], [0.2, -0.1, 0.0], [0.1, 0.05, -2.5], [0.3, 0.1, 1e-9]):
        place, yaw = integrate_twist(np.array(twist), times)
        for t, expected, angle in zip(times, place, yaw, strict=True):
            heading = twist[2] * (np.arange(20000) + 0.5) / 20000 * t
            x = np.mean(np.cos(heading) * twist[0] - np.sin(heading) * twist[1]) * t
            y = np.mean(np.sin(heading) * twist[0] + np.cos(heading) * twist[1]) * t
            np.testing.assert_allclose(expected, [x, y], atol=1e-8)
            assert angle == pytest.approx(twist[2] * t)


def follows(twist: Array, batch: int = 3, horizon: int = 16) -> Trajectory:
    """Trajectories that move with `twist` exactly."""
    place, yaw = integrate_twist(twist, DT * np.arange(1, horizon + 1))
    expand = lambda values: np.broadcast_to(values, (batch, *values.shape)).copy()  # noqa: E731
    return Trajectory(
        displacement=expand(place),
        yaw=expand(yaw),
        velocity=expand(np.tile(twist[:2], (horizon, 1))),
        yaw_rate=expand(np.full(horizon, twist[2])),
        height=expand(np.full(horizon, 0.26)),
        gravity=expand(np.tile([0.0, 0.0, -1.0], (horizon, 1))),
        joints=expand(np.zeros((horizon, 20))),
        ticks=np.arange(1, horizon + 1),
        dt=DT,
    )


@pytest.mark.parametrize("name", ["stand", "walk", "goal"])
def test_cost_is_zero_on_the_instructed_twist_and_grows_away_from_it(name: str) -> None:
    task = Drawn(load_task(name, {}, DT), 1)
    instruction = task.instruct(0, state(), task.percept(state()))
    exact = follows(instruction.velocity)
    assert task.objective is not None
    cost = task.objective(exact, instruction)
    assert cost.shape == (3,)
    np.testing.assert_allclose(cost, 0.0, atol=1e-12)
    off = [float(task.objective(follows(instruction.velocity + size), instruction)[0]) for size in (0.05, 0.1, 0.2)]
    assert 0 < off[0] < off[1] < off[2]


def test_sway_about_the_instructed_twist_costs_nothing() -> None:
    twist = np.array([0.2, 0.0, 0.0])
    moved = follows(twist)
    horizon = moved.yaw.shape[-1]
    moved.velocity[..., 1] += 0.2 * np.sin(2 * np.pi * np.arange(1, horizon + 1) / horizon)
    assert twist_cost(moved, twist, Weights())[0].max() < 1e-12


def test_cost_weighs_each_part_and_keeps_batches_apart() -> None:
    twist = np.array([0.2, 0.0, 0.5])
    moved = follows(twist)
    moved.displacement[1] += 0.1
    moved.yaw_rate[2] += 2.0
    cost, slope = twist_cost(moved, twist, Weights(velocity=1, yaw_rate=0.5, displacement=3, yaw=1))
    np.testing.assert_allclose(cost, [0.0, 3 * 2 * 0.01, 0.5 * 4.0], atol=1e-7)
    gradient = slope["displacement"]
    assert abs(gradient[0]).max() < 1e-12
    np.testing.assert_allclose(gradient[1, -1], 3 * 2 * 0.1)
    assert abs(gradient[1, :-1]).max() < 1e-12  # only the end counts
    # one instruction for each of a batch
    each, _ = twist_cost(moved, np.stack([twist, twist, twist + np.array([0, 0, 2.0])]), Weights(0, 1, 0, 0))
    np.testing.assert_allclose(each, [0.0, 0.0, 0.0], atol=1e-9)


def test_survival_sets_a_robot_in_motion_and_then_tells_a_planner_nothing() -> None:
    """Left alone at rest, a model that has seen standing stands for 3000 ticks: no survival of anything."""
    task = Drawn(load_task("survive", {}, DT))
    begun = task.instruct(0, state(), NOTHING)
    assert begun.text == caption(begun.velocity, load_robot().walking.scale)
    assert begun.text != caption(np.zeros(3), load_robot().walking.scale)
    assert task.instruct(149, state(), NOTHING).text == begun.text
    asked = task.instruct(150, state(), NOTHING)
    assert asked.text == ""
    assert np.abs(asked.velocity).max() > 0.0, "what policies walk by that do not plan"
    assert not any(getattr(task.settings.cost, name) for name in ("velocity", "displacement", "yaw", "stand", "goal"))
