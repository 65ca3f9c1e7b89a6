"""The tasks after the papers: what they ask, what they cost, and how a finished run is judged."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from task_bodies import Drawn, moves, state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import MOTIONS
from servoid.stack.navigation.potential_field import FieldSettings, PotentialField
from servoid.stack.tasks import load_settings, load_task
from servoid.tools.learn.collect.skills import skills_of

DT = 0.02
NOTHING = Percept(source="task", age=0.0)


def drive(task: Drawn, seconds: float, see: bool = True) -> Trace:
    """A body that at once does what it is told, and sees the pillars of the task's scene."""
    pose, rows = np.zeros(3), []
    for tick in range(round(seconds / DT)):
        now = state(*pose)
        percept = task.percept(now)
        command = task.instruct(tick, now, percept).velocity
        rows.append((pose.copy(), command, percept.obstacles))
        if task.done(now):
            break
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        forward, left, turn = command
        pose = pose + DT * np.array([cos * forward - sin * left, sin * forward + cos * left, turn])
    poses, commands = np.array([pose for pose, _, _ in rows]), np.array([command for _, command, _ in rows])
    obstacles = [seen for _, _, seen in rows]
    return Trace(
        dt=DT,
        displacement=np.pad(poses[:, :2], ((0, 0), (0, 1))),
        yaw=poses[:, 2],
        velocity=np.pad(commands[:, :2], ((0, 0), (0, 1))),
        yaw_rate=commands[:, 2],
        command=commands,
        fallen=False,
        obstacles=np.array(obstacles) if see and obstacles[0] is not None else None,
    )


# --- forest


def test_field_has_no_trap() -> None:
    """Behind a wall across the straight way, a plain potential would hold the robot for ever."""
    wall = np.array([[0.6, y, 0.05] for y in np.linspace(-0.5, 0.5, 9)])
    goal, place = np.array([1.2, 0.0]), np.zeros(2)
    field = PotentialField(goal, wall, place, FieldSettings())
    nearest, steps = np.inf, 0
    while np.linalg.norm(place - goal) > 0.1 and steps < 400:
        way = field.downhill(place) - place
        place = place + 0.02 * way / np.linalg.norm(way)
        nearest = min(nearest, float((np.linalg.norm(wall[:, :2] - place, axis=1) - 0.05).min()))
        steps += 1
    assert steps < 400
    assert nearest > 0.12  # the robot is 0.17 m to each side; the grid is 0.05 m


@pytest.mark.parametrize("seed", range(4))
def test_forest_is_crossed_by_a_body_that_obeys(seed: int) -> None:
    task = Drawn(load_task("forest", {}, DT), seed)
    run = drive(task, 40.0)
    scene = task.scene
    assert scene is not None
    assert scene.pillars.shape == (15, 3)
    assert (scene.pillars[:, 2] == 0.05).all()
    assert (np.abs(scene.pillars[:, 1]) <= 1.1).all()
    assert ((scene.pillars[:, 0] > 0.35) & (scene.pillars[:, 0] < 2.85)).all()
    ends = np.stack([np.zeros(2), scene.goal])
    assert np.linalg.norm(scene.pillars[:, None, :2] - ends, axis=-1).min() > 0.35
    assert task.success(run)
    assert task.metrics(run)["clearance_m"] > 0.08
    assert not task.success(replace(run, touched=True))
    assert not task.success(replace(run, fallen=True))
    through = replace(run, obstacles=np.broadcast_to([[*run.displacement[50, :2], 0.05]], (len(run.yaw), 1, 3)))
    assert not task.success(through)  # by the estimate alone: its base was inside a pillar
    assert not task.success(replace(run, displacement=run.displacement[:-200], obstacles=run.obstacles[:-200]))
    assert task.metrics(run)["seconds_to_goal"] == pytest.approx(DT * len(run.yaw))
    for failed in (replace(run, touched=True), replace(run, fallen=True)):  # there, but no success
        assert np.isnan(task.metrics(failed)["seconds_to_goal"])


def test_forest_leaves_room_at_both_ends_whatever_the_clearing() -> None:
    task = load_task("forest", {"clearing": "0"})
    for seed in range(40):
        scene = task.scenario(np.random.default_rng(seed)).scene
        assert scene is not None
        assert scene.goal is not None
        ends = np.stack([np.zeros(2), scene.goal])
        assert np.linalg.norm(scene.pillars[:, None, :2] - ends, axis=-1).min() > 0.05 + 0.17


def test_forest_tells_goal_and_pillars_in_the_heading_frame() -> None:
    task = Drawn(load_task("forest", {"places": "1,0,0.05", "x": "2", "y": "0"}, DT))
    now = state(1.0, -0.5, np.pi / 2)
    told = task.instruct(0, now, task.percept(now))
    np.testing.assert_allclose(told.obstacles, [[0.5, 0.0, 0.05, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(told.goal, [0.5, -1.0], atol=1e-12)


def test_forest_refuses_what_cannot_be() -> None:
    with pytest.raises(ConfigError, match=r"goal at x=1, y=0 is inside the pillar at x=1, y=0\.1"):
        load_task("forest", {"places": "1,0.1,0.05", "x": "1", "y": "0"})
    with pytest.raises(ConfigError, match=r"start at x=0, y=0 is inside the pillar at x=0\.1, y=0"):
        load_task("forest", {"places": "0.1,0,0.05"})
    with pytest.raises(ConfigError, match="radius of a pillar must be positive"):
        load_task("forest", {"places": "1,0,0.05:1,0.5,-0.05"})
    wall = ":".join(f"3.2,{y:g},0.1" for y in np.linspace(-0.6, 0.6, 5))  # wherever behind the forest the goal is drawn
    with pytest.raises(
        ConfigError, match=r"goal at x=3\.2, y=\S+ is inside the pillar at x=3\.2.*fix the goal by x and y"
    ):
        load_task("forest", {"places": wall}).scenario(np.random.default_rng(0))
    task = load_task("forest", {"pillars": "200"})
    with pytest.raises(ConfigError, match=r"200 pillars 0\.3 m apart do not fit into 2\.2 by 2\.5 m"):
        task.scenario(np.random.default_rng(0))
    with pytest.raises(ConfigError, match="did you mean 'pillars'"):
        load_task("forest", {"pilars": "3"})


# --- obstacle


@pytest.mark.parametrize("bearing", np.linspace(-3.0, 3.0, 7))
def test_obstacle_is_escaped_from_any_side(bearing: float) -> None:
    task = Drawn(load_task("obstacle", {"bearing": str(bearing)}, DT))
    run = drive(task, 40.0)
    assert np.linalg.norm(run.obstacles[0, 0, :2]) == pytest.approx(0.55)
    assert task.success(run)
    assert 0.1 < task.metrics(run)["clearance_m"] < 0.46
    assert not task.success(replace(run, touched=True))
    early = replace(run, displacement=run.displacement[:50], obstacles=run.obstacles[:50])
    assert not task.success(early)  # not yet away


def test_obstacle_rolls_toward_the_robot_and_is_told_with_its_velocity() -> None:
    task = Drawn(load_task("obstacle", {"bearing": "0"}, DT))
    first = task.percept(state()).obstacles
    second = task.percept(state()).obstacles
    np.testing.assert_allclose(second[0, :2] - first[0, :2], [-0.08 * DT, 0.0], atol=1e-12)
    told = task.instruct(0, state(), Percept("scene", 0.0, obstacles=np.array([[0.0, 0.5, 0.1]])))
    np.testing.assert_allclose(told.obstacles, [[0.0, 0.5, 0.1, 0.0, -0.08]], atol=1e-12)
    with pytest.raises(ConfigError, match=r"sphere_speed: 0\.3 must be below speed"):
        load_task("obstacle", {"sphere_speed": "0.3"})


# --- velocity


def test_demonstrations_are_asked_for_all_velocities_of_the_task() -> None:
    fastest = max(box.forward[1] for skill in skills_of(load_robot()) for box in skill.boxes)
    assert load_settings("velocity").speed[1] <= fastest


def test_velocity_is_followed_over_the_ground() -> None:
    task = Drawn(load_task("velocity", {"speed": "0.05:0.25"}, DT))
    run = drive(task, 183.0)
    assert len(np.unique(np.round(task.episode.velocity, 9), axis=0)) == 22 - (22 * 8.7 > 183.0 + 8.7)
    result = task.metrics(run)
    assert result["velocity_error_mps"] < 0.005  # what is turned on the way is over before it counts
    assert task.success(run)
    wrong = replace(run, velocity=run.velocity + np.array([0.0, 0.06, 0.0]))
    assert task.metrics(wrong)["velocity_error_mps"] == pytest.approx(0.06, abs=0.01)
    assert not task.success(wrong)
    turned = replace(run, yaw=run.yaw + 0.5)  # facing, and so walking, another way
    assert task.metrics(turned)["velocity_error_mps"] > 0.03


def test_velocities_that_a_fall_left_undone_count_as_not_walked() -> None:
    """Else the sooner a robot falls, the fewer velocities it is measured by."""
    task = Drawn(load_task("velocity", {"speed": "0.2", "seconds": "17.4"}, DT))
    run = drive(task, 17.4)
    half = replace(run, velocity=run.velocity[:435], yaw=run.yaw[:435])  # the first of two
    for fallen in (True, False):  # be it by a fall or by the guard
        assert task.metrics(replace(half, fallen=fallen))["velocity_error_mps"] == pytest.approx(0.1, abs=0.003)
    never = replace(run, velocity=run.velocity[:0], yaw=run.yaw[:0], displacement=run.displacement[:0])
    assert task.metrics(never)["velocity_error_mps"] == pytest.approx(0.2)
    assert not task.success(never)


# --- path


def test_a_fine_tolerance_leaves_the_end_of_a_path_to_be_come_to() -> None:
    task = Drawn(load_task("path", {"shape": "s", "tolerance": "0.01"}, DT))
    assert len(drive(task, 60.0).yaw) * DT < 50.0  # it ends there, and not when time runs out


@pytest.mark.parametrize(
    "settings", [{"shape": "s"}, {"shape": "circle"}, {"shape": "waypoints", "waypoints": "0.5,0:0.5,0.5:0,0.5"}]
)
def test_path_is_followed_by_a_body_that_obeys(settings: dict[str, str]) -> None:
    task = Drawn(load_task("path", settings, DT))
    run = drive(task, 60.0)
    result = task.metrics(run)
    assert task.success(run)
    assert result["path_error_m"] < 0.03
    assert result["path_m"] > 0.9 * result["length_m"]
    beside = replace(run, displacement=run.displacement + np.array([0.0, 0.3, 0.0]))
    assert not task.success(beside)
    assert not task.success(replace(run, displacement=run.displacement[: len(run.yaw) // 2]))  # only half of it


@pytest.mark.parametrize(
    "settings", [{"shape": "circle"}, {"shape": "waypoints", "waypoints": "0.8,0:0.8,0.8:0,0.8:0,0"}]
)
def test_a_closed_path_is_not_followed_by_standing_where_it_ends(settings: dict[str, str]) -> None:
    task = Drawn(load_task("path", settings, DT))
    run = drive(task, 60.0)
    assert task.success(run)
    sway = 0.02 * np.sin(np.arange(len(run.yaw)))[:, None] * [1.0, 1.0, 0.0]
    stood = replace(run, displacement=sway)
    assert task.metrics(stood)["final_distance_m"] < 0.03
    assert task.metrics(stood)["left_m"] > 0.9 * task.metrics(stood)["length_m"]
    assert not task.success(stood)
    back = np.concatenate([run.displacement[:200], run.displacement[200::-1]])  # out along it, and home the same way
    assert not task.success(replace(run, displacement=back))


def test_path_shapes() -> None:
    s, circle = Drawn(load_task("path", {}, DT)), Drawn(load_task("path", {"shape": "circle"}, DT))
    points = s.episode.path
    np.testing.assert_allclose(points[-1], [0.0, 1.6], atol=0.01)
    assert points[:, 0].max() == pytest.approx(0.4, abs=0.01)
    assert points[:, 0].min() == pytest.approx(-0.4, abs=0.01)
    np.testing.assert_allclose(circle.episode.path[-1], [0.0, 0.0], atol=1e-9)
    told = s.instruct(0, state(), s.percept(state()))
    np.testing.assert_allclose(np.linalg.norm(told.path[49]), 0.15, atol=0.011)  # 1 s at 0.15 m/s
    with pytest.raises(ConfigError, match="waypoints: give one or more"):
        load_task("path", {"waypoints": "0,0", "shape": "waypoints"})
    with pytest.raises(ConfigError, match="expected a number"):
        load_task("path", {"waypoints": "1,x"})
    with pytest.raises(ConfigError, match="one of s, circle, waypoints"):
        load_task("path", {"shape": "spiral"})


# --- goals seen, perturbed walking, survival


def test_goal_near_and_far_need_no_rest_and_are_seen() -> None:
    for name, low, high in (("goal-near", 0.28, 0.55), ("goal-far", 0.55, 1.65)):
        task = Drawn(load_task(name, {}, DT), 3)
        run = drive(task, 40.0)
        goal = task.scene.goal
        assert low <= np.linalg.norm(goal) <= high
        assert task.success(run)
        assert task.name == name
        off = replace(run, displacement=run.displacement - np.array([0.0, 0.2, 0.0]))
        assert not task.success(off)
        assert task.success(replace(off, goal=np.broadcast_to(goal - [0, 0.2], (len(run.yaw), 2))))
    assert Drawn(load_task("goal", {})).scene is None


def test_perturb_pushes_each_second_of_a_walk_ahead() -> None:
    task = Drawn(load_task("perturb", {}, DT))
    assert list(task.episode.pushes) == list(range(50, 1501, 50))
    assert task.instruct(700, state(), NOTHING).velocity.tolist() == [0.2, 0.0, 0.0]


# --- text


def test_text_changes_every_five_seconds_with_held_out_words() -> None:
    task = Drawn(load_task("text", {}, DT), 2)
    told = [task.instruct(tick, state(), NOTHING) for tick in range(1500)]
    texts = [instruction.text for instruction in told]
    assert [i for i in range(1, 1500) if texts[i] != texts[i - 1]] == [250, 500, 750, 1000, 1250]
    for text, instruction in zip(texts[::250], told[::250], strict=True):
        (motion,) = [motion for motion in MOTIONS if text in motion.held_out]
        assert instruction.velocity.tolist() == (motion.typical * load_robot().walking.scale).tolist()


def test_text_is_judged_by_the_measured_motion() -> None:
    task = Drawn(load_task("text", {}, DT), 2)
    run = drive(task, 30.0)
    assert task.metrics(run)["followed_share"] == 1.0
    assert task.success(run)
    away = slice(250, 500)  # it did something else for one sentence
    wrong = run.velocity.copy(), run.yaw_rate.copy()
    wrong[0][away], wrong[1][away] = -run.velocity[away] - [0.1, 0, 0], -run.yaw_rate[away]
    failed = replace(run, velocity=wrong[0], yaw_rate=wrong[1])
    assert task.metrics(failed)["followed_share"] == pytest.approx(5 / 6)
    assert not task.success(failed)


def test_text_counts_what_was_left_undone_as_not_followed() -> None:
    """Else a robot that does one sentence, and then falls or is stopped, would have done all that it was told."""
    task = Drawn(load_task("text", {}, DT), 2)
    run = drive(task, 30.0)
    first = replace(run, velocity=run.velocity[:260], yaw=run.yaw[:260], yaw_rate=run.yaw_rate[:260])
    for cut in (first, replace(first, fallen=True)):
        assert task.metrics(cut)["followed_share"] == pytest.approx(1 / 6)
        assert not task.success(cut)
    for ticks in (0, 50):
        assert task.metrics(replace(run, yaw=run.yaw[:ticks]))["followed_share"] == 0.0


def test_text_leaves_out_a_sentence_that_the_time_was_too_short_for() -> None:
    task = Drawn(load_task("text", {"seconds": "12"}, DT), 2)
    assert task.metrics(drive(task, 12.0))["followed_share"] == 1.0  # of two; 2 s of a third tell nothing
    task = Drawn(load_task("text", {"seconds": "2"}, DT), 2)
    assert np.isnan(task.metrics(drive(task, 2.0))["followed_share"])


def test_text_takes_a_sentence_and_refuses_an_empty_or_foreign_one() -> None:
    pytest.importorskip("wordllama")
    task = Drawn(load_task("text", {"sentence": "turn left on the spot"}, DT))
    told = task.instruct(900, state(), NOTHING)
    assert told.text == "turn left on the spot"
    assert told.velocity[2] > 0.0
    for sentence in ("", "gehe bitte geradeaus nach vorne"):
        with pytest.raises(ConfigError, match="--set sentence="):
            load_task("text", {"sentence": sentence})
        with pytest.raises(ConfigError, match="--set text="):
            load_task("goal", {"text": sentence})


def test_a_goal_can_be_gone_to_in_a_manner_that_a_sentence_names() -> None:
    pytest.importorskip("wordllama")
    task = Drawn(load_task("goal", {"x": "1", "text": "walk forward slowly"}, DT))
    assert task.instruct(0, state(), NOTHING).text == "walk forward slowly"
    assert task.instruct(1, state(0.99), NOTHING).text is None  # there, it is told to stand
    with pytest.raises(ConfigError, match="reaches no goal"):
        load_task("goal", {"text": "stand still"}, DT)


def test_velocity_says_what_is_asked_over_the_ground_wherever_the_robot_faces() -> None:
    task = Drawn(load_task("velocity", {"speed": "0.2", "turn": "0"}, DT))
    np.testing.assert_allclose(task.instruct(0, state(yaw=np.pi / 2), NOTHING).ground, [0.0, -0.2], atol=1e-12)


@pytest.mark.parametrize("name", ["forest", "obstacle", "cross", "path", "velocity"])
def test_costs_can_be_sent_to_the_planner_with_gradients(name: str) -> None:
    """A planner in a process of its own is given the cost; it has a gradient on every trajectory."""
    task = Drawn(load_task(name, {}, DT))
    now = state(0.1, 0.05, 0.3)
    instruction = task.instruct(0, now, task.percept(now))
    trajectory = moves(0.01 * np.arange(48).reshape(24, 2))
    cost, slope = pickle.loads(pickle.dumps(task.objective)).slope(trajectory, instruction)
    assert cost.shape == (1,)
    assert np.isfinite(slope["displacement"]).all()
    assert (slope["displacement"] != 0).any()
