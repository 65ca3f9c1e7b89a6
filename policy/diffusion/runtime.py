"""From a request to a plan, as a pure function: the same request, seed and network give the same plan.

Receding chunk: a plan covers the horizon, its first actions run, and the next plan replaces the rest. With the rolling
schedule the next plan is denoised from the one that runs, which the request holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Plan, PlanRequest
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.diffusion.engines import Engine, load_engine
from servoid.policy.diffusion.engines.differentiable import Differentiable
from servoid.policy.diffusion.guidance import NETWORK, Differentiator, Diverged, Guidance, classifier_free
from servoid.policy.diffusion.keyframes import imputation, keyframe_tokens
from servoid.policy.diffusion.model.checkpoint import Model, load
from servoid.policy.diffusion.rolling import Previous, clean_start, frame_noise, renoise, seeded
from servoid.policy.diffusion.sampler import Known, Sampler
from servoid.policy.diffusion.schedule import DenoisingMatrix, cosine_signal
from servoid.policy.diffusion.settings import DiffusionSettings
from servoid.policy.features import joints_seen, raw_layout, to_raw, to_tokens
from servoid.policy.text.captions import MOTIONS, caption, motion_of
from servoid.policy.text.encoder import load_encoder
from servoid.policy.text.nearest_phrase import Phrasebook
from servoid.policy.text.told import clock_code
from servoid.policy.trajectory import Trajectory, by_tokens, sloped

# (trajectory, instruction) -> cost (batch,), as tasks define it
Cost = Callable[[Trajectory, Instruction], Any]

BOUND = 1000.0  # deviations: what is predicted further out than this was driven there by guidance


class Runtime:
    """Plans with a diffusion model on one torch thread."""

    def __init__(
        self,
        model: Model,
        settings: DiffusionSettings,
        robot: Robot,
        cost: Cost | None = None,
        engine: Engine | None = None,
    ) -> None:
        """Without `cost`, or with a guidance weight of 0, plans are unguided.

        `engine` is the one that the settings name, where it is loaded already. Raises ConfigError where settings and
        model do not fit, and where the engine cannot be loaded.
        """
        config = model.config
        settings.check(config, model.header.get("training"))
        self.model, self.settings = model, settings
        self._joints = joints_seen(model.states)
        self._decoding = model.states.decoding()
        self._dt, self._top = robot.dt, robot.walking.scale
        self.cost = sloped(cost) if cost is not None and settings.guidance.weight > 0 else None
        self._through = self.cost is not None and settings.guidance.gradient == NETWORK
        self.engine = engine or load_engine(settings.engine, model.denoiser, self._through)
        self.samples = settings.guidance.samples if self.cost else 1
        self.horizon = settings.horizon or config.horizon  # ticks that are planned
        self.ticks = config.future_ticks[config.future_ticks <= self.horizon]  # those of them with states,
        self.actions = min(self.horizon, config.action_horizon)  # and how many have actions
        self.matrix = settings.matrix(config)
        self._warm: dict[int, DenoisingMatrix] = {}  # rolling, by the number of fresh frames
        self._signal = cosine_signal(config.levels)
        self._encoder = load_encoder(config.text) if config.text and settings.text_weight else None
        self._phrasebook = Phrasebook(self._encoder) if self._encoder and settings.text_nearest else None
        self._read: dict[str, Tensor] = {}  # instructions that were encoded
        self._caption = lru_cache(16)(lambda *twist: caption(np.array(twist), self._top))
        used = settings.used(config)
        self._used = used[0][:, None], used[1][:, None]  # state and action tokens
        self._state_mask = torch.from_numpy((config.state_ticks <= 0) & used[0])
        self._action_ticks = torch.arange(len(config.action_ticks))
        # Phrasings of skills are told as they are; who tells them has chosen one that the model knows.
        self._skills = {text for texts in model.header.get("skills", {}).values() for text in texts}

    def plan(self, request: PlanRequest) -> Plan:
        """The plan of one robot's request, or of many at once. Raises ValueError when it does not fit, and Diverged."""
        start, lead, config = time.perf_counter(), request.states.shape[:-2], self.model.config

        def rows(x: Array) -> Array:
            return x.reshape(-1, *x.shape[len(lead) :])

        ages = request.tick if request.ages is None else request.ages
        seeds, ticks = (np.broadcast_to(x, lead).ravel() for x in (request.seeds, ages))
        last = request.previous
        previous = None
        if last:
            ticks_then = np.arange(1, last.states.shape[-2] + 1) if last.ticks is None else last.ticks
            previous = Previous(request.tick - last.tick, rows(last.states), rows(last.actions), ticks_then)
        states = rows(request.states)
        actions, predicted = self.plan_batch(
            states,
            rows(request.actions),
            request.instruction,
            [(int(seed), int(tick)) for seed, tick in zip(seeds, ticks, strict=True)],
            previous,
        )
        tokens = to_tokens(predicted, states[:, -1].astype(np.float32), self._joints)
        return Plan(
            tick=request.tick,
            actions=actions.reshape(*lead, *actions.shape[1:]),
            states=predicted.reshape(*lead, *predicted.shape[1:]),
            path=tokens[..., :2].astype(float).reshape(*lead, len(self.ticks), 2),
            seconds=time.perf_counter() - start,
            ticks=self.ticks if config.ticks else None,
        )

    def plan_batch(
        self,
        states: Array,
        actions: Array,
        instruction: Instruction,
        seeds: Sequence[tuple[int, int]],
        previous: Previous | None = None,
    ) -> tuple[Array, Array]:
        """Plans of many robots at once, each with its own (seed, tick).

        `states` is `(batch, history, raw size)`, the present last; `actions` is `(batch, history - 1 + delay,
        action size)`: those applied, then those that will run anyway, as the model has actions (`Model.space`).
        `previous` are the plans that run, None at first; only the rolling schedule reads them. Returns actions
        `(batch, actions, action size)` from the present tick on, joint targets [rad] or latents that are decoded with
        the state of their own tick; and predicted raw rows `(batch, horizon, raw size)` at `ticks` ahead, in the
        odometry frame.
        Batches of different size may differ in the last bits. Raises ValueError like `plan`.
        """
        self._check(states, actions)
        n, history = self.samples, self.model.config.history
        with one_thread(), torch.no_grad() if self._through else torch.inference_mode():
            # Sample i of a robot's n draws noise of its own; the first one's does not depend on n.
            keys = [(*pair, *((i,) if i else ())) for pair in seeds for i in range(n)]
            known = self.known(states, actions, instruction)
            matrix, start = self._start(keys, states[:, -1], previous)
            text = self._text(instruction, len(states))
            text = text if text is None or n == 1 else text.repeat_interleave(n, 0)
            predict = classifier_free(self.engine, text, self.settings.text_weight)
            sampler = Sampler(predict, self._signal, self.settings.eta, self.settings.stabilization_level)
            guidance = self._guidance(_repeat(instruction, n), text)
            drawn = start is None or self.settings.eta > 0
            clean = sampler.sample(matrix, known, [seeded(*key) for key in keys if drawn], guidance, start)
            reach = [np.abs(x.numpy()).max(initial=0.0, where=used) for x, used in zip(clean, self._used, strict=True)]
            if not all(each < BOUND for each in reach):  # nor what is not a number
                raise Diverged(
                    f"the plan leaves all bounds ({max(reach):.3g} deviations); lower the weight of guidance"
                )
            chosen = self._choose(clean[0], guidance)
            future, now = slice(history, history + len(self.ticks)), slice(history - 1, history - 1 + self.actions)
            tokens = self.model.states.decode(clean[0][chosen, future]).numpy()
            planned = self.model.actions.decode(clean[1][chosen, now]).numpy()
        return planned.astype(float), to_raw(tokens, states[:, -1].astype(np.float32), self._joints)

    def warm_up(self) -> None:
        """Plan once for nothing: the first call of a process takes many times longer than those that follow."""
        config = self.model.config
        states = np.zeros((1, config.history, raw_layout(self._joints).size))
        actions = np.zeros((1, config.history - 1 + self.settings.delay, config.action_size))
        with suppress(Diverged):  # a robot that is nowhere may well be out of bounds; a real plan will say so
            self.plan_batch(states, actions, Instruction(np.zeros(3), goal=np.zeros(2)), [(0, 0)])

    def _check(self, states: Array, actions: Array) -> None:
        config, rows = self.model.config, raw_layout(self._joints).size
        if states.shape[1:] != (config.history, rows):
            raise ValueError(f"plan request: states are {states.shape[1:]}, ({config.history}, {rows}) are needed")
        past = config.history - 1
        if actions.shape[2:] != (config.action_size,) or not past <= actions.shape[1] < len(config.action_ticks):
            raise ValueError(
                f"plan request: actions are {actions.shape[1:]}, ({past} past + delay, {config.action_size}) are needed"
            )
        if not (np.isfinite(states).all() and np.isfinite(actions).all()):
            raise ValueError("plan request: states or actions are not finite; was every sensor read?")

    def known(self, states: Array, actions: Array, instruction: Instruction) -> Known:
        """Past states and past and committed actions, clean and normalised, and keyframes; `samples` of each window.

        A keyframe counts when it comes to a tick that has a token: those further ahead will come in later.
        """
        config, batch = self.model.config, len(states)
        present = np.asarray(states[:, -1], dtype=float)
        # Differences of a long walk's displacements want more than float32.
        rows = to_tokens(np.asarray(states, dtype=float), present, self._joints)
        filled = torch.zeros(batch, len(config.state_ticks), config.state_size)
        filled[:, : config.history] = self.model.states.encode(torch.from_numpy(rows.astype(np.float32)))
        state_mask, impute = self._state_mask, None
        if instruction.keyframes is not None and len(instruction.keyframes.ticks):
            ticks, given = keyframe_tokens(instruction.keyframes, present, self._joints)
            tokens = torch.from_numpy(given.astype(np.float32))
            index = torch.from_numpy(np.searchsorted(config.state_ticks, ticks))
            whole, inside = tokens.isfinite().all(2).all(0), torch.from_numpy(np.isin(ticks, self.ticks))
            exact, partly = inside & whole, inside & ~whole
            filled[:, index[exact]] = self.model.states.encode(tokens[:, exact])
            state_mask = state_mask.index_fill(0, index[exact], True)
            if partly.any():
                pinned = tokens[:, partly].repeat_interleave(self.samples, 0)
                impute = imputation(self.model.states, index[partly], pinned)
        ran = torch.from_numpy(np.ascontiguousarray(actions, dtype=np.float32))
        done = torch.zeros(batch, len(config.action_ticks), config.action_size)
        done[:, : ran.shape[1]] = self.model.actions.encode(ran)
        action_mask = (self._action_ticks < ran.shape[1]) & torch.from_numpy(self._used[1][:, 0])
        filled, done = self._sampled(filled), self._sampled(done)
        return Known(filled, done, state_mask, action_mask, impute)

    def _start(
        self, keys: Sequence[Sequence[int]], present: Array, previous: Previous | None
    ) -> tuple[DenoisingMatrix, tuple[Tensor, Tensor] | None]:
        """The matrix to walk, and what is denoised: for the rolling schedule, what is left of the plans that run."""
        if self.settings.schedule != "rolling":
            return self.matrix, None
        model, matrix = self.model, self.matrix
        noise = frame_noise(model.config, keys)
        if previous is None or not 0 <= previous.age < self.actions:
            return matrix, noise
        if previous.age not in self._warm:
            self._warm[previous.age] = self.settings.matrix(model.config, previous.age)
        matrix = self._warm[previous.age]
        clean = clean_start(model.config, model.states, model.actions, previous, present)
        return matrix, renoise((self._sampled(clean[0]), self._sampled(clean[1])), noise, matrix, self._signal)

    def _sampled(self, windows: Tensor) -> Tensor:
        """Each window once for each of its samples."""
        return windows if self.samples == 1 else windows.repeat_interleave(self.samples, 0)

    def _choose(self, states: Tensor, guidance: Guidance | None) -> slice | Array:
        """The sample of each robot that is run, as rows `(batch,)` of the samples' clean windows `states`."""
        if guidance is None or self.samples == 1 or self.settings.guidance.choose == "mean":
            return slice(None, None, self.samples)
        costs, _ = guidance.slope(states.numpy())
        cheapest: Array = np.arange(0, len(states), self.samples) + costs.reshape(-1, self.samples).argmin(1)
        return cheapest

    def _text(self, instruction: Instruction, batch: int) -> Tensor | None:
        """The encoded sentence `(batch, text size)`; where the task gives none, one that names the asked motion.

        An empty one tells nothing: motion is then unconditional. A phrasing that was not trained with would be a code
        that the network never saw, so the nearest of those that were is shown to it.
        """
        if self._encoder is None or instruction.text == "":
            return None
        velocity = instruction.velocity
        if instruction.texts is not None:
            sentences = list(instruction.texts)
        elif instruction.text is not None:
            sentences = [instruction.text] * batch
        elif velocity.ndim == 1:
            sentences = [self._caption(*velocity.tolist())] * batch
        else:
            sentences = [MOTIONS[i].phrasings[0] for i in motion_of(velocity, self._top)]
        for sentence in set(sentences) - self._read.keys():
            book = None if sentence in self._skills else self._phrasebook
            phrasing = book.familiar(sentence) if book else sentence
            self._read[sentence] = torch.from_numpy(self._encoder.encode([phrasing])[0])
        codes = torch.stack([self._read[sentence] for sentence in sentences])
        if not (waves := self.model.config.clock):
            return codes
        since = np.zeros(batch) if instruction.since is None else np.broadcast_to(instruction.since, batch)
        return torch.cat([codes, torch.from_numpy(clock_code(since, waves))], 1)

    def _guidance(self, instruction: Instruction, text: Tensor | None) -> Guidance | None:
        if (cost := self.cost) is None:
            return None
        history, (matrix, offset) = self.model.config.history, self._decoding
        future = slice(history, history + len(self.ticks))

        def slope(states: Array) -> tuple[Array, Array]:
            tokens = states[:, future] @ matrix
            tokens += offset
            trajectory = Trajectory.of(tokens, self._joints, self._dt, self.ticks)
            value, on_trajectory = cost.slope(trajectory, instruction)
            gradient = np.zeros_like(states)
            np.matmul(by_tokens(on_trajectory, tokens, self._joints), matrix.T, out=gradient[:, future])
            return value, gradient

        chosen = self.settings.guidance
        shared = self.samples if chosen.choose == "mean" else 1
        differentiated: Differentiator | None = None
        if (
            self._through
            and isinstance(self.engine, Differentiable)
            and (text is None or self.settings.text_weight == 1)
        ):
            differentiated = partial(self.engine.differentiated, text=text)
        return Guidance(
            slope,
            chosen.weight,
            chosen.clip,
            chosen.gradient,
            shared,
            scaled=chosen.scaled,
            even=chosen.even,
            limited=chosen.limited,
            repeats=chosen.repeats,
            actions=chosen.actions,
            differentiated=differentiated,
        )


def load_runtime(robot: Robot, settings: DiffusionSettings, cost: Cost | None = None) -> Runtime:
    """The runtime of the checkpoint that `settings` name, for `robot`. Raises ConfigError."""
    return Runtime(load(resolve(settings.checkpoint, robot), robot), settings, robot, cost)


def _repeat(instruction: Instruction, samples: int) -> Instruction:
    """The instruction of each of many robots, where they have their own, once for every sample."""
    if samples == 1 or instruction.velocity.ndim == 1:
        return instruction
    goal = None if instruction.goal is None else np.repeat(instruction.goal, samples, 0)
    return replace(instruction, velocity=np.repeat(instruction.velocity, samples, 0), goal=goal)


@contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread inside: two wait for each other on a busy machine, and sums depend on how many there are."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
