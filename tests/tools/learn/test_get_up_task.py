"""Getting up as a task to learn, led by clips and without; and training without a prior."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, read_header
from servoid.policy.motion.library import Library
from servoid.policy.priors.score_matching.model import Style
from servoid.policy.priors.task_policy import TaskPolicy
from servoid.policy.rising.lead import CLIPS
from servoid.policy.rising.policy import RisingPolicy
from servoid.stack.tasks.learned import TaskState, load_learned_task
from servoid.stack.tasks.learned.get_up import GettingUp, GettingUpByClips
from servoid.tools.cli import main
from servoid.tools.learn.envs.down import Down
from servoid.tools.learn.envs.score_term import Manner
from servoid.tools.learn.envs.starts import lying
from servoid.tools.learn.envs.task_environment import TaskEnvironment
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.policy import PolicyTrainer, environment

ROBOT = load_robot()
TICKS = 4  # decisions in an episode
SETTINGS = replace(
    PolicyTraining(), hidden=(16,), horizon=3, mini_batches=2, episode_seconds=TICKS * 2 * ROBOT.dt, worlds=6,
    samples=18.0, evaluate_every=0.0, starts=64, rewards={"task": 1.0, "blocked": -0.1, "shock": -0.1},
)  # fmt: skip


@cache
def bodies() -> Down:
    return Down(ROBOT, (0.0, 0.0), 64, 0)


def down(eased: tuple[float, float] = (0.0, 0.0)) -> Down:
    """States that the tests share."""
    states = copy(bodies())
    states._eased, states._chances = eased, states._chances.copy()
    return states


def made(task: type[GettingUp], settings: PolicyTraining = SETTINGS) -> TaskEnvironment:
    free = Manner(settings.worlds, settings.decide_every, np.full(len(ROBOT.joints), settings.reach))
    env = TaskEnvironment(task(ROBOT), free, down(settings.eased), None, settings, settings.worlds, 0)
    env.reset()
    return env


def test_episodes_begin_lying_and_no_fall_ends_them() -> None:
    env = made(GettingUp, replace(SETTINGS, eased=(0.0, 0.0)))
    assert (env.fleet.truth.gravity[:, 2] > -0.6).all()
    ends = [env.step(np.zeros((env.n, env.action_size)))[1:] for _ in range(TICKS)]
    assert not any(done.any() for done, _ in ends[:-1])
    assert ends[-1][0].all()  # their time is up: what would have come is not lost
    assert ends[-1][1].all()


def test_velocity_and_height_by_legs_that_do_not_stand_are_not_seen() -> None:
    env = made(GettingUp)
    with_odometry = environment(load_learned_task("speed", ROBOT), None, Style(), SETTINGS, 2, 0)
    assert with_odometry.observation.size - env.observation.size == 3 + 2  # and the goal


def test_standing_still_at_home_is_worth_most_and_is_achieved() -> None:
    n = 5  # stands, leans, moves, is off home, lies
    gravity = np.tile([0.0, 0.0, -1.0], (n, 1))
    gravity[1], gravity[4] = [np.sin(0.5), 0.0, -np.cos(0.5)], [1.0, 0.0, 0.0]
    joints, moving = np.tile(ROBOT.home, (n, 1)), np.zeros((n, len(ROBOT.joints)))
    joints[3] += 0.4
    moving[2] = 1.0
    height = np.full(n, ROBOT.standing_height)
    height[4] = 0.05
    state = TaskState(
        position=np.zeros((n, 2)), yaw=np.zeros(n), velocity=np.zeros((n, 2)), height=height, gravity=gravity,
        angular_velocity=np.zeros((n, 3)), joints=joints, joint_velocity=moving,
    )  # fmt: skip
    task = GettingUp(ROBOT)
    reward = task.reward(np.zeros((n, 0)), state)
    assert reward[0] == pytest.approx(1.0)
    assert (reward[1:] < 0.95).all()
    assert reward[4] < 0.15
    assert task.achieved(state).tolist() == [True, False, True, False, False]


def test_states_along_clips_begin_where_the_clip_is() -> None:
    env = made(GettingUpByClips, replace(SETTINGS, eased=(1.0, 1.0)))
    assert env.down is not None
    assert env.lead is not None
    along = env.down.clip >= 0
    assert along.any()
    assert np.array_equal(env.lead.side[along], env.down.clip[along])
    assert np.array_equal(env.lead.time[along], env.down.time[along])
    assert not env.lead.time[~along].any()  # who falls is led from the beginning


def test_what_fails_is_begun_with_more_often() -> None:
    states = down()
    before = dict(states.measures)
    rngs = [np.random.default_rng(i) for i in range(200)]
    states.draw(rngs, np.ones(200, bool))
    front = states._kind == 0
    for _ in range(50):
        states.learn(np.ones(200, bool), ~front)
    states.draw(rngs, np.ones(200, bool))
    assert states.measures["success/lying on the front"] < 0.1 < before["success/lying on the front"]
    assert (states._kind == 0).mean() > 0.65  # 1 : 0.3


def test_pushes_come_and_grow() -> None:
    env = made(GettingUp, replace(SETTINGS, hardest_push=1.0, push_every=(0.04, 0.04), episode_seconds=1.0))
    pushed: list[float] = []
    push = env.fleet.worlds.push
    env.fleet.worlds.push = lambda v: (pushed.append(float(np.abs(v).max())), push(v))[1]  # type: ignore[method-assign]
    for progress in (0.0, 0.5):
        env.schedule(progress)
        env.step(np.zeros((env.n, env.action_size)))
        env.step(np.zeros((env.n, env.action_size)))
    assert pushed[:2] == [0.0, 0.0]
    assert max(pushed[2:]) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("task", [GettingUp, GettingUpByClips])
def test_a_policy_that_gets_up_runs_as_it_learned(task: type[GettingUp], tmp_path: Path) -> None:
    """What the checkpoint decides tick by tick, as in a run, is what the training rewarded."""
    env = made(task)
    trainer = PolicyTrainer(env, Style(), SETTINGS, tmp_path, None)
    trainer.start(resume=False)
    trainer.run()
    head = read_header(trainer.best_path)
    assert head["kind"] == "get_up"
    assert head["config"]["prior"] is None
    assert 0.0 <= head["results"]["achieved"] <= 1.0
    library = Library(ROBOT)
    clips = [library[name] for name in CLIPS]
    policy = RisingPolicy(ROBOT, trainer.best_path, clips, (env.n,))
    env.limit = 1000
    env.settings = replace(SETTINGS, eased=(0.0, 0.0))
    assert env.down is not None
    env.down = down()  # a run begins lying
    env.reset()
    told: list[np.ndarray] = []
    step = env.fleet.step

    def heard(target: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        told.append(policy(env.fleet.state, env.fleet.applied))
        assert np.allclose(told[-1], target, atol=1e-5)
        return step(target, noise)

    env.fleet.step = heard  # type: ignore[method-assign]
    for _ in range(12):
        env.step(trainer.actor()(env.observations["actor"]))
    assert len(told) == 24
    with pytest.raises(CheckpointError, match="a task_policy network is needed"):
        TaskPolicy(ROBOT, trainer.best_path)


def test_without_a_prior_a_task_is_all_there_is(tmp_path: Path) -> None:
    settings = replace(SETTINGS, rewards={"task": 0.5, "both": 0.5}, decide_every=1, reach=0.2)
    env = environment(load_learned_task("speed", ROBOT), None, Style(), settings, 3, 0)
    env.reset()
    assert np.allclose(env.fleet.applied, ROBOT.home, atol=1e-6)  # it stands
    reward, _, _ = env.step(np.ones((3, env.action_size)))
    assert np.allclose(reward, env.task_reward * ROBOT.dt)
    assert env.stride == 1
    assert np.allclose(env.reach, 0.2)
    trainer = PolicyTrainer(env, Style(), settings, tmp_path, None)
    trainer.ship(tmp_path / "p.safetensors", {})
    assert TaskPolicy(ROBOT, tmp_path / "p.safetensors").task == "speed"
    assert read_header(tmp_path / "p.safetensors")["config"]["prior"] is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--style", "march"], "--style needs a prior"),
        (["--adversarial", "d"], "--adversarial needs a prior"),
        (["--discriminator", "d"], "--discriminator needs a prior"),
        (["--reach", "0"], "reach must be positive"),
        (["--decide-every", "0"], "--decide-every must be at least 1"),
        (["--hardest-push", "-1"], "hardest-push must not be negative"),
    ],
)
def test_what_makes_no_sense_without_a_prior_is_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["train", "policy", "--task", "get-up", "--prior", "none", "--out", str(tmp_path / "o"), *words]
    assert main(line) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_bodies_of_which_none_lies_are_refused() -> None:
    seed = next(seed for seed in range(50) if not len(lying(ROBOT, 1, seed).joints))
    with pytest.raises(ConfigError, match="--starts 1: none of the bodies"):
        Down(ROBOT, (0.0, 0.0), 1, seed)
