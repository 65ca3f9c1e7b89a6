"""Who teaches a task policy: any policy, the expert in a style, or clips that are played round and round."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Policy, State
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import find
from servoid.policy.references.clip import ClipReference
from servoid.policy.references.gait import Gait
from servoid.policy.references.style import load_style
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.gait import GaitPolicy
from servoid.stack.control.policies import make_policy
from servoid.stack.control.styled import StyledExpert
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.tasks import load_task
from servoid.stack.tasks.learned import LearnedTask

_BACK, _ON = 0.2, 0.6  # s from the last frame, within which the next one is looked for
_PULL, _LEARNED = 0.15, 0.01  # a tick: of what a gait is off, and of what is measured anew
_ALIKE = 0.003  # rad, root mean square of the joints: frames as near as that to each other are one pose


def teaching(name: str, task: LearnedTask, upper: str | None, lower: str | None, n: int) -> Policy:
    """The policy `name` in `n` worlds of `task`; in a style a tracker of the gait that walks so, as the prior's data
    do; of a clip that is imitated, `CLIP+CLIP...` of the library or of files, round and round.

    Raises ConfigError, also where the policy goes by a velocity and the task tells none, or CheckpointError where
    another kind of policy shall walk in a style.
    """
    robot = task.robot
    if task.motion is not None:
        return RoundOfClips(robot, [find(clip, robot) for clip in name.split("+")], (n,))
    if upper is None or lower is None:
        policy = make_policy(name, robot, load_task(task.run, {}, robot.dt, robot), realtime=False, shape=(n,))
    else:
        policy = StyledExpert(robot, load_style(upper, robot).on(load_style(lower, robot)), name, (n,))
    if isinstance(policy, ExpertPolicy | GaitPolicy) and not task.seen.velocity:
        raise ConfigError(
            f"--teacher {name} walks as it is told a velocity, and task {task.name} tells none, so it would stand: "
            "begin with --init, as location with steering"
        )
    return policy


class Teacher:
    """A policy of `n` worlds that drives some of them itself, and says of all what it would do there.

    It acts once a tick; whom it teaches decides once in a few.
    """

    def __init__(self, policy: Policy, n: int) -> None:
        self._policy = policy
        self._clock = GaitInStep(policy.gait) if isinstance(policy, ExpertPolicy) else None
        self.leads = np.ones(n, bool)  # worlds that it drives
        self._told: list[Array] = []  # targets of the ticks since `taught`

    def reset(self, where: Array, seeds: Array) -> None:
        """New episodes in the worlds `where` `(n,)` bool."""
        self._policy.reset(where, seeds)

    def __call__(self, state: State, applied: Array, told: Instruction, target: Array) -> Array:
        """Joint targets of a tick `(n, n_joints)` rad: its own where it leads, `target` elsewhere."""
        if self._clock is not None:
            self._clock(state, self.leads)
        decided = self._policy.act(state, applied, told)
        self._told.append(decided)
        return np.where(self.leads[:, None], decided, target)

    def taught(self) -> Array:
        """The mean of what it would have done since it was last asked `(n, n_joints)` rad: a decision that lasts as
        long does no better."""
        mean = np.mean(self._told, 0)
        self._told.clear()
        return np.asarray(mean)


class GaitInStep:
    """Keeps the phase of a gait of `n` worlds that of the legs where somebody else moves them.

    A gait has a clock, and who learns from what walks by it sees none: what is taught would be a step of either foot,
    by chance, and in the mean no step. Legs are late, and not quite where a gait has them: how late, is measured where
    they are moved by it.
    """

    def __init__(self, gait: Gait) -> None:
        self._gait, count = gait, gait.cycle_ticks
        ticks = np.arange(-(count // 2), count - count // 2)
        self._off = ticks[np.argsort(np.abs(ticks), kind="stable")] / count  # phases, the nearest first
        self._legs = np.unique(gait.robot.leg_index)
        self._usual = complex(1.0, 0.0)  # how far the legs' phase is from the gait's, as a turn of the unit circle
        self._measured = 0  # ticks in which that was

    def __call__(self, state: State, follows: Array) -> None:
        """Once a tick, before the gait is asked; the legs are moved by it in the worlds `follows` `(n,)` bool."""
        gait, ones = self._gait, np.ones_like(self._off)
        walks = gait.activity[:, None] * ones
        pose, _ = gait.pose(
            (gait.phase[:, None] + self._off) % 1.0,
            gait.velocity[:, None] * ones[:, None],
            walks,
            gait.lowered[:, None] * ones,
        )
        away = np.square(pose[..., self._legs] - state.position[:, None, self._legs]).mean(-1)
        turns = np.exp(2j * np.pi * self._off[away.argmin(-1)])
        known = follows & (gait.activity >= 1.0)
        if known.any():
            self._measured += 1
            self._usual += max(1.0 / self._measured, _LEARNED) * (turns[known].mean() - self._usual)
        late = np.angle(turns * np.conj(self._usual)) / (2.0 * np.pi)
        gait.phase = np.where(follows | (gait.activity <= 0.0), gait.phase, (gait.phase + _PULL * late) % 1.0)


class RoundOfClips(BasePolicy):
    """Plays clips one after the other, the first again after the last, and goes by what was commanded last instead of
    by a clock: on from the frame that is nearest to that. Of one robot or worlds of any leading `shape`.

    Who learns from it sees neither frame nor time, so its answer may depend on the pose alone, and on where that came
    from. Of frames that are alike it goes on from the last: a pose in which a clip rests would be left by chance.
    """

    def __init__(self, robot: Robot, clips: Sequence[Clip], shape: tuple[int, ...] = ()) -> None:
        """Raises ConfigError for a clip of another robot, or one that leaves the joint ranges."""
        ClipReference(robot, clips)  # says what is wrong with them
        self._joints = np.concatenate([clip.joints for clip in clips])  # (ticks, n_joints) rad
        self._near = np.arange(-round(_BACK * robot.rate), round(_ON * robot.rate) + 1)
        self.frame = np.zeros(shape, int)
        self._fresh = np.ones(shape, bool)

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._fresh = np.ones_like(self._fresh) if where is None else self._fresh | where

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        count = len(self._joints)
        if self._fresh.any():
            off = np.square(np.asarray(state.position)[..., None, :] - self._joints).mean(-1)
            self.frame = np.where(self._fresh, off.argmin(-1), self.frame)
            self._fresh = np.zeros_like(self._fresh)
        among = (self.frame[..., None] + self._near) % count
        poses, order = self._joints[among], np.arange(len(self._near))
        at = np.square(np.asarray(applied)[..., None, :] - poses).mean(-1).argmin(-1)[..., None]
        nearest = np.take_along_axis(poses, at[..., None], -2)
        alike = np.square(poses - nearest).mean(-1) < _ALIKE**2
        # Only what is alike without a break from there on: the same pose may come again.
        last = np.where((order > at) & ~alike, order, len(order)).min(-1) - 1
        self.frame = np.take_along_axis(among, last[..., None], -1)[..., 0]
        return self._joints[(self.frame + 1) % count]
