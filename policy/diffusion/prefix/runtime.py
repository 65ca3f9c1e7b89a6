"""From a request to a plan, with the planner (DiP): what was executed so far is the prefix of what comes next.

A plan requested at tick k is followed from tick k + delay on. So its prefix ends there: with the frames of the plan
that runs meanwhile behind those that were executed. All of it are frames relative to the one before, so that they go
on from wherever the robot is.

A pure function of the request, its seed and the network. In a `Plan` the actions are rows of poses (`row_layout` of
`servoid.policy.references.plan`) for whoever tracks them, and the states are frames.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Plan, PlanRequest
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.prefix import target
from servoid.policy.diffusion.prefix.frames import Anchor, BodyMotion, Frames, turned
from servoid.policy.diffusion.prefix.model import PlannerModel
from servoid.policy.diffusion.prefix.planner import PrefixPlanner
from servoid.policy.diffusion.prefix.planning import HIGHEST, Planning, led
from servoid.policy.diffusion.rolling import seeded
from servoid.policy.diffusion.runtime import one_thread
from servoid.policy.text.captions import MOTIONS, caption
from servoid.policy.text.encoder import load_encoder

_STAND = MOTIONS[0].phrasings[0]
_STILL = ("yaw_rate", "velocity", "point_velocity")  # of a frame that holds


class PlannerRuntime:
    """Answers requests on one torch thread."""

    def __init__(self, model: PlannerModel, robot: Robot, frames: Frames, planning: Planning) -> None:
        """Raises ValueError for steps that the network has not."""
        self._planner = PrefixPlanner(model, frames, steps=planning.steps, text_weight=planning.text_weight)
        self._model, self._robot, self._frames, self._planning = model, robot, frames, planning
        self._encoder = load_encoder(model.config.text)
        self._known = self._encoder.encode(model.sentences) if planning.text_nearest and model.sentences else None
        self._read: dict[str, Tensor] = {}  # sentences that were encoded

    def warm_up(self) -> None:
        """Plan once for nothing: the first call of a process takes many times longer than those that follow."""
        size, words = self._model.config.size, self._sentence(_STAND)
        with one_thread():
            prefix = torch.zeros(1, self._model.config.prefix, size)
            self._planner.plan(prefix, words, target.none(self._frames, 1), [seeded(0)], 1)

    def plan(self, request: PlanRequest, each: Sequence[Instruction] | None = None) -> Plan:
        """The plan of one robot's request, or of many at once, with one call of the network a step for all of them.

        `each`: what each of many is asked, where that is not the same. Raises ValueError where states are not finite,
        and ConfigError for a sentence without an English word, or a target that cannot be.
        """
        start, lead = time.perf_counter(), request.states.shape[:-2]
        raw = request.states.reshape(-1, *request.states.shape[-2:])
        if not np.isfinite(raw).all():
            raise ValueError("plan request: states are not finite; was every sensor read?")
        executed = self._frames.of_states(raw[:, :: self._frames.stride])
        prefix, begin = self._prefix(request, executed)
        ages = request.tick if request.ages is None else request.ages
        seeds, ages = (np.broadcast_to(x, lead).ravel() for x in (request.seeds, ages))
        generators = [seeded(int(seed), int(age)) for seed, age in zip(seeds, ages, strict=True)]
        now = Anchor.before(executed, -1)
        with one_thread():
            asked = each or [_of(request.instruction, i, len(raw)) for i in range(len(raw))]
            text, wanted = self._asked(asked, now, begin)
            # All that the network says, also where the next plan comes sooner: trackers look ahead.
            count = max(self._planning.frames, self._model.config.frames)
            planned = self._planner.plan(
                torch.from_numpy(prefix.astype(np.float32)), text, wanted, generators, count
            ).numpy()
        frames = planned.astype(float)
        motion = self._frames.to_global(frames, Anchor.before(begin, -1))
        rows = self._rows(begin, motion)
        path = turned(motion.place[..., :2] - now.place[:, None], -now.heading[:, None])
        delay, count = self._planning.delay, frames.shape[1]
        waiting = np.repeat(rows[:, :1], delay, 1)  # for the ticks until it is adopted
        actions = np.concatenate([waiting, rows], 1)
        return Plan(
            tick=request.tick,
            actions=actions.reshape(*lead, *actions.shape[1:]),
            states=frames.reshape(*lead, *frames.shape[1:]),
            path=path.reshape(*lead, count, 2),
            seconds=time.perf_counter() - start,
            ticks=delay + self._frames.stride * np.arange(1, count + 1),
        )

    def _prefix(self, request: PlanRequest, executed: BodyMotion) -> tuple[Array, BodyMotion]:
        """Frames `(batch, prefix, size)` up to where the plan begins, and that frame in the odometry frame."""
        config, planning, stride = self._model.config, self._planning, self._frames.stride
        seen = self._frames.to_relative(executed)
        last, waiting = request.previous, planning.delay // stride
        if last is None:
            coming, before = np.repeat(self._held(seen[:, -1:]), waiting, 1), seen
        else:
            states = last.states.reshape(len(seen), *last.states.shape[-2:])
            first = (request.tick - last.tick - planning.delay) // stride  # of its frames, those that have passed
            ahead = first + np.arange(waiting)
            held = ahead >= states.shape[1]
            coming = states[:, np.clip(ahead, 0, states.shape[1] - 1)]
            coming = np.where(held[:, None], self._held(coming), coming)
            before = seen if planning.feedback else np.concatenate([seen, states[:, : max(first, 0)]], 1)
        begin = self._frames.to_global(np.concatenate([seen[:, -1:], coming], 1), Anchor.before(executed, -2))
        return np.concatenate([before, coming], 1)[:, -config.prefix :], begin

    def _held(self, frames: Array) -> Array:
        """The same poses at rest."""
        still = frames.copy()
        for name in _STILL:
            still[..., self._frames.layout.slice(name)] = 0.0
        return still

    def _rows(self, begin: BodyMotion, motion: BodyMotion) -> Array:
        """Poses at the robot's rate `(batch, ticks, row size)`, from the tick after the plan begins."""
        stride = self._frames.stride

        def whole(name: str) -> Array:
            return np.concatenate([getattr(begin, name)[:, -1:], getattr(motion, name)], 1)

        def between(values: Array) -> Array:
            share = (np.arange(stride) + 1.0)[:, None] / stride
            steps = values[:, :-1, None] + share * (values[:, 1:, None] - values[:, :-1, None])
            return steps.reshape(len(values), -1, values.shape[-1])

        orientation = whole("orientation")
        flips = np.where((orientation[:, 1:] * orientation[:, :-1]).sum(-1) < 0.0, -1.0, 1.0)
        orientation[:, 1:] *= np.cumprod(flips, 1)[..., None]
        turn = between(orientation)
        joints = np.clip(between(whole("joints")), self._robot.lower, self._robot.upper)
        contact = np.clip(between(whole("contact")), 0.0, 1.0)
        unit = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        return np.concatenate([between(whole("place")), unit, joints, contact], -1)

    # -- what is asked -------------------------------------------------------------------------------------------------

    def _asked(
        self, asked: Sequence[Instruction], now: Anchor, begin: BodyMotion
    ) -> tuple[Tensor | None, target.BodyTarget]:
        """Sentences and targets of what each is asked, seen from where its plan begins."""
        told = [self._sentence(said) for one in asked if (said := self._said(one)).strip()]
        text = torch.cat(told) if len(told) == len(asked) else None
        targets = [target.of_points(self._frames, self._places(one)) for one in asked]
        whole = target.BodyTarget(
            *(torch.cat([getattr(one, name) for one in targets]) for name in ("places", "heading", "asked"))
        )
        away = turned(begin.place[:, -1, :2] - now.place, -now.heading)
        turn = begin.heading[:, -1] - now.heading
        return text, whole.moved(torch.from_numpy(away).float(), torch.from_numpy(turn).float())

    def _said(self, asked: Instruction) -> str:
        if asked.stand:
            return _STAND
        return caption(asked.velocity, self._robot.walking.scale) if asked.text is None else asked.text

    def _places(self, asked: Instruction) -> list[tuple[str, Array]]:
        if asked.stand:
            return []
        if asked.targets is not None:
            most, top = self._planning.turn, HIGHEST * self._robot.standing_height
            for name, values in asked.targets.items():
                if np.shape(values) == (3,) and values[2] > top:
                    raise ConfigError(
                        f"no part reaches {values[2]:.2f} m up, where '{name}' shall be; {top:.2f} m at most"
                    )
            return [
                (name, np.atleast_1d(np.clip(values, -most, most) if name == target.HEADING else values))
                for name, values in asked.targets.items()
            ]
        if asked.text is None and (asked.goal is None or asked.velocity.any()):
            place, angle = self._led(asked)
            return [("ground", place), (target.HEADING, np.atleast_1d(angle))]
        return [] if asked.goal is None else [("ground", _within(asked.goal, self._planning.reach))]

    def _led(self, asked: Instruction) -> tuple[Array, Array]:
        """Where the velocity leads to by the end of a plan, along an arc: a place `(2,)` m and a turn `()`.

        A velocity that leads to a goal is one for this moment: a plan goes no further than the goal, and toward it, and
        turns no further than to face it.
        """
        seconds = (self._model.config.frames + self._planning.delay / self._frames.stride) * self._frames.dt
        place, angle = led(asked.velocity, seconds)
        if asked.goal is None:
            return place, angle
        bearing = np.abs(np.arctan2(asked.goal[1], asked.goal[0]))
        return _within(asked.goal, float(np.linalg.norm(place))), np.clip(angle, -bearing, bearing)

    def _sentence(self, text: str) -> Tensor:
        if text not in self._read:
            if self._known is not None:
                apart = np.linalg.norm(self._known - self._encoder.encode([text]), axis=-1)
                tokens = self._encoder.tokens([self._model.sentences[int(apart.argmin())]], self._model.config.words)
            else:
                tokens = self._encoder.tokens([text], self._model.config.words)
            self._read[text] = torch.from_numpy(tokens)
        return self._read[text]


def _of(asked: Instruction, i: int, batch: int) -> Instruction:
    """What one of many that are asked for the same is asked; values may be its own."""

    def own(values: Array, *size: int) -> Array:
        return np.asarray(np.broadcast_to(values, (batch, *size))[i])

    targets = {
        name: own(values) if name == target.HEADING else own(values, np.shape(values)[-1])
        for name, values in (asked.targets or {}).items()
    }
    return replace(
        asked,
        velocity=own(asked.velocity, 3),
        goal=None if asked.goal is None else own(asked.goal, 2),
        targets=None if asked.targets is None else targets,
    )


def _within(goal: Array, reach: float) -> Array:
    """A place `(2,)` m on the way to a goal `(2,)`, so far off at most."""
    return np.asarray(goal * min(reach / max(float(np.linalg.norm(goal)), 1e-9), 1.0))
