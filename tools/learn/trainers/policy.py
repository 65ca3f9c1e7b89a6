"""Train a policy for a task with PPO, under a motion prior that rewards what is like its data (SMP), or without one.

--task is speed, steering, location, dodgeball, carry, get-up, clip:NAME for a clip of the library, or your own
FILE.py:Class.
The policy sees the estimate and its goal; it decides joint targets around the home pose as often as its prior has
frames. --rewards weighs the task, the prior (manner) and their product (both); the paper adds the first two. With
--prior none manner is 1 everywhere, and --decide-every and --reach say what the prior would. With --demonstrations it
begins as a network that does what a dataset shows, instead of at random: that is kept as imitation.safetensors, and
others can begin with it by --init.

Ctrl-C saves, and the same command continues. The newest network is policy.safetensors.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.policy import checkpoint
from servoid.policy.priors.task_policy import KIND, save_task_policy
from servoid.policy.rising.policy import KIND as RISING
from servoid.policy.rising.policy import save_rising_policy
from servoid.stack.tasks.learned import LearnedTask, load_learned_task
from servoid.stack.tasks.learned.clip import PREFIX
from servoid.tools.learn.envs.task_environment import Starts, TaskEnvironment
from servoid.tools.learn.envs.task_judge import measure
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.trainers.ppo import PpoTrainer
from servoid.tools.learn.trainers.trainer import add_run_arguments

if TYPE_CHECKING:
    from servoid.policy.priors.score_matching.model import Prior, Style
    from servoid.tools.learn.envs.score_term import MakesTerm

_JUDGED, _JUDGED_STARTS = 32, 256  # worlds; states that they begin in, where a task has its own
_LED_SHARE = 0.05  # of what initial weights give, where a lead knows a way already
NO_PRIOR = "none"
_LICENCE = "Apache-2.0"  # of what learns from nothing but its own experience
_IMITATION = "imitation.safetensors"  # what a policy began as, where it imitated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train policy`."""
    run = add_run_arguments(parser, PolicyTraining(), threads=1)  # the worlds use the cores
    run.add_argument("--task", required=True, metavar="NAME|FILE.py:CLASS", help="what is learned")
    run.add_argument(
        "--prior",
        required=True,
        metavar="NAME|FILE|none",
        help="motion prior (`servoid train prior`); none: without one",
    )
    run.add_argument(
        "--style",
        metavar="NAME|UPPER+LOWER",
        help="style of the prior, or one for the upper body and one for the lower",
    )
    run.add_argument(
        "--style-weight", type=float, default=1.0, metavar="X", help="weight of classifier-free guidance (default: 1)"
    )
    run.add_argument("--init", metavar="NAME|FILE", help="start from this task policy")
    run.add_argument(
        "--demonstrations", type=Path, metavar="DIR", help="start from a network that imitates this dataset"
    )
    run.add_argument(
        "--measure", action="store_true", help="train nothing: measure the policy that training would begin with"
    )
    run.add_argument(
        "--adversarial",
        type=Path,
        metavar="DIR",
        help="reward by a discriminator that learns from this dataset (AMP); the prior measures and starts episodes",
    )
    run.add_argument(
        "--discriminator", type=Path, metavar="CHECKPOINT", help="reward by this discriminator, which stays as it is"
    )
    run.add_argument(
        "--smiling",
        action="store_true",
        help="reward by how much better a second denoiser, which learns from the policy's own motion, predicts noise "
        "than the prior (SMILING)",
    )


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the worlds use the cores
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.priors.score_matching.model import Style, load_prior
    from servoid.sim.kinematics import limbs_of

    settings = read_settings(args, PolicyTraining())
    if args.init is not None and args.demonstrations is not None:
        raise ConfigError("give --init or --demonstrations, not both: a policy begins with one network")
    torch.set_num_threads(args.threads)
    torch.manual_seed(settings.seed)
    robot = load_robot(args.robot)
    style = Style.parse(args.style, args.style_weight)
    found, prior, makes = None, None, None
    if args.prior == NO_PRIOR:
        _refuse_what_needs_a_prior(args)
    else:
        found = checkpoint.resolve(args.prior, robot)
        prior = load_prior(found, robot, limbs_of(robot))
        makes = _makes_term(args, prior, settings)
    task = load_learned_task(args.task, robot)
    env = environment(task, prior, style, settings, settings.worlds, settings.seed, makes)
    trainer = trainer_of(env, style, settings, args.out, found)
    trainer.start(args.resume, None if args.init is None else checkpoint.resolve(args.init, robot))
    if args.demonstrations is not None and not trainer.begun_with:
        trainer.imitate(args.demonstrations)
    if args.measure:
        for name, value in trainer.measured().items():
            print(f"{name:16} {value:.3f}")
        return 0
    trainer.run()
    return 0


def _refuse_what_needs_a_prior(args: argparse.Namespace) -> None:
    given = {
        "--style": args.style, "--adversarial": args.adversarial, "--discriminator": args.discriminator,
        "--smiling": args.smiling or None,
    }  # fmt: skip
    for flag, value in given.items():
        if value is not None:
            raise ConfigError(f"{flag} needs a prior: name one with --prior, or leave {flag} out")


def _makes_term(args: argparse.Namespace, prior: Prior, settings: PolicyTraining) -> MakesTerm | None:
    """What makes the term that rewards in the prior's place, where that was asked for. Raises ConfigError."""
    from servoid.policy.priors.adversarial.discriminator import load_discriminator
    from servoid.tools.learn.envs.score_term import Rival, SmilingTerm
    from servoid.tools.learn.trainers.prior import learning_rival

    if sum((args.discriminator is not None, args.adversarial is not None, args.smiling)) > 1:
        raise ConfigError(
            "give one of --adversarial, --discriminator and --smiling: one reward takes the prior's place"
        )
    if args.discriminator is not None:
        return Rival(load_discriminator(args.discriminator, prior), None).term
    if args.adversarial is None and not args.smiling:
        return None
    if args.resume and (args.out / "resume.pt").exists():
        what = "a second denoiser" if args.smiling else "a discriminator"
        raise ConfigError(f"{args.out}: {what} does not go on where it stopped: use --no-resume")
    return SmilingTerm if args.smiling else learning_rival(args.adversarial, prior, settings.seed).term


def environment(
    task: LearnedTask,
    prior: Prior | None,
    style: Style,
    settings: PolicyTraining,
    worlds: int,
    seed: int,
    makes: MakesTerm | None = None,
) -> TaskEnvironment:
    """Worlds of a task under a prior, under what `makes` the term in its place, or without one. Raises ConfigError."""
    from servoid.stack.estimation.odometry import load_odometry
    from servoid.tools.learn.envs.down import Down
    from servoid.tools.learn.envs.score_term import GeneratedStarts, Manner, ScoreTerm
    from servoid.tools.learn.envs.starts import AlongCarrying, AlongClip

    robot = task.robot
    if prior is not None and prior.features.box != (task.scene is not None):
        knows = "knows a box" if prior.features.box else "knows no box"
        raise ConfigError(
            f"task {task.name} has {'no ' if task.scene is None else 'a '}box, and this prior {knows}: train one on "
            f"data that {'show none' if task.scene is None else 'show one (servoid collect --carry)'}"
        )
    score = Manner(worlds, settings.decide_every, np.full(len(robot.joints), settings.reach))
    starts: Starts | None = None
    if prior is not None:
        score = (makes or ScoreTerm)(prior, style, worlds, settings, seed)
    if task.lies:
        starts = Down(robot, settings.eased, settings.starts, seed)
    elif task.scene is not None:
        # Not from samples of the prior: a box that is held takes hands that touch it to a fraction of a millimetre.
        starts = AlongCarrying(robot, settings.generated, seed)
    elif task.motion is not None:
        starts = AlongClip(robot, task.motion, settings.generated, seed)
    elif prior is not None:
        starts = GeneratedStarts(prior, style, settings, seed)
    return TaskEnvironment(task, score, starts, load_odometry(robot), settings, worlds, seed)


def trainer_of(
    env: TaskEnvironment, style: Style, settings: PolicyTraining, out: Path, prior: Path | None
) -> PolicyTrainer:
    """By reward, or by a teacher where the settings name one. Raises ConfigError, or CheckpointError."""
    from servoid.tools.learn.teaching import Teacher, teaching
    from servoid.tools.learn.trainers.taught import TaughtPolicyTrainer

    if not settings.teacher:
        return PolicyTrainer(env, style, settings, out, prior)
    teacher = Teacher(teaching(settings.teacher, env.task, style.upper, style.lower, env.n), env.n)
    return TaughtPolicyTrainer(env, style, settings, out, prior, teacher)


class PolicyTrainer(PpoTrainer):
    """A task policy; `policy.safetensors` is the newest one, which runs without torch."""

    BEST = LAST = "policy.safetensors"
    env: TaskEnvironment
    settings: PolicyTraining

    def __init__(
        self, env: TaskEnvironment, style: Style, settings: PolicyTraining, out: Path, prior: Path | None
    ) -> None:
        """`prior` is the file of the one that `env` judges by, None without one."""
        from servoid.stack.log.provenance import sha256

        digest = None if prior is None else sha256(prior)
        self._prior = None if prior is None else {"name": prior.name, "sha256": digest}
        self.style = style
        self._style = {"upper": style.upper, "lower": style.lower, "weight": style.weight}
        style_text = f" in style {style.upper}+{style.lower} x {style.weight:g}" if style.lower else ""
        self._under = "without a prior" if prior is None else f"under prior {prior.name}"
        told = "" if prior is None else f" {str(digest)[:12]}{style_text}"
        source = f"closed-loop experience of task {env.task.name} {self._under}{told}"
        super().__init__(env, settings, out, source)
        self.critic_alone = settings.critic_alone
        self._kind = KIND if env.down is None else RISING  # of its checkpoint: what gets up acts while no task does
        if env.lead is not None:
            self.begin_small(_LED_SHARE)
        if env.task.lies:  # no fall ends them: they would all end at once
            env.ticks[:] = np.random.default_rng(settings.seed).integers(0, env.limit, env.n)
        nominal = replace(
            settings,
            randomised=0.0,
            generated=0.0,
            starts=min(settings.starts, _JUDGED_STARTS),
            unlike=0.0,
            hardest_push=0.0,
            eased=(0.0, 0.0),
        )
        judged = environment(env.task, env.score.prior, style, nominal, _JUDGED, settings.seed + 1)
        self._judged = judged
        self.judge = lambda _: self.measured()
        measured = (
            "return",
            "falls",
            "achieved",
            "seconds",
            "prior_error",
            "amplitude",
            "amplitude_error",
            "cadence",
            "style",
            "upper_style",
            "lower_style",
        )
        self.columns = (*self.columns, *measured)
        ours = ("achieved", "seconds") if env.task.achievable else ("falls",)
        manner = () if prior is None else (("prior_error",), ("amplitude", "cadence"))
        self.panels = (*self.panels, ("return", *ours), *manner)

    def measured(self) -> dict[str, float]:
        """What the newest actor does, from standing, on the nominal robot: see `measure`."""
        actor = self.actor()
        self._judged.schedule(self.env.progress)
        return measure(self._judged, lambda seen: actor(seen["actor"]))

    def learn(self) -> dict[str, float]:
        row = super().learn()
        self.env.score.learn()
        return row

    @property
    def title(self) -> str:
        return f"a policy for task {self.env.task.name} in {self.env.n} worlds {self._under}"

    @property
    def following(self) -> str:
        task = self.env.task
        clip = "" if task.motion is None else f" --set clip={task.name.removeprefix(PREFIX)}"
        return f"servoid rollout {task.run}{clip} --policy {self.best_path} --episodes 50"

    def adopt(self, path: Path) -> None:
        """Begin as the policy in `path`: see `adopted`. Raises ConfigError, or CheckpointError."""
        from servoid.tools.learn.trainers.adopted import adopted

        self.begin_with(adopted(path, self._kind, self.env, self.style, self.settings.hidden))

    def imitate(self, folder: Path) -> None:
        """Begin with a network that does what the dataset in `folder` shows, and keep it. Raises DatasetError."""
        from servoid.policy.recording import read_recording, source_of
        from servoid.tools.learn.demonstrations import Mirrors, cloned, demonstrated

        env, seed = self.env, self.settings.seed
        recording = read_recording(folder, env.robot)
        rng = np.random.default_rng(seed)
        both = self.settings.mirror > 0.0  # sides: where a mirror image counts as little, the task has one
        seen, targets = demonstrated(recording, env.robot, env.task.seen, env.stride, rng, both)
        actions = (targets - env.robot.home) / env.reach
        mirrors = Mirrors(env.mirrors["actor"], env.mirrors["action"]) if both else None
        self.begin_with(cloned(seen, actions, mirrors, self.settings.hidden, self.settings.imitation_steps, seed))
        self.begun_with = {"demonstrations": source_of(folder, recording)}
        self.ship(self.out / _IMITATION, self.progress)

    def state(self) -> dict[str, Any]:
        return {**super().state(), "score": self.env.score.state()}

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        super().restore(path, saved)
        self.env.score.restore(saved["score"])

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        env = self.env
        config = {
            "hidden": list(self.settings.hidden),
            "task": env.task.name,
            "goal": env.task.goal,
            "stride": env.stride,
            "reach": [round(float(x), 6) for x in env.reach],
            "prior": self._prior,
            "lead": None if env.lead is None else asdict(env.lead.pace),
            "style": self._style,
        }
        about: dict[str, Any] = {
            "data": self.source,
            "licence": _LICENCE if env.score.prior is None else env.score.prior.header["licence"],
            "results": results,
            "training": plain(self.settings),
        }
        env.score.keep(path.parent, about)
        save = save_rising_policy if self._kind == RISING else save_task_policy
        save(path, self.actor(), env.robot, config, about)
