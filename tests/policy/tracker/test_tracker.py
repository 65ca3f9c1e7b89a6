"""What the tracker sees and what it is paid for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.control import State
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.references.gait import Gait
from servoid.policy.tracker import rewards
from servoid.policy.tracker.observation import AHEAD, TrackerObservation
from servoid.policy.tracker.rewards import TERMS, Step
from servoid.tools.learn.settings import TrackingSettings
from servoid.tools.learn.terms import Terms

ROBOT = load_robot()


def state(position: Any = None, shape: tuple[int, ...] = (), **changes: Any) -> State:
    position = np.broadcast_to(ROBOT.home if position is None else position, (*shape, 20))
    zero = np.zeros((*shape, 3))
    values: dict[str, Any] = {
        "time_ns": 0,
        "orientation": zero,
        "gravity": zero - np.array([0, 0, 1]),
        "yaw": np.zeros(shape),
        "angular_velocity": zero,
        "velocity": zero,
        "displacement": zero + np.array([0, 0, 0.25]),
        "position": position,
        "joint_velocity": np.zeros_like(position),
        "contact": np.ones((*shape, 2)),
    }
    return State(**(values | changes))


def gait(shape: tuple[int, ...] = ()) -> Gait:
    return Gait(ROBOT, shape)


def test_it_does_not_see_the_command() -> None:
    """Only the reference says what to do, so that any reference can be tracked."""
    seen = []
    for command in (np.zeros(3), np.array([0.3, -0.1, 0.8])):
        walker, observe = gait(), TrackerObservation(ROBOT)
        walker.command(command)  # asked, and not yet in the reference: the gait moves on `advance`
        seen.append(observe(state(), ROBOT.home, walker.frames(AHEAD)))
        walker.advance()
        seen.append(observe(state(), ROBOT.home, walker.frames(AHEAD)))
    np.testing.assert_array_equal(seen[0], seen[2])
    assert not np.array_equal(seen[1], seen[3])


def test_it_does_not_see_where_it_is_or_heads() -> None:
    """Walking is the same everywhere: only the height above the soles is in it."""
    frames = gait().frames(AHEAD)
    here = TrackerObservation(ROBOT)(state(), ROBOT.home, frames)
    there = state(displacement=np.array([3.0, -2.0, 0.25]), yaw=np.array(2.0), orientation=np.array([0, 0, 0, 1.0]))
    np.testing.assert_array_equal(TrackerObservation(ROBOT)(there, ROBOT.home, frames), here)
    higher = state(displacement=np.array([0, 0, 0.26]))
    assert not np.array_equal(TrackerObservation(ROBOT)(higher, ROBOT.home, frames), here)


def test_its_size_is_the_one_it_says_and_float32() -> None:
    observe = TrackerObservation(ROBOT, (3,))
    seen = observe(state(shape=(3,)), np.tile(ROBOT.home, (3, 1)), gait((3,)).frames(AHEAD))
    assert seen.shape == (3, observe.size)
    assert seen.dtype == np.float32
    assert np.isfinite(seen).all()


def test_a_mirrored_robot_is_observed_as_the_mirror_image() -> None:
    """What training shows the tracker beside each sample must be what it would have seen."""
    rng = np.random.default_rng(0)
    joints, feet = Mirror.joints(ROBOT), Mirror.feet(ROBOT)
    here, there = TrackerObservation(ROBOT), TrackerObservation(ROBOT)
    left, right = gait(), gait()
    left.command(np.array([0.2, 0.1, 0.5]))
    right.command(np.array([0.2, -0.1, -0.5]))
    for _ in range(40):
        position, speed = ROBOT.home + rng.normal(0, 0.1, 20), rng.normal(0, 1, 20)
        gravity, rate, velocity = rng.normal(0, 0.1, 3) - [0, 0, 1], rng.normal(0, 1, 3), rng.normal(0, 0.2, 3)
        contact, applied = rng.random(2), ROBOT.home + rng.normal(0, 0.1, 20)
        seen = here(
            state(position, joint_velocity=speed, gravity=gravity, angular_velocity=rate, velocity=velocity,
                  contact=contact),
            applied, left.frames(AHEAD),
        )  # fmt: skip
        image = there(
            state(joints(position), joint_velocity=joints(speed), gravity=Mirror.VECTOR(gravity),
                  angular_velocity=Mirror.ROTATION(rate), velocity=Mirror.VECTOR(velocity), contact=feet(contact)),
            joints(applied), right.frames(AHEAD),
        )  # fmt: skip
        np.testing.assert_allclose(here.mirror(seen), image, atol=1e-5)
        left.advance()
        right.advance()


def test_history_is_that_of_the_world_and_of_the_ticks_before() -> None:
    """An observation depends on the last four ticks, not on older ones, and a reset forgets one world's."""
    frames, applied = gait((2,)).frames(AHEAD), np.tile(ROBOT.home, (2, 1))

    def last(offsets: list[float], reset_after: int | None = None) -> np.ndarray:
        observe = TrackerObservation(ROBOT, (2,))
        for tick, offset in enumerate(offsets):
            if tick == reset_after:
                observe.reset(np.array([True, False]))
            seen = observe(state(ROBOT.home + offset, (2,)), applied + offset, frames)
        return seen

    walked = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    plain = last(walked)
    for tick in range(1, 5):
        other = walked.copy()
        other[tick] += 0.05
        assert not np.array_equal(last(other), plain), tick
    np.testing.assert_array_equal(last([0.9, *walked[1:]]), plain)
    forgot = last(walked, reset_after=5)
    np.testing.assert_array_equal(forgot[0], last([0.5])[0])
    np.testing.assert_array_equal(forgot[1], plain[1])


def test_commands_on_their_way_are_seen() -> None:
    """A command may take 40 ms to the motor: without those of the ticks before, what a joint does cannot be told."""
    frames = gait().frames(AHEAD)

    def last(commands: list[float]) -> np.ndarray:
        observe = TrackerObservation(ROBOT)
        for offset in commands:
            seen = observe(state(ROBOT.home), ROBOT.home + offset, frames)
        return seen

    plain = last([0.0] * 5)
    for tick in range(1, 5):
        commands = [0.0] * 5
        commands[tick] = 0.1
        assert not np.array_equal(last(commands), plain), tick
    np.testing.assert_array_equal(last([0.1, 0.0, 0.0, 0.0, 0.0]), plain)


def step(**changes: Any) -> Step:
    """Two worlds that do exactly what the reference asks: both feet stand, nothing moves."""
    joints, feet = np.tile(ROBOT.home, (2, 1)), np.zeros((2, 2))
    values: dict[str, Any] = {
        "velocity": np.zeros((2, 2)),
        "yaw_rate": np.zeros(2),
        "height": np.full(2, 0.259),
        "gravity": np.tile([0.0, 0.0, -1.0], (2, 1)),
        "angular_velocity": np.zeros((2, 3)),
        "joints": joints,
        "effort": np.zeros((2, 20)),
        "target": joints,
        "target1": joints,
        "target2": joints,
        "foot_force": feet + 15.0,
        "foot_height": feet,
        "foot_velocity": np.zeros((2, 2, 3)),
        "foot_up": np.tile([0.0, 0.0, 1.0], (2, 2, 1)),
        "reference_velocity": np.zeros((2, 2)),
        "reference_yaw_rate": np.zeros(2),
        "reference_height": np.full(2, 0.259),
        "reference_joints": joints,
        "reference_contact": feet + 1.0,
        "reference_gravity": np.tile([0.0, 0.0, -1.0], (2, 1)),
        "residual": np.zeros((2, 20)),
        "residual1": np.zeros((2, 20)),
        "residual2": np.zeros((2, 20)),
        "fallen": np.zeros(2, bool),
        "walking": ROBOT.walking,
        "weight": 30.0,
    }
    return Step(**(values | changes))


def test_a_perfect_step_earns_all_and_pays_nothing() -> None:
    for name, term in TERMS.items():
        full = ("velocity", "progress", "yaw_rate", "turning", "pose", "contact")
        full = (*full, "joints", "orientation", "base_height", "travel")
        expected = 1.0 if name in full else 0.0
        assert term(step()) == pytest.approx([expected, expected]), name


FEET = np.array([[1.0, 0.0], [0.0, 0.0]])  # of the first world's left foot
FIRST = np.array([1.0, 0.0])


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("pose", {"joints": ROBOT.home + 0.25 * FIRST[:, None] * np.ones(20)}, np.exp(-1)),
        ("contact", {"foot_force": 15 - 15 * FEET}, 0.5),
        ("joints", {"joints": ROBOT.home + 0.3 * FIRST[:, None] * np.ones(20)}, (np.exp(-1) + np.exp(-6.25)) / 2),
        ("orientation", {"gravity": np.array([[0.6, 0.0, -1.0], [0, 0, -1]])}, (np.exp(-1) + np.exp(-9)) / 2),
        ("base_height", {"height": 0.259 + 0.2 * ROBOT.walking.height * FIRST}, np.exp(-1)),
        ("travel", {"reference_gravity": np.array([[1.0, 0.0, 0.0], [0, 0, -1]])}, 0.0),
        ("residual", {"residual": 0.1 * FIRST[:, None] * np.ones(20)}, 0.2),
        ("residual_rate", {"residual1": 0.1 * FIRST[:, None] * np.ones(20)}, 0.2),
        ("residual_acceleration", {"residual1": 0.1 * FIRST[:, None] * np.ones(20)}, 0.8),
        ("clearance", {"reference_contact": 1 - FEET, "foot_height": 0.01 * FEET}, 0.5),
        ("clearance", {"reference_contact": 1 - FEET, "foot_height": 0.09 * FEET}, 1.0),
        ("clearance", {"foot_height": 0.01 * FEET}, 0.0),
        ("upright", {"gravity": np.array([[0.3, 0.4, -0.87], [0, 0, -1]])}, 0.25),
        ("height", {"height": 0.259 + 0.02 * FIRST}, 4e-4),
        ("sway_rate", {"angular_velocity": FIRST[:, None] * [1.0, 2.0, 9.0]}, 5.0),
        ("slip", {"foot_velocity": FEET[..., None] * [0.3, 0.4, 5.0]}, 0.25),
        ("slip", {"foot_velocity": FEET[..., None] * [0.3, 0.4, 0.0], "foot_force": 15 - 15 * FEET}, 0.0),
        ("level_feet", {"foot_up": np.array([0, 0, 1.0]) + FEET[..., None] * [0.1, 0, 0]}, 0.01),
        ("impact", {"foot_force": 15 + 75 * FEET}, 0.5),
        ("target_rate", {"target1": ROBOT.home + 0.1 * FIRST[:, None] * np.ones(20)}, 0.2),
        ("target_acceleration", {"target1": ROBOT.home + 0.1 * FIRST[:, None] * np.ones(20)}, 0.8),
        ("effort", {"effort": FIRST[:, None] * np.ones(20)}, 20.0),
        ("fall", {"fallen": np.array([True, False])}, 1.0),
    ],
)
def test_terms_measure_what_they_are_named_for(name: str, changes: dict[str, Any], expected: float) -> None:
    value = TERMS[name](step(**changes))
    assert value[0] == pytest.approx(expected)
    assert value[1] == pytest.approx(TERMS[name](step())[1])  # and nothing of the neighbour's


def test_the_nearer_to_the_reference_the_better() -> None:
    """Whatever the widths of the kernels: far off there is still something to find, close by something to hold."""
    errors = (0.0, 0.02, 0.05, 0.1, 0.3)
    for values in (
        [TERMS["velocity"](step(velocity=error * FIRST[:, None] * [0.6, -0.8]))[0] for error in errors],
        [TERMS["yaw_rate"](step(yaw_rate=3 * error * FIRST))[0] for error in errors],
    ):
        assert (np.diff(values) < -1e-3).all()
        assert values[0] == pytest.approx(1.0)
        assert values[-1] > 1e-3


def test_what_is_far_and_fast_goes_by_the_robots_size() -> None:
    """A robot of twice the speed, height and weight is paid alike for twice the error, step and force."""
    walking = replace(ROBOT.walking, forward=1.0, turning=2.0, height=0.5)
    for name, changes in {
        "velocity": {"velocity": 0.04 * np.ones((2, 2))},
        "yaw_rate": {"yaw_rate": 0.3 * np.ones(2)},
        "progress": {"velocity": 0.02 * np.ones((2, 2)), "reference_velocity": 0.03 * np.ones((2, 2))},
        "clearance": {"foot_height": 0.01 * np.ones((2, 2)), "reference_contact": np.zeros((2, 2))},
        "impact": {"foot_force": 80.0 * np.ones((2, 2))},
        "contact": {"foot_force": 0.9 * np.ones((2, 2))},
    }.items():
        doubled = {key: value if key == "reference_contact" else 2 * value for key, value in changes.items()}
        larger = step(**doubled, walking=walking, weight=60.0)
        np.testing.assert_allclose(TERMS[name](larger), TERMS[name](step(**changes)), err_msg=name)


def test_a_steady_motion_of_targets_is_not_acceleration() -> None:
    ramp = {"target": ROBOT.home + np.full((2, 20), 0.2), "target1": ROBOT.home + np.full((2, 20), 0.1)}
    assert rewards.target_acceleration(step(**ramp)) == pytest.approx([0.0, 0.0])
    assert rewards.target_rate(step(**ramp)) == pytest.approx([0.2, 0.2])


def test_the_total_is_the_weighted_sum_and_every_part_is_logged() -> None:
    fell = step(fallen=np.array([True, False]))
    value, parts = Terms({"velocity": 2.0, "fall": -10.0}, TERMS)(fell)
    assert value == pytest.approx([-8.0, 2.0])
    assert parts == pytest.approx({"velocity": 2.0, "fall": -5.0})


def test_shipped_rewards_prefer_tracking_to_standing_and_standing_to_falling() -> None:
    total = Terms(TrackingSettings().rewards, TERMS)
    asked = {"reference_velocity": np.tile([0.3, 0.0], (2, 1))}
    tracking, _ = total(step(**asked, velocity=np.tile([0.3, 0.0], (2, 1))))
    standing, _ = total(step(**asked))
    falling, _ = total(replace(step(**asked), fallen=np.ones(2, bool)))
    assert tracking[0] > standing[0] + 1.0
    assert standing[0] > falling[0] + 5.0
