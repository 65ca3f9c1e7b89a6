"""From a request to a plan, as a pure function: the same request, seed and network give the same plan.

Receding chunk: a plan covers the horizon, its first actions run, and the next plan replaces the rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hw.hal import Array, Instruction, Plan, PlanRequest
from hw.robot import Robot
from policy.checkpoint import resolve
from policy.diffusion.checkpoint import Model, load
from policy.diffusion.features import Trajectory, raw_layout, to_raw, to_tokens
from policy.diffusion.sampler import Guidance, Known, Sampler, classifier_free
from policy.diffusion.schedule import cosine_signal, full_sequence
from policy.diffusion.settings import DiffusionSettings
from policy.text.captions import MOTIONS, motion_of
from policy.text.encoder import load_encoder

# (trajectory, instruction) -> cost (batch,), as tasks define it
Cost = Callable[[Trajectory, Instruction], Any]


class Runtime:
    """Plans with a diffusion model on one torch thread."""

    def __init__(self, model: Model, settings: DiffusionSettings, dt: float, cost: Cost | None = None) -> None:
        """`dt` is the length of a tick [s]; without `cost`, or with a guidance weight of 0, plans are unguided.

        Raises ConfigError where settings and model do not fit.
        """
        config = model.config
        settings.check(config.horizon, config.levels)
        self.model, self.settings, self.dt = model, settings, dt
        self.cost = cost if settings.guidance.weight > 0 else None
        n_states, n_actions = len(config.state_ticks), len(config.action_ticks)
        self.matrix = full_sequence(config.levels, settings.steps, n_states, n_actions, settings.lead)
        self._signal = cosine_signal(config.levels)
        self._encoder = load_encoder(config.text) if config.text and settings.text_weight else None
        self._read: dict[str, Tensor] = {}  # instructions that were encoded
        self._state_mask = torch.from_numpy(config.state_ticks <= 0)

    def plan(self, request: PlanRequest, seed: int) -> Plan:
        """The plan of one request. Raises ValueError when it does not fit the model or is not finite."""
        start = time.perf_counter()
        actions, states = self.plan_batch(
            request.states[None], request.actions[None], request.instruction, [(seed, request.tick)]
        )
        origin = request.states[-1:].astype(np.float32)
        tokens = to_tokens(states[0], origin[0], self.model.config.action_size)
        return Plan(
            tick=request.tick,
            actions=actions[0],
            states=states[0],
            path=tokens[:, :2].astype(float),
            seconds=time.perf_counter() - start,
        )

    def plan_batch(
        self, states: Array, actions: Array, instruction: Instruction, seeds: Sequence[tuple[int, int]]
    ) -> tuple[Array, Array]:
        """Plans of many robots at once, each with its own (seed, tick).

        `states` is `(batch, history, raw size)`, the present last; `actions` is `(batch, history - 1 + delay,
        n_joints)`: those applied, then those that will run anyway. Returns joint targets `(batch, horizon, n_joints)`
        from the present tick on, and predicted raw rows `(batch, horizon, raw size)`, the first one tick ahead, in the
        odometry frame. Batches of different size may differ in the last bits. Raises ValueError like `plan`.
        """
        self._check(states, actions)
        quiet = torch.inference_mode() if self.cost is None else nullcontext()
        with one_thread(), torch.no_grad(), quiet:
            raw = torch.from_numpy(np.ascontiguousarray(states, dtype=np.float32))
            # Differences of a long walk's displacements want more than float32.
            rows = to_tokens(np.asarray(states, dtype=float), np.asarray(states[:, -1], dtype=float), self._joints)
            generators = [_generator(*pair) for pair in seeds]
            known = self._known(torch.from_numpy(rows.astype(np.float32)), actions)
            predict = classifier_free(
                self.model.denoiser, self._text(instruction, len(states)), self.settings.text_weight
            )
            clean_states, clean_actions = Sampler(predict, self._signal).sample(
                self.matrix, known, generators, self._guidance(instruction)
            )
            history = self.model.config.history
            tokens = self.model.states.decode(clean_states[:, history:])
            predicted = to_raw(tokens, raw[:, -1], self._joints)
            targets = self.model.actions.decode(clean_actions[:, history - 1 :])
        return targets.numpy().astype(float), predicted.numpy()

    def warm_up(self) -> None:
        """Plan once for nothing: the first call of a process takes many times longer than those that follow."""
        config = self.model.config
        states = np.zeros((1, config.history, raw_layout(self._joints).size))
        actions = np.zeros((1, config.history - 1 + self.settings.delay, self._joints))
        self.plan_batch(states, actions, Instruction(np.zeros(3), np.zeros(2)), [(0, 0)])

    @property
    def _joints(self) -> int:
        return self.model.config.action_size

    def _check(self, states: Array, actions: Array) -> None:
        config, rows = self.model.config, raw_layout(self._joints).size
        if states.shape[1:] != (config.history, rows):
            raise ValueError(f"plan request: states are {states.shape[1:]}, ({config.history}, {rows}) are needed")
        past = config.history - 1
        if actions.shape[2:] != (self._joints,) or not past <= actions.shape[1] < past + config.horizon:
            raise ValueError(
                f"plan request: actions are {actions.shape[1:]}, ({past} past + delay, {self._joints}) are needed"
            )
        if not (np.isfinite(states).all() and np.isfinite(actions).all()):
            raise ValueError("plan request: states or actions are not finite; was every sensor read?")

    def _known(self, tokens: Tensor, actions: Array) -> Known:
        """Past states and past and committed actions, clean and normalised."""
        config, batch = self.model.config, len(tokens)
        states = torch.zeros(batch, len(config.state_ticks), config.state_size)
        states[:, : config.history] = self.model.states.encode(tokens)
        given = torch.from_numpy(np.ascontiguousarray(actions, dtype=np.float32))
        filled = torch.zeros(batch, len(config.action_ticks), config.action_size)
        filled[:, : given.shape[1]] = self.model.actions.encode(given)
        mask = torch.arange(len(config.action_ticks)) < given.shape[1]
        return Known(states, filled, self._state_mask, mask)

    def _text(self, instruction: Instruction, batch: int) -> Tensor | None:
        """The encoded sentence `(batch, text size)`; where the task gives none, one that names the asked motion."""
        if self._encoder is None:
            return None
        if instruction.text is not None:
            sentences = [instruction.text] * batch
        else:
            twists = np.broadcast_to(instruction.velocity, (batch, 3))
            sentences = [MOTIONS[i].phrasings[0] for i in motion_of(twists)]
        for sentence in set(sentences) - self._read.keys():
            self._read[sentence] = torch.from_numpy(self._encoder.encode([sentence])[0])
        return torch.stack([self._read[sentence] for sentence in sentences])

    def _guidance(self, instruction: Instruction) -> Guidance | None:
        if (cost := self.cost) is None:
            return None
        history, normaliser = self.model.config.history, self.model.states

        def of_states(states: Tensor) -> Tensor:
            tokens = normaliser.decode(states[:, history:])
            value: Tensor = cost(Trajectory.of(tokens, self._joints, self.dt), instruction)
            return value

        settings = self.settings.guidance
        return Guidance(of_states, settings.weight, settings.clip, settings.gradient)


def load_runtime(robot: Robot, settings: DiffusionSettings, cost: Cost | None = None) -> Runtime:
    """The runtime of the checkpoint that `settings` name, for `robot`. Raises ConfigError."""
    return Runtime(load(resolve(settings.checkpoint), robot), settings, robot.dt, cost)


def _generator(seed: int, tick: int) -> torch.Generator:
    """Noise of its own for each seed and tick."""
    state = np.random.SeedSequence([seed, tick]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


@contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread inside: two wait for each other on a busy machine, and sums depend on how many there are."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
