"""Stories: acts by the truth, the state machine, what is seen no more, and plans that cannot be."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.policy.diffusion.prefix.planning import HIGHEST
from servoid.stack.runtime.run import RunSettings
from servoid.stack.tasks import load_task
from servoid.stack.tasks.stories.condition import Moment, moments
from servoid.stack.tasks.stories.layout import CLEAR
from servoid.stack.tasks.stories.machine import Machine
from servoid.stack.tasks.stories.standstill import STAND_SECONDS
from servoid.stack.tasks.stories.story import Story
from servoid.stack.tasks.stories.told import StoryEpisode
from servoid.tools.evaluate.judge import judge

ROBOT = load_robot()
STANDS = round(STAND_SECONDS / ROBOT.dt)  # ticks before a planner strikes
STANDING = StillEstimator(ROBOT).update(observation(ROBOT, 0, ROBOT.home), ROBOT.home)


def _story(**chosen: str) -> tuple[Story, StoryEpisode, Machine]:
    task = load_task("story", chosen, ROBOT.dt, ROBOT)
    assert isinstance(task, Story)
    episode = task.scenario(np.random.default_rng(0))
    behaviour = task.behaviour(episode)
    assert isinstance(behaviour, Machine)
    return task, episode, behaviour


def _poses(episode: StoryEpisode) -> Array:
    return np.array([
        [*thing.place, thing.height, np.cos(thing.heading / 2), 0.0, 0.0, np.sin(thing.heading / 2)]
        for thing in episode.objects
    ])  # fmt: skip


def _at(place: Array, heading: float) -> State:
    turn = np.array([np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)])
    return replace(
        STANDING, displacement=np.array([*place, ROBOT.standing_height]), yaw=np.array(heading), orientation=turn
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "chosen"),
    [
        ("strike", {"plan": "punch-left"}),
        ("strike", {"plan": "kick-right"}),
        ("rise", {}),
        ("sit", {"sit": "0.22,0.24", "least_bearing": "3.0"}),
    ],
)
def test_the_robot_does_what_it_is_asked_by_the_truth(task: str, chosen: dict[str, str]) -> None:
    judged = judge(RunSettings(task, policy="expert", seed=1, set=chosen))
    assert judged.row["success"], judged.assignment.criteria(judged.trace)
    assert judged.row["metrics"]["acts_share"] == 1.0
    assert not judged.row["fell_ending"], "a seat is in the way of whoever is lowered before it"
    assert judged.trace.objects is not None
    nothing = replace(judged.trace, objects=np.repeat(judged.trace.objects[:1], len(judged.trace.objects), 0))
    if task == "strike":
        assert not judged.assignment.success(nothing), "the bag still stands"
    else:
        away = nothing.objects.copy()  # type: ignore[union-attr]
        away[..., 0] += 0.3
        assert not judged.assignment.success(replace(nothing, objects=away)), "it squatted, and not on the seat"
    assert not judged.assignment.success(replace(judged.trace, fallen=True))


def test_acts_begin_when_those_before_them_are_done_and_are_judged_in_their_order() -> None:
    _, episode, machine = _story(plan="reach,reach")
    first, second = (_at(point[:2], 0.0) for point in episode.points)
    asked = [machine.instruct(tick, STANDING, Percept("task", 0.0)) for tick in range(5)]
    assert np.linalg.norm(asked[-1].velocity) > 0.05
    ticks = 5
    for state in (first, second):
        for _ in range(round(0.5 / ROBOT.dt) + 2):
            instruction = machine.instruct(ticks, state, Percept("task", 0.0))
            assert instruction.stand or instruction.velocity.any(), (
                "what walks to places is asked for none, or to stand"
            )
            ticks += 1
    told = [text.split(",")[0] for text in machine.take_events()]
    assert told == ["'reach' is done", "'reach' is done"]
    assert instruction.stand
    assert not machine.done(second)
    for _ in range(round(1.0 / ROBOT.dt) + 1):
        machine.instruct(ticks, second, Percept("task", 0.0))
        ticks += 1
    assert machine.done(second)


def test_whoever_has_risen_steps_away_from_the_seat_before_the_story_ends() -> None:
    """Lowered just before it, its back met the seat, and it tipped over."""
    _, episode, machine = _story(plan="sit,rise")
    seen, seat = Percept("scene", 0.0, objects=_poses(episode)), episode.objects[0]
    ahead = np.array([np.cos(seat.heading), np.sin(seat.heading)])

    def before(edge: float) -> State:
        return _at(np.array(seat.place) + (seat.size[0] / 2 + edge) * ahead, seat.heading)

    low = np.array([*before(-0.02).displacement[:2], seat.size[2] + 0.05])
    for tick in range(60):
        machine.instruct(tick, replace(before(-0.02), displacement=low), seen)
    for tick in range(60, 90):
        asked = machine.instruct(tick, before(0.01), seen)
    assert [text.split(",")[0] for text in machine.take_events()] == ["'sit' is done", "'rise' is done"]
    assert asked.velocity[0] > 0.03
    assert not machine.done(before(0.01))
    assert machine.instruct(90, before(0.18), seen).stand
    for tick in range(91, 142):
        assert machine.instruct(tick, before(0.01), seen).stand, "once it rests it stays"
    assert machine.done(before(0.18))


def test_an_act_that_is_not_done_in_time_ends_the_story_and_says_so() -> None:
    _, _, machine = _story(plan="reach,sit")
    seen = None
    for tick in range(0, 1200):
        seen = machine.instruct(tick, STANDING, Percept("task", 0.0))
    assert machine.take_events() == ("'reach' is given up: not done within 20 s",)
    assert seen is not None
    assert seen.stand
    assert machine.done(STANDING)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda seen: replace(seen, objects=None), "the bag is not seen any more: the robot stands and waits"),
        (lambda seen: replace(seen, objects=seen.objects * np.nan), "the bag is not seen any more"),
        (lambda seen: replace(seen, age=0.8), "what is seen of the bag is 0.8 s old: the robot stands and waits"),
    ],
)
def test_what_is_not_seen_any_more_is_not_walked_to(change: object, said: str) -> None:
    """Where a camera lost the bag, the robot would walk into it, or punch the air."""
    _, episode, machine = _story(plan="punch")
    seen = Percept("scene", 0.0, objects=_poses(episode))
    assert not machine.instruct(0, STANDING, seen).stand
    for tick in (1, 2):
        lost = machine.instruct(tick, STANDING, change(seen))  # type: ignore[operator]
        assert lost.stand
        assert not lost.velocity.any()
    (text,) = machine.take_events()
    assert text.startswith(said)
    again = machine.instruct(3, STANDING, seen)
    assert not again.stand
    assert machine.take_events() == ("it is seen again",)


def test_words_ask_for_the_same_acts_by_a_sentence_and_by_where_parts_shall_be() -> None:
    _, episode, machine = _story(plan="punch-left", by="words")
    bag, seen = _poses(episode)[0], Percept("scene", 0.0, objects=_poses(episode))
    far = machine.instruct(0, STANDING, seen)
    assert far.skill is None
    assert far.goal is not None
    away = np.arctan2(bag[1], bag[0])
    spot = bag[:2] - 0.145 * np.array([np.cos(away), np.sin(away)]) + 0.045 * np.array([np.sin(away), -np.cos(away)])
    assert machine.instruct(1, _at(spot, float(away)), seen).stand
    near = machine.instruct(1 + STANDS, _at(spot, float(away)), seen)
    assert near.text == "punch with the left hand"
    assert near.targets is not None
    np.testing.assert_allclose(near.targets["left hand"], [0.145, 0.045, 0.33], atol=0.02)
    assert near.targets["left hand"][2] < HIGHEST * ROBOT.standing_height, "else nothing would be planned"


def test_near_the_seat_it_is_asked_to_turn_and_then_to_step_and_not_to_walk_there_anew() -> None:
    """A planner that is told to turn, and shown a place beside it, stumbles; turning it drifts away a little."""
    _, episode, machine = _story(plan="sit", by="words")
    seat, seen = episode.objects[0], Percept("scene", 0.0, objects=_poses(episode))
    out = np.array([np.cos(seat.heading), np.sin(seat.heading)])
    spot = np.array(seat.place) + (seat.size[0] / 2 + 0.1) * out

    def asked(tick: int, away: float, turned: float) -> Instruction:
        return machine.instruct(tick, _at(spot + away * out, seat.heading - turned), seen)

    assert asked(0, 0.2, 1.0).goal is not None
    turning = asked(1, 0.1, 1.0)
    assert turning.targets is not None
    np.testing.assert_allclose(turning.targets["ground"], 0.0)
    np.testing.assert_allclose(turning.targets["heading"], 1.0, atol=1e-6)
    assert turning.velocity[2] > 0.0
    assert not turning.velocity[:2].any()
    stepping = asked(2, 0.1, 0.0)
    assert stepping.targets is not None
    np.testing.assert_allclose(stepping.targets["ground"], [-0.1, 0.0], atol=1e-6)
    assert stepping.velocity[0] < 0.0
    assert asked(3, 0.2, 1.0).goal is None
    assert asked(4, 0.3, 1.0).goal is not None


def test_rest_is_told_by_legs_and_lean_and_not_by_arms() -> None:
    legs = ROBOT.leg_index.reshape(-1)
    joints = np.tile(ROBOT.home, (30, 1))
    joints[:, ROBOT.names.index("r_sho_pitch")] += 0.01 * np.arange(30)
    trace = Trace(
        dt=ROBOT.dt, displacement=np.zeros((30, 3)), yaw=np.zeros(30), velocity=np.zeros((30, 3)),
        yaw_rate=np.zeros(30), command=np.zeros((30, 3)), fallen=False, joints=joints,
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (30, 1)),
    )  # fmt: skip
    assert moments(trace, legs).still.all()
    joints[:, ROBOT.names.index("l_knee")] += 0.01 * np.arange(30)
    assert not moments(trace, legs).still[15:].any()


def test_words_ask_for_a_kick_to_its_end_though_the_bag_lies_before_that() -> None:
    """A planner knows no way back from one foot but that."""
    _, episode, machine = _story(plan="kick-left", by="words")
    standing, seen = _poses(episode), Percept("scene", 0.0, objects=_poses(episode))
    lying = standing.copy()
    lying[0, 3:] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    fallen = replace(seen, objects=lying)
    away = np.arctan2(standing[0, 1], standing[0, 0])
    spot = standing[0, :2] - 0.13 * np.array([np.cos(away), np.sin(away)])
    there = _at(spot + 0.05 * np.array([np.sin(away), -np.cos(away)]), float(away))
    machine.instruct(0, STANDING, seen)  # where it is to face is seen from afar
    machine.instruct(1, there, seen)
    assert machine.instruct(1 + STANDS, there, seen).text == "kick high with the left foot"
    assert machine.instruct(round(3.0 / ROBOT.dt), there, fallen).text == "kick high with the left foot"
    assert len(machine.take_events()) == 1
    assert machine.instruct(round(6.0 / ROBOT.dt), there, fallen).stand
    assert not machine.take_events(), "it is said once"
    _, _, early = _story(plan="kick-left", by="words")
    early.instruct(0, STANDING, seen)
    early.instruct(1, there, seen)
    assert early.instruct(1 + STANDS, there, seen).text == "kick high with the left foot"
    assert early.instruct(STANDS + round(0.3 / ROBOT.dt), there, fallen).stand, "it has not begun to kick"


def test_things_are_not_in_each_others_way() -> None:
    for seed in range(5):
        task, *_ = _story(plan="sit,rise,reach,punch,any,any")
        episode = task.scenario(np.random.default_rng(seed))
        places = np.array([thing.place for thing in episode.objects])
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[np.triu_indices(len(places), 1)]
        assert (apart >= CLEAR["bag"]).all()
        assert (np.linalg.norm(places, axis=1) >= CLEAR["bag"]).all(), "nor where the robot starts"


def test_a_point_lies_behind_where_that_is_asked_and_is_done_facing_as_it_says() -> None:
    settings = {"plan": "face", "least_bearing": "1.57", "push": "0.3,0.3", "seconds": "3"}
    for seed in range(5):
        task, *_ = _story(**settings)
        episode = task.scenario(np.random.default_rng(seed))
        assert abs(np.arctan2(episode.points[0, 1], episode.points[0, 0])) >= 1.57
        assert [tick * ROBOT.dt for tick in episode.pushes] == [1.0, 2.0, 3.0]
        np.testing.assert_allclose([np.linalg.norm(push) for push in episode.pushes.values()], 0.3)
        away = float(episode.headings[0])
        thing = episode.point(0, None)
        for off, done in ((0.2, True), (0.4, False), (2 * np.pi + 0.2, True)):
            there = _at(episode.points[0, :2], away + off)
            now = Moment(there.displacement, there.orientation, there.position, np.array(True))
            assert task.conditions.hold(episode.acts[0], now, thing, None) == done


def test_a_drawn_story_rises_where_it_sat() -> None:
    rng = np.random.default_rng(0)
    names = []
    task, *_ = _story(plan=",".join(["any"] * 6))
    for _ in range(10):
        names.append([act.name for act in task.scenario(rng).acts])
    assert any("sit" in story for story in names)
    for story in names:
        assert all(after == "rise" for before, after in pairwise(story) if before == "sit")


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"plan": "sit,punch"}, "'punch-(left|right)' begins standing: let rise come before it"),
        ({"plan": "rise"}, "'rise' begins on the seat: let sit come before it"),
        ({"plan": "fly"}, "unknown act 'fly'"),
        ({"plan": " , "}, "names no act"),
        ({"seat_height": "0.2,0.3"}, "a seat of 0.3 m is higher than the hip"),
        ({"touch": "0.3,0.6"}, "no hand reaches a point 0.6 m up"),
    ],
)
def test_a_story_that_cannot_be_is_refused(chosen: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_task("story", chosen, ROBOT.dt, ROBOT)


def test_a_point_is_where_the_seat_puts_it() -> None:
    """Odometry drifts while the robot sits: by it, the point after that would be missed."""
    _, episode, _ = _story(plan="sit,rise,reach")
    seen = _poses(episode)
    np.testing.assert_allclose(episode.point(2, seen)[:2], episode.points[2, :2])
    drifted = seen.copy()
    drifted[:, 0] += 0.3
    np.testing.assert_allclose(
        episode.point(2, np.stack([seen, drifted]))[:, 0] - episode.points[2, 0], [0, 0.3], atol=1e-9
    )
    np.testing.assert_allclose(episode.point(2, None)[:2], episode.points[2, :2])


def test_a_point_that_is_seen_is_where_its_mark_is() -> None:
    """By odometry alone, robots that slip come to a stand beside it, and believe to be there."""
    _, episode, machine = _story(plan="sit,rise,reach", seen="true")
    assert episode.scene is not None
    assert episode.scene.goal is not None
    np.testing.assert_array_equal(episode.scene.goal, episode.points[2, :2])
    seen = np.array([[1.0, 2.0], [np.nan, np.nan]])
    found = episode.point(2, None, seen)
    np.testing.assert_allclose(found[0, :2], seen[0])
    np.testing.assert_allclose(found[1, :2], episode.points[2, :2], err_msg="out of sight it is where it was drawn")
    _, episode, machine = _story(plan="reach", seen="true")
    for age, led in ((0.0, True), (3.0, False)):
        asked = machine.instruct(0, _at(np.zeros(2), 0.0), Percept("scene", age, goal=np.array([0.5, -0.1])))
        assert asked.goal is not None
        assert np.allclose(asked.goal, [0.5, -0.1]) == led, "what was seen long ago is not gone by"
    assert _story(plan="reach")[1].scene is None


def test_a_bag_is_struck_by_what_is_nearest_as_it_begins_to_fall() -> None:
    """A bag that the robot walks over falls, too, and was not struck by the hand that was told."""
    points = KeyPoints(ROBOT, whole=True)
    base, body = np.array([0.0, 0.0, ROBOT.standing_height]), dict(zip(points.names, points(ROBOT.home), strict=True))

    def told(plan: str, part: str, falls: bool = True) -> float:
        task, episode, _ = _story(plan=plan)
        place = base + body[part]
        bag = np.tile([*place[:2], episode.objects[0].height, 1.0, 0.0, 0.0, 0.0], (9, 1))
        bag[:, :2] += [0.05, 0.0] if part == "right toe" else [0.0, np.copysign(0.04, place[1])]
        bag[1, 3:] = [np.cos(0.05), 0.0, np.sin(0.05), 0.0]  # something brushes it, and it stands again
        if falls:
            bag[5:, 3:] = [np.cos(0.03), 0.0, np.sin(0.03), 0.0]
            bag[6:, 3:] = [np.cos(0.8), 0.0, np.sin(0.8), 0.0]
        joints, still = np.tile(ROBOT.home, (9, 1)), np.zeros((9, 3))
        joints[:3] += 0.3
        trace = Trace(
            ROBOT.dt, np.tile(base, (9, 1)), still[:, 0], still, still[:, 0], still, False, joints,
            np.tile([1.0, 0, 0, 0], (9, 1)), objects=bag[:, None],
        )  # fmt: skip
        return task.metrics(trace, episode)["struck_as_told"]

    assert told("punch-left", "left hand") == 1.0
    assert told("punch-left", "right hand") == 0.0
    assert told("punch-right", "right toe") == 0.0
    assert told("kick-right", "right toe") == 1.0
    assert told("kick-right", "right toe", falls=False) == 0.0


def test_before_it_strikes_a_robot_comes_to_a_stand_and_steps_again_where_it_went_on() -> None:
    """It went on by some centimetres as it stopped, and its toes walked the bag over."""
    _, episode, machine = _story(plan="punch-left", by="words")
    seen, bag, act = Percept("scene", 0.0, objects=_poses(episode)), np.array(episode.objects[0].place), episode.acts[0]
    assert act.approach is not None
    facing = float(np.arctan2(bag[1], bag[0]))
    ahead, left = np.array([np.cos(facing), np.sin(facing)]), np.array([-np.sin(facing), np.cos(facing)])

    def asked(tick: int, away: float = 0.0, aside: float = 0.0, turn: float = 0.0) -> Instruction:
        """So far farther off and to the left than where it strikes."""
        place = bag - (act.approach.ahead + away) * ahead - (act.approach.aside - aside) * left  # type: ignore[union-attr]
        return machine.instruct(tick, _at(place, facing + turn), seen)

    assert asked(0, away=0.1, aside=0.05).velocity.any()
    off = asked(1, aside=0.05)
    assert off.targets is not None
    assert off.targets["ground"][0] < -0.03, "aside of the bag it steps back first"
    assert asked(2, turn=0.25).targets["ground"][0] < -0.02, "and so where it is turned"  # type: ignore[index]
    for tick in range(3, 40):
        assert asked(tick, away=0.06).velocity[0] > 0.05
    assert asked(40, away=0.04).stand, "its steps go on: it stops before it is there"
    assert asked(60, away=-0.03).stand, "it is coming to a stand"
    assert asked(81, away=-0.03).velocity[0] < 0.0, "it came to a stand too near"
    assert asked(82).stand
    assert asked(123).text == act.sentence


def test_a_robot_that_stops_beside_a_point_walks_there_again() -> None:
    """It stood there until its time was over: nothing asked it to step back."""
    _, episode, machine = _story(plan="reach", by="words")
    point, percept = episode.points[0, :2], Percept("task", 0.0)
    assert machine.instruct(0, _at(point, 0.0), percept).text is not None, "it is there, and stands"
    beside = _at(point + np.array([0.07, 0.0]), 0.0)
    assert machine.instruct(10, beside, percept).goal is None, "it may still be coming to a stand"
    asked = machine.instruct(60, beside, percept)
    assert asked.goal is not None
    np.testing.assert_allclose(asked.goal, [-0.07, 0.0], atol=1e-9)
    assert machine.instruct(61, _at(point + np.array([0.04, 0.0]), 0.0), percept).goal is None
