"""Task policies under a motion prior: their world, their reward, what they save, and that it runs as it learned."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_prior import write_prior

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError, read_header
from servoid.policy.mlp import Mlp
from servoid.policy.priors.goals import GOALS
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.priors.score_matching.model import Style, load_prior
from servoid.policy.priors.task_policy import TaskPolicy
from servoid.policy.recording import DatasetError, read_recording
from servoid.policy.references.style import load_style
from servoid.sim.kinematics import limbs_of
from servoid.stack.tasks.learned import LEARNED_TASKS, TaskState, load_learned_task
from servoid.tools.learn.demonstrations import Mirrors, cloned, demonstrated
from servoid.tools.learn.envs.task_environment import TaskEnvironment
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.policy import PolicyTrainer, environment

ROBOT = load_robot()
SETTINGS = replace(
    PolicyTraining(),
    hidden=(16,),
    horizon=3,
    mini_batches=2,
    episode_seconds=0.4,
    worlds=6,
    starts=8,
    samples=36.0,
    evaluate_every=0.0,
    critic_alone=0.0,
)


@pytest.fixture(scope="module")
def prior(synthetic_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_prior(synthetic_dataset, tmp_path_factory.mktemp("prior"))


def task_state(**known: Any) -> TaskState:
    """Of a robot that stands, still, but for what is `known`."""
    n = len(next(iter(known.values())))
    at_rest = TaskState(
        position=np.zeros((n, 2)), yaw=np.zeros(n), velocity=np.zeros((n, 2)),
        height=np.full(n, ROBOT.standing_height), gravity=np.tile([0.0, 0.0, -1.0], (n, 1)),
        angular_velocity=np.zeros((n, 3)), joints=np.tile(ROBOT.home, (n, 1)),
        joint_velocity=np.zeros((n, len(ROBOT.joints))),
    )  # fmt: skip
    return replace(at_rest, **known)


def made(prior: Path, task: str = "speed", settings: PolicyTraining = SETTINGS) -> TaskEnvironment:
    known = load_prior(prior, ROBOT, limbs_of(ROBOT))
    return environment(load_learned_task(task, ROBOT), known, Style(), settings, settings.worlds, 0)


@pytest.mark.slow
def test_a_policy_is_trained_and_runs_as_it_learned(prior: Path, tmp_path: Path) -> None:
    """Decisions of the checkpoint, made from the estimate of a run, are those that the training rewarded."""
    env = made(prior)
    trainer = PolicyTrainer(env, Style(), SETTINGS, tmp_path, prior)
    trainer.start(resume=False)
    trainer.run()
    head = read_header(trainer.best_path)
    assert head["config"]["prior"]["name"] == prior.name
    assert math.isfinite(head["results"]["return"])
    policy = TaskPolicy(ROBOT, trainer.best_path, (env.n,))
    policy.reset(None, env.fleet.seeds)
    env.settings = replace(SETTINGS, episode_seconds=60.0)
    env.limit = 1000
    env.reset()
    for _ in range(3):
        decided = ROBOT.home + env.reach * trainer.actor()(env.observations["actor"])
        told = env.task.instruct(env.asked, env.fleet.state)
        first = policy.act(env.fleet.state, env.fleet.applied, told)
        assert np.allclose(first, decided, atol=1e-5)
        assert np.array_equal(policy.act(env.fleet.state, env.fleet.applied, told), first)  # it holds for two ticks
        env.step(trainer.actor()(env.observations["actor"]))


def test_the_papers_sum_and_a_gate_are_weights(prior: Path) -> None:
    env = made(prior, settings=replace(SETTINGS, rewards={"task": 0.5, "manner": 0.5}))
    env.reset()
    reward, _, _ = env.step(np.zeros((env.n, env.action_size)))
    assert env.term_names == ("task", "manner")
    assert np.allclose(reward.mean() / env.dt, env.terms["task"] + env.terms["manner"])
    assert 0.0 < env.terms["manner"] <= 0.5
    with pytest.raises(ValueError, match=r"rewards\.tsk: no such reward"):
        replace(SETTINGS, rewards={"tsk": 1.0})


def test_an_episode_that_is_unlike_the_data_ends(prior: Path) -> None:
    env = made(prior, settings=replace(SETTINGS, unlike=1e-3, unlike_after=0.0))
    env.reset()
    _, done, late = env.step(np.zeros((env.n, env.action_size)))
    assert done.all()
    assert not late.any()


def test_what_is_asked_next_is_no_merit_of_what_was_done(prior: Path) -> None:
    """For the learner, time is up where another place is drawn; the episode goes on."""
    env = made(prior, "location", replace(SETTINGS, episode_seconds=10.0))
    env.reset()
    env._next[:] = np.where(np.arange(env.n) == 2, 1, 1000)
    asked = env.asked.copy()
    _, done, late = env.step(np.zeros((env.n, env.action_size)))
    assert np.flatnonzero(done).tolist() == np.flatnonzero(late).tolist() == [2]
    assert env.ticks.tolist() == [1] * env.n
    assert np.flatnonzero((env.asked != asked).any(1)).tolist() == [2]


def test_a_place_and_a_ball_are_not_asked_for_where_it_is_to_stand() -> None:
    stand = Instruction(np.zeros(3), stand=True)
    assert np.array_equal(GOALS["location"].observe(stand, ROBOT.walking), [0.0, 0.0, 1.0, 0.0])
    assert np.array_equal(GOALS["ball"].observe(stand, ROBOT.walking)[:4], [0.0, 0.0, 1.0, 0.0])
    assert np.hypot(*GOALS["ball"].observe(stand, ROBOT.walking)[4:6]) >= 1.0


def test_generated_starts_move_and_stand_on_the_ground(prior: Path) -> None:
    env = made(prior, settings=replace(SETTINGS, generated=1.0))
    env.reset()
    truth = env.fleet.truth
    assert not np.allclose(truth.joints, ROBOT.home)
    assert (np.abs(truth.foot_position[..., 2].min(1)) < 0.05).all()
    standing = made(prior, settings=replace(SETTINGS, generated=0.0))
    standing.reset()
    assert np.allclose(standing.fleet.applied, ROBOT.home, atol=1e-6)
    assert np.allclose(standing.velocity, 0.0)


def test_rewards_are_highest_for_what_is_asked() -> None:
    def state(position: tuple[float, float], yaw: float, velocity: tuple[float, float]) -> TaskState:
        return task_state(position=np.array([position]), yaw=np.array([yaw]), velocity=np.array([velocity]))

    speed, steering, location = (LEARNED_TASKS[name](ROBOT) for name in ("speed", "steering", "location"))
    asked = np.array([[0.3]])
    assert speed.reward(asked, state((0, 0), 0.0, (0.3, 0.0)))[0] == pytest.approx(1.0)
    assert speed.reward(asked, state((0, 0), 0.0, (0.0, 0.3)))[0] < 0.2  # another way
    assert speed.reward(asked, state((0, 0), 0.0, (0.0, 0.0)))[0] < 0.2  # standing
    sideways = np.array([[0.0, 0.1, 1.0, 0.0]])
    assert steering.reward(sideways, state((0, 0), 0.0, (0.0, 0.1)))[0] == pytest.approx(1.0)
    assert steering.reward(sideways, state((0, 0), np.pi / 2, (0.0, 0.1)))[0] == pytest.approx(0.7)
    assert steering.reward(sideways, state((0, 0), 0.0, (0.0, -0.01)))[0] == pytest.approx(0.3)
    ball = LEARNED_TASKS["dodgeball"](ROBOT)
    thrown = ball.draw(np.random.default_rng(0), np.array([1.0, -1.0]))[None]
    hit = [bool(ball.ended(ball.advance(thrown, t), state((1, -1), 0.0, (0.0, 0.0)))[0]) for t in np.arange(0, 6, 0.1)]
    assert any(hit)  # it flies at where the robot stands
    assert not hit[0]
    assert ball.reward(thrown, state((5, 5), 0.0, (0, 0)))[0] > ball.reward(thrown, state((1, -1), 0.0, (0, 0)))[0] > 0
    place = np.array([[1.0, 0.0]])
    assert location.reward(place, state((1.0, 0.0), 0.0, (0.0, 0.0)))[0] == pytest.approx(1.0)
    assert location.reward(place, state((0.0, 0.0), 0.0, (0.0, 0.0)))[0] < 0.01
    # Far from it, training rewards whoever goes there all the same; there, whoever stays.
    off, on, there = (
        location.guided(place, state(at, 0.0, v))[0]
        for at, v in (((0.0, 0.0), (-0.4, 0.0)), ((0.0, 0.0), (0.4, 0.0)), ((1.0, 0.0), (0.0, 0.0)))
    )
    assert off < 0.05 < 0.4 < on < there == pytest.approx(1.0)


def test_what_a_policy_sees_of_an_instruction() -> None:
    walking = ROBOT.walking
    ground = Instruction(velocity=np.array([0.1, 0.0, 0.5]), ground=np.array([0.0, 0.25]))
    assert np.allclose(GOALS["velocity"].observe(ground, walking), [0.0, 0.5])
    assert np.allclose(GOALS["steering"].observe(ground, walking), [0.0, 0.5, 0.0, 1.0])
    turning = Instruction(velocity=np.array([0.25, 0.0, 0.5]))
    assert np.allclose(GOALS["steering"].observe(turning, walking), [0.5, 0.0, np.cos(0.5), np.sin(0.5)])
    far = Instruction(velocity=np.zeros(3), goal=np.array([3.0, 4.0]))
    assert np.allclose(GOALS["location"].observe(far, walking), [0.6, 0.8, 0.6, 0.8])  # there, and facing it
    near = Instruction(velocity=np.zeros(3), goal=np.array([-0.04, 0.0]))
    assert np.allclose(
        GOALS["location"].observe(near, walking), [-0.04 / 0.3, 0.0, 1.0, 0.0]
    )  # slowly, and without turning
    behind = Instruction(velocity=np.zeros((2, 3)), goal=np.array([[-1.0, 0.0], [0.0, 0.4]]))
    assert np.allclose(GOALS["location"].observe(behind, walking), [[-1, 0, -1, 0], [0, 1, 0, 1]])
    things = np.array([[2.0, 0.0, 0.1, -0.5, 0.0], [0.0, -1.0, 0.1, 0.0, 0.25]])
    seen = GOALS["ball"].observe(Instruction(np.zeros(3), obstacles=things), walking)
    assert np.allclose(seen[4:], [0.0, -1.0, 0.0, 0.5])  # the nearest
    comes = np.array([[1.0, -0.1, 0.05, -0.4, 0.0], [1.0, 0.1, 0.05, -0.4, 0.0]])  # past it on its right, and its left
    seen = GOALS["ball"].observe(Instruction(np.zeros((2, 3)), obstacles=comes[:, None]), walking)
    assert np.allclose(seen[:, :4], [[0.0, 1.0, 0.0, 1.0], [0.0, -1.0, 0.0, -1.0]])  # aside, away from it
    across = np.array(
        [[0.02, 1.0, 0.05, 0.0, -0.4], [0.2, 1.0, 0.05, 0.0, -0.4]]
    )  # from its left, and well ahead of it
    seen = GOALS["ball"].observe(Instruction(np.zeros((2, 3)), obstacles=across[:, None]), walking)
    assert np.allclose(seen[:, 2:4], [[1.0, 0.0], [-1.0, 0.0]])  # straight on, though the other side is nearer, or back
    passed, beside = comes * [-1, 1, 1, 1, 1], comes + np.array([0.0, 0.5, 0.0, 0.0, 0.0])
    for ball in (passed[0], beside[1], comes[0] * [1, 1, 1, 0, 0]):
        seen = GOALS["ball"].observe(Instruction(np.zeros(3), obstacles=ball[None]), walking)
        assert np.allclose(seen[:4], [0.0, 0.0, 1.0, 0.0])  # no reason to go anywhere
    with pytest.raises(ConfigError, match="run dodgeball"):
        GOALS["ball"].observe(turning, walking)
    with pytest.raises(ConfigError, match="the task gives none"):
        GOALS["location"].observe(turning, walking)


def test_training_rewards_who_is_out_of_a_balls_way_before_it_is_there() -> None:
    ball = LEARNED_TASKS["dodgeball"](ROBOT)
    thrown = np.array([[1.0, 0.0, -0.4, 0.0, 1.0, 0.0, 0.0]])  # along the x axis, at the origin

    def guided(y: float, velocity: float) -> float:
        known = task_state(position=np.array([[0.0, y]]), velocity=np.array([[0.0, velocity]]))
        return float(ball.guided(thrown, known)[0])

    for side in (1.0, -1.0):
        into, stands, leaves, clear = (
            guided(*(side * np.array(at))) for at in ((0.1, -0.2), (0.1, 0.0), (0.1, 0.3), (0.4, 0.0))
        )
        assert into < stands < leaves < clear
        assert leaves > stands + 0.2
    assert ball.guided(ball.advance(thrown, 2.2), task_state(position=np.zeros((1, 2))))[0] == 0.0


@pytest.mark.slow
def test_a_policy_that_sees_less_begins_another(prior: Path, tmp_path: Path) -> None:
    """It does what it did, whatever else there is to see."""
    trainer = PolicyTrainer(
        made(prior, "dodgeball", settings := replace(SETTINGS, hidden=(256, 128))), Style(), settings, tmp_path, prior
    )
    shipped = checkpoint.resolve("location")
    trainer.start(resume=False, init=shipped)
    seen = trainer.env.observations["actor"]
    known, _ = Mlp.load(shipped, "task_policy", ROBOT, seen.shape[1] - 4)
    theirs, ours = np.array(read_header(shipped)["config"]["reach"]), trainer.env.reach
    assert np.allclose(ours * trainer.actor()(seen), theirs * known(seen[:, :-4]), atol=1e-5)  # the same targets
    head, tensors = checkpoint.read(shipped)
    slow = tmp_path / "slow.safetensors"
    checkpoint.write(slow, tensors, {**head, "config": {**head["config"], "stride": 4}})
    with pytest.raises(ConfigError, match="decides every 4 ticks, and here it is every 2"):
        trainer.adopt(slow)


@pytest.mark.slow
def test_a_policy_begins_in_the_pose_of_a_style(tmp_path: Path) -> None:
    """What walked with hanging arms decides the same where they are stretched out, and holds them there."""
    shipped, styles = checkpoint.resolve("speed"), checkpoint.resolve("styles")
    known = load_prior(styles, ROBOT, limbs_of(ROBOT))
    settings, task, style = (
        replace(SETTINGS, hidden=(256, 128)),
        load_learned_task("speed", ROBOT),
        Style.parse("zombie"),
    )
    trainer = PolicyTrainer(environment(task, known, style, settings, 6, 0), style, settings, tmp_path, styles)
    trainer.start(resume=False, init=shipped)
    before, _ = Mlp.load(shipped, "task_policy", ROBOT, trainer.env.observations["actor"].shape[1])
    reach, shoulder = np.array(read_header(shipped)["config"]["reach"]), ROBOT.names.index("l_sho_pitch")
    state, moved = trainer.env.fleet.state, trainer.actor()
    hanging = np.tile(ROBOT.home, (6, 1))
    offset = load_style("zombie", ROBOT).held(ROBOT)[1] - ROBOT.home
    seen = [
        TaskObservation(ROBOT, task.seen, (6,))(replace(state, position=at), at, np.zeros((6, 2)))
        for at in (hanging, hanging + offset)
    ]
    decided, then = reach * before(seen[0]), trainer.env.reach * moved(seen[1])
    legs = ROBOT.leg_index.ravel()
    assert np.abs(then - decided)[:, legs].max() < 0.1
    assert np.allclose(then[:, shoulder] - decided[:, shoulder], -1.5, atol=0.2)  # from 0.3 rad at home to -1.2


def test_a_task_without_a_reward_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from servoid.stack.tasks.learned import LearnedTask\n"
        "class Mine(LearnedTask):\n"
        "    name, goal, size, every, run = 'mine', 'velocity', 1, (1.0, 2.0), 'walk'\n"
        "    def draw(self, rng, position): return [0.0]\n"
        "    def instruct(self, asked, state): return None\n"
    )
    with pytest.raises(ConfigError, match=r"mine\.py:2: Mine: .*reward"):
        load_learned_task(f"{file}:Mine", ROBOT)
    with pytest.raises(ConfigError, match=r"unknown task 'sped'.*speed"):
        load_learned_task("sped", ROBOT)


def test_a_task_policy_for_another_robot_is_refused(prior: Path) -> None:
    with pytest.raises(CheckpointError, match="a task_policy network is needed"):
        TaskPolicy(ROBOT, prior)


def test_demonstrations_are_told_what_came_of_them(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    seen, targets = demonstrated(recording, ROBOT, GOALS["velocity"], 2, np.random.default_rng(0))
    assert len(seen) == len(targets)
    assert targets.shape[1] == len(ROBOT.joints)
    asked = seen[:, -2:] * ROBOT.walking.forward
    speed = np.linalg.norm(asked, axis=1)
    assert speed.max() < 0.31  # the made-up bodies glide at 0.3 m/s at most
    assert (np.abs(asked[:, 0]) > np.abs(asked[:, 1])).mean() > 0.9  # and almost straight ahead
    first, _ = recording.spans[0]  # and sees what it would see if it were alone
    alone, raw, applied = TaskObservation(ROBOT, GOALS["velocity"]), recording.raw[first:], recording.applied[first:]
    for i in range(8):
        assert np.allclose(alone.of_rows(raw[1 + 2 * i], applied[2 * i], seen[i, -2:]), seen[i], atol=1e-6)


def test_demonstrations_too_short_to_look_ahead_are_refused(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    short = replace(recording, episode=np.arange(len(recording.raw)) // 20)
    with pytest.raises(DatasetError, match=r"no episode lasts longer than the 0\.48 s"):
        demonstrated(short, ROBOT, GOALS["velocity"], 2, np.random.default_rng(0))


@pytest.mark.slow
def test_what_a_policy_imitates_is_kept_and_others_can_begin_with_it(
    prior: Path, synthetic_dataset: Path, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, imitation_steps=5)
    first, second = (
        PolicyTrainer(made(prior, settings=settings), Style(), settings, tmp_path / name, prior) for name in "ab"
    )
    first.imitate(synthetic_dataset)
    kept = tmp_path / "a" / "imitation.safetensors"
    assert "demonstrations" in read_header(kept)["results"]["begun_with"]
    with pytest.raises(ConfigError, match=r"sees its goal in 4 numbers \(steering\), and task speed shows 2"):
        second.start(resume=False, init=checkpoint.resolve("steering"))
    second.start(resume=False, init=kept)
    seen = first.env.observations["actor"]
    assert np.allclose(first.actor()(seen), second.actor()(seen), atol=1e-6)


def test_a_clone_does_what_was_shown_and_in_a_mirror_its_mirror() -> None:
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(400, 4)).astype(np.float32)
    shown = np.stack([seen[:, 0], 0.5 * seen[:, 1]], -1)  # of a robot whose mirror flips the second of both
    mirrors = Mirrors(Mirror.join(Mirror.PLANAR, Mirror.PLANAR), Mirror.PLANAR)
    network = cloned(seen, shown, mirrors, (16,), 600, 0)
    assert np.abs(network(seen) - shown).mean() < 0.1
    assert np.abs(network(mirrors.seen(seen)) - mirrors.decided(network(seen))).mean() < 0.05
