"""PPO on any environment: collect, update, with schedules of noise and learning rate. The algorithm is rsl-rl's."""

from __future__ import annotations

import contextlib
import io
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.mirror import Mirror
from servoid.policy.mlp import Mlp
from servoid.tools.learn.progress import counted
from servoid.tools.learn.settings import Ppo
from servoid.tools.learn.trainers.trainer import Trainer

_BEGUN_AT = 0.5  # of the schedules: as much noise and as large steps as a network stands that is trained already
_ADOPTED_COUNT = 5_000_000  # samples that adopted input statistics weigh as much as
_SETTLING = 60  # ticks

_LOSSES = ("value", "surrogate", "entropy", "symmetry")


class Environment(Protocol):
    """`n` worlds that PPO acts in. A world that is done begins its next episode within `step`."""

    @property
    def n(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    @property
    def observations(self) -> Mapping[str, Array]:
        """What is observed now, float32 `(n, size)`: by the `actor`, and by the `critic`, who may know more."""
        ...

    @property
    def mirrors(self) -> Mapping[str, Mirror]:
        """The mirror of an `action`, and of each group of observations."""
        ...

    @property
    def ticks(self) -> Array:
        """Of each world's episode so far, `(n,)`."""
        ...

    @property
    def terms(self) -> Mapping[str, float]:
        """Each weighted term of the last tick's reward, its mean over the worlds."""
        ...

    @property
    def measures(self) -> Mapping[str, float]:
        """What else of the last episodes is logged, by column."""
        ...

    @property
    def term_names(self) -> tuple[str, ...]: ...

    def reset(self) -> None:
        """Begin a new episode in every world."""

    def step(self, action: Array) -> tuple[Array, Array, Array]:
        """A tick under `action` `(n, action_size)`: reward, done, and done because time ran out, `(n,)` each.

        The latter is also said of a world that goes on, where what follows is no consequence of what was done.
        """
        ...

    def schedule(self, progress: float) -> None:
        """Make the episodes as hard as they should be at `progress` of the training, 0 to 1."""


class PpoTrainer(Trainer):
    """Trains an actor and its critic in an environment; a subclass says what its checkpoint is."""

    settings: Ppo
    critic_alone: float = 600_000  # samples, where the actor was adopted

    def __init__(self, env: Environment, settings: Ppo, out: Path, source: str) -> None:
        super().__init__(out, settings, source)
        self.env = env
        env.reset()
        self.ppo = _algorithm(env, settings)
        self.lengths: deque[int] = deque(maxlen=500)  # of the last episodes, in ticks
        terms = [f"term/{name}" for name in env.term_names]
        losses = [f"loss/{name}" for name in _LOSSES]
        measured = ("episode_ticks", "reward", "std", "learning_rate", "samples_per_s", "collect_share")
        self.columns = (*measured, *losses, *terms, *env.measures)
        self.panels = (("episode_ticks",), ("reward",), ("std", "learning_rate"), terms, tuple(env.measures))

    @property
    def progress(self) -> dict[str, Any]:
        """See `Trainer.progress`; steps are samples."""
        progress = super().progress
        return {"samples": progress.pop("step"), **progress}

    @property
    def length(self) -> str:
        return f"{self.settings.samples:,.0f} samples or {self.settings.minutes:g} minutes"

    @property
    def share(self) -> float:
        """Of the samples or of the minutes, whichever end first."""
        return min(1.0, max(self.step / self.settings.samples, self.seconds / (60 * self.settings.minutes)))

    def score(self, results: Mapping[str, float]) -> tuple[float, float]:
        """The newest is the best: rewards of one training are not comparable, for pushes grow."""
        return 0.0, float(self.step)

    def prepare(self) -> None:
        """Let the observation statistics settle first: while they move, the policy does too."""
        import torch

        self.ppo.train_mode()
        if self.step:
            return
        with torch.inference_mode():
            for _ in counted(_SETTLING, "settling the inputs"):
                self.env.step(self.ppo.actor(tensors(self.env), stochastic_output=True).numpy())
                self.ppo.actor.update_normalization(tensors(self.env))
                self.ppo.critic.update_normalization(tensors(self.env))

    def _schedule(self) -> None:
        s = self.settings
        progress = min(self.step / s.samples, 1.0)
        if self.begun_with:
            progress = _BEGUN_AT + (1.0 - _BEGUN_AT) * progress
            # An adopted actor must not learn from a critic that knows nothing yet.
            self.ppo.actor.mlp.requires_grad_(self.step >= self.critic_alone)
        self.env.schedule(progress)
        self.ppo.actor.distribution.log_std_param.fill_(np.log(np.interp(progress, [0.0, 1.0], s.noise)))
        self.ppo.learning_rate = s.learning_rate * (1.0 - 0.85 * progress)
        actor, critic = self.ppo.optimizer.param_groups
        actor["lr"], critic["lr"] = s.actor_rate * self.ppo.learning_rate, self.ppo.learning_rate

    def learn(self) -> dict[str, float]:
        """Collect `horizon` ticks in every world, and update."""
        import torch

        env, s = self.env, self.settings
        self._schedule()
        begun, rewards, terms = time.monotonic(), [], []
        with torch.inference_mode():
            for _ in range(s.horizon):
                action = self.ppo.act(tensors(env)).numpy()
                ticks = env.ticks + 1
                reward, done, late = env.step(action)
                self.lengths.extend(ticks[env.ticks == 0].tolist())
                rewards.append(float(reward.mean()))
                terms.append(env.terms)
                extras = {"time_outs": torch.as_tensor(late, dtype=torch.float32)}
                reward_t = torch.as_tensor(reward, dtype=torch.float32)
                self.ppo.process_env_step(tensors(env), reward_t, torch.as_tensor(done), extras)
            self.ppo.compute_returns(tensors(env))
        collected = time.monotonic()
        losses = self.ppo.update()
        self.step += s.horizon * env.n
        return {
            "episode_ticks": float(np.mean(self.lengths)) if self.lengths else 0.0,
            "reward": float(np.mean(rewards)),
            "std": float(self.ppo.actor.output_std.detach().mean()),
            "learning_rate": self.ppo.learning_rate,
            "collect_share": (collected - begun) / (time.monotonic() - begun),
            **{f"loss/{name}": float(losses[name]) for name in _LOSSES},
            **{f"term/{name}": float(np.mean([t[name] for t in terms])) for name in env.term_names},
            **env.measures,
        }

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        text = (
            f"episodes {means['episode_ticks']:.0f} ticks, reward {means['reward']:.3f}, {steps_per_s:,.0f} samples/s"
        )
        return {"samples_per_s": steps_per_s}, text

    def state(self) -> dict[str, Any]:
        return {"ppo": self.ppo.save()}

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        try:
            self.ppo.load(saved["ppo"], None, True)
        except (RuntimeError, ValueError):  # torch's words for weights of other shapes, and for other groups of them
            raise ConfigError(
                f"{path}: a network with other inputs or layers: use --no-resume or another --out"
            ) from None

    def begin_small(self, share: float) -> None:
        """Let the actor's actions begin at a `share` of what its initial weights give."""
        import torch

        last = _dense(self.ppo.actor)[-1]
        with torch.no_grad():
            last.weight.mul_(share)
            last.bias.mul_(share)

    def begin_with(self, network: Mlp) -> None:
        """Give the actor the weights and the input statistics of a network with the same layers."""
        import torch

        actor, norm = self.ppo.actor, self.ppo.actor.obs_normalizer
        with torch.no_grad():
            for layer, (weight, bias) in zip(_dense(actor), network.layers, strict=True):
                layer.weight.copy_(torch.from_numpy(weight.T.copy()))
                layer.bias.copy_(torch.from_numpy(bias))
            norm._mean.copy_(torch.from_numpy(network.mean))
            norm._std.copy_(torch.from_numpy(network.std - norm.eps))
            norm._var.copy_(norm._std**2)
            norm.count.fill_(_ADOPTED_COUNT)
        # The first ticks act with the noise that this training begins with.
        actor.distribution.log_std_param.data.fill_(np.log(np.interp(_BEGUN_AT, [0.0, 1.0], self.settings.noise)))

    def actor(self) -> Mlp:
        """The actor as it runs without torch."""
        norm = self.ppo.actor.obs_normalizer
        layers = [(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in _dense(self.ppo.actor)]
        return Mlp(layers, norm._mean.numpy()[0], norm._std.numpy()[0] + norm.eps)


def tensors(env: Environment) -> Any:
    """The environment's observations as rsl-rl takes them."""
    import torch
    from tensordict import TensorDict

    return TensorDict({name: torch.from_numpy(x) for name, x in env.observations.items()}, batch_size=[env.n])


def _dense(actor: Any) -> list[Any]:
    from torch import nn

    return [m for m in actor.mlp if isinstance(m, nn.Linear)]


def _with_mirrored(env: Any, obs: Any, actions: Any) -> tuple[Any, Any]:
    """Samples followed by their mirror images: a robot that walks has no better side."""
    import torch
    from tensordict import TensorDict

    def both(x: Any, name: str) -> Any:
        return torch.cat([x, env.mirrors[name](x)])

    if obs is not None:
        obs = TensorDict({name: both(obs[name], name) for name in obs.keys()}, batch_size=[2 * len(obs)])  # noqa: SIM118
    return obs, None if actions is None else both(actions, "action")


def _algorithm(env: Environment, s: Ppo) -> Any:
    import torch
    from rsl_rl.algorithms import PPO

    class Shape:  # what rsl-rl reads of an environment, and `_with_mirrored` after it
        num_envs, num_actions, mirrors = env.n, env.action_size, env.mirrors

    network = {"class_name": "MLPModel", "activation": "elu", "obs_normalization": True}
    noise = {"class_name": "GaussianDistribution", "init_std": s.noise[0], "std_type": "log", "learn_std": False}
    config = {
        "num_steps_per_env": s.horizon,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "multi_gpu": None,
        "actor": {**network, "hidden_dims": list(s.hidden), "distribution_cfg": noise},
        "critic": {**network, "hidden_dims": list(s.hidden)},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": s.epochs,
            "num_mini_batches": s.mini_batches,
            "gamma": s.discount,
            "entropy_coef": 0.0,  # the noise follows a schedule
            "learning_rate": s.learning_rate,
            "schedule": "fixed",
            # Mirrored samples alone teach an uneven policy little: they are far from what it would do, and clipped.
            "symmetry_cfg": {
                "data_augmentation_func": _with_mirrored,
                "use_data_augmentation": s.mirrored,
                "use_mirror_loss": True,
                "mirror_loss_coeff": s.mirror,
            },
            "use_clipped_value_loss": False,  # its clip is absolute: with returns of tens the critic never gets there
        },
    }
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks' layers
        ppo = PPO.construct_algorithm(tensors(env), Shape, config, "cpu")
    # Each with a rate of its own.
    ppo.optimizer = torch.optim.Adam([{"params": list(part.parameters())} for part in (ppo.actor, ppo.critic)])
    return ppo
