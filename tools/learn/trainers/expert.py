"""`servoid train expert`: PPO on the tracking environment, resumable at any moment."""

from __future__ import annotations

import argparse
import csv
import os
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.policy import checkpoint
from servoid.policy.mlp import Mlp
from servoid.stack.log.provenance import sha256

_BEGUN_AT = 0.5  # of the schedules: as much noise and as large steps as a tracker stands that walks already
_CRITIC_ALONE = 600_000  # samples
_ADOPTED_COUNT = 5_000_000  # samples that adopted input statistics weigh as much as


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", help="name or file (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/expert"), help="folder of the run; an old one goes on")
    parser.add_argument("--minutes", type=float, default=90.0, help="of training, this call (default: %(default)s)")
    parser.add_argument(
        "--samples", type=float, default=20e6, help="the schedules of learning rate, noise and pushes end here"
    )
    parser.add_argument("--worlds", type=int, default=512)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fresh", action="store_true", help="start anew even if --out holds a run")
    parser.add_argument(
        "--init",
        metavar="CHECKPOINT",
        help="begin with this tracker (expert: the shipped one), halfway in the schedules",
    )
    parser.add_argument("--plain-odometry", action="store_true", help="no learned correction in the estimator")


def main(args: argparse.Namespace) -> int:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the worlds use the cores
    import torch

    torch.set_num_threads(1)
    from servoid.hw.robot.description import load_robot
    from servoid.stack.estimation.odometry import load_odometry
    from servoid.tools.learn.envs.tracking import Tracking
    from servoid.tools.learn.settings import load_settings

    robot, settings = load_robot(args.robot), load_settings()
    odometry = None if args.plain_odometry else load_odometry(robot)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    env = Tracking(robot, args.worlds, odometry, settings, args.seed)
    Trainer(env, args.out, args.samples, args.fresh, args.init).learn(args.minutes)
    return 0


class Trainer:
    """PPO's outer loop: collect, update, log, save. The algorithm itself is rsl-rl's."""

    def __init__(self, env: Any, out: Path, samples: float, fresh: bool, init: str | None = None) -> None:
        import torch
        from torch.utils.tensorboard import SummaryWriter

        self.env, self.out, self.budget = env, out, samples
        self.ppo = _ppo(env)
        self.samples, self.state_file = 0, out / "state.pt"
        self.begun_with: dict[str, Any] = {}  # the tracker that training began with, if any
        if self.state_file.exists() and not fresh:
            saved = torch.load(self.state_file, weights_only=True)
            self.samples, self.begun_with = int(saved.pop("samples")), saved.pop("begun_with", {})
            if init is not None and self.begun_with.get("sha256") != sha256(checkpoint.resolve(init)):
                raise ConfigError(f"{out}: holds a run that did not begin with {init}: give --fresh, or another --out")
            try:
                self.ppo.load(saved, None, True)
            except RuntimeError:  # torch's word for weights of other shapes
                raise ConfigError(
                    f"{self.state_file}: of a tracker with other inputs or layers: give --fresh, or another --out"
                ) from None
        else:
            if init is not None:
                self.begun_with = adopt(self.ppo.actor, checkpoint.resolve(init), env)
            self._warm_up()
        forget_after(out / "progress.csv", self.samples)
        self.writer = SummaryWriter(str(out), purge_step=self.samples)
        self.lengths: deque[int] = deque(maxlen=500)

    def _warm_up(self) -> None:
        """Let the observation statistics settle first: while they move, the policy does too."""
        import torch

        self.ppo.train_mode()
        with torch.inference_mode():
            for _ in range(60):
                self.env.step(self.ppo.actor(_observations(self.env), stochastic_output=True).numpy())
                self.ppo.actor.update_normalization(_observations(self.env))
                self.ppo.critic.update_normalization(_observations(self.env))

    def learn(self, minutes: float) -> None:
        """Train for `minutes`, or until Ctrl-C; everything is saved at the end."""
        from tqdm import tqdm

        self.ppo.train_mode()
        end = time.monotonic() + 60 * minutes
        saved = time.monotonic()
        bar = tqdm(initial=self.samples, total=int(self.budget), unit="sample", unit_scale=True, mininterval=5.0)
        try:
            while time.monotonic() < end and self.samples < self.budget:
                row = self._iteration()
                bar.update(self.samples - bar.n)
                bar.set_postfix(length=f"{row['episode_ticks']:.0f}", reward=f"{row['reward']:.2f}")
                if time.monotonic() - saved > 120:
                    self._save()
                    saved = time.monotonic()
        except KeyboardInterrupt:
            pass  # stopping is a normal end: what was learned is saved below
        finally:
            bar.close()
            self._save()

    def _iteration(self) -> dict[str, float]:
        import torch

        env, s = self.env, self.env.settings
        progress = min(self.samples / self.budget, 1.0)
        if self.begun_with:
            progress = _BEGUN_AT + (1.0 - _BEGUN_AT) * progress
            # An adopted actor must not learn from a critic that knows nothing yet.
            self.ppo.actor.mlp.requires_grad_(self.samples >= _CRITIC_ALONE)
        env.push_scale = min(1.0, 0.25 + 0.75 * progress / 0.2)
        self.ppo.actor.distribution.log_std_param.fill_(np.log(np.interp(progress, [0.0, 1.0], s.noise)))
        self.ppo.learning_rate = s.learning_rate * (1.0 - 0.85 * progress)
        for group in self.ppo.optimizer.param_groups:
            group["lr"] = self.ppo.learning_rate
        begun, rewards, terms = time.monotonic(), [], []
        with torch.inference_mode():
            for _ in range(s.horizon):
                action = self.ppo.act(_observations(env)).numpy()
                ticks = env.ticks + 1
                reward, done, late = env.step(action)
                self.lengths.extend(ticks[done].tolist())
                rewards.append(float(reward.mean()))
                terms.append(env.terms)
                extras = {"time_outs": torch.as_tensor(late, dtype=torch.float32)}
                reward_t = torch.as_tensor(reward, dtype=torch.float32)
                self.ppo.process_env_step(_observations(env), reward_t, torch.as_tensor(done), extras)
            self.ppo.compute_returns(_observations(env))
        collected = time.monotonic()
        losses = self.ppo.update()
        self.samples += s.horizon * env.n
        row = {
            "samples": float(self.samples),
            "episode_ticks": float(np.mean(self.lengths)) if self.lengths else 0.0,
            "reward": float(np.mean(rewards)),
            "std": float(self.ppo.actor.output_std.detach().mean()),
            "learning_rate": self.ppo.learning_rate,
            "samples_per_s": s.horizon * env.n / (time.monotonic() - begun),
            "collect_share": (collected - begun) / (time.monotonic() - begun),
            **{f"loss_{k}": float(v) for k, v in losses.items()},
            **{f"term_{k}": float(np.mean([t[k] for t in terms])) for k in terms[0]},
        }
        for key, value in row.items():
            self.writer.add_scalar(key.replace("_", "/", 1), value, self.samples)
        self._log(row)
        return row

    def _log(self, row: dict[str, float]) -> None:
        path = self.out / "progress.csv"
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)

    def _save(self) -> None:
        import torch

        part = self.state_file.with_suffix(".part")
        torch.save({**self.ppo.save(), "samples": self.samples, "begun_with": self.begun_with}, part)
        part.replace(self.state_file)
        results = {"samples": self.samples, **({"begun_with": self.begun_with} if self.begun_with else {})}
        export(self.ppo.actor, self.env.robot, self.env.settings, self.out / "expert.safetensors", results)
        plot(self.out / "progress.csv", self.out / "progress.png")


def forget_after(path: Path, samples: int) -> None:
    """Drop the rows of a learning curve that lie after `samples`: they were not saved, or are of another run."""
    if not path.exists():
        return
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    kept = [row for row in rows if float(row["samples"]) <= samples]
    if not kept:
        path.unlink()
    elif len(kept) < len(rows):
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(kept[0]))
            writer.writeheader()
            writer.writerows(kept)


def _observations(env: Any) -> Any:
    import torch
    from tensordict import TensorDict

    return TensorDict(
        {"actor": torch.from_numpy(env.actor), "critic": torch.from_numpy(env.critic)}, batch_size=[env.n]
    )


def _with_mirrored(env: Any, obs: Any, actions: Any) -> tuple[Any, Any]:
    """Samples followed by their mirror images: a robot that walks has no better side."""
    import torch
    from tensordict import TensorDict

    def both(x: Any, mirror: Any) -> Any:
        return torch.cat([x, mirror(x)])

    if obs is not None:
        pair = {"actor": both(obs["actor"], env.mirror_actor), "critic": both(obs["critic"], env.mirror_critic)}
        obs = TensorDict(pair, batch_size=[2 * len(obs)])
    return obs, None if actions is None else both(actions, env.mirror_action)


def _ppo(env: Any) -> Any:
    from rsl_rl.algorithms import PPO

    class Shape:  # what rsl-rl reads of an environment, and `_with_mirrored` after it
        num_envs, num_actions = env.n, len(env.robot.joints)
        mirror_actor, mirror_critic, mirror_action = env.mirror_actor, env.mirror_critic, env.mirror_action

    s = env.settings
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
                "use_data_augmentation": True,
                "use_mirror_loss": True,
                "mirror_loss_coeff": s.mirror,
            },
            "use_clipped_value_loss": False,  # its clip is absolute: with returns of tens the critic never gets there
        },
    }
    return PPO.construct_algorithm(_observations(env), Shape, config, "cpu")


def adopt(actor: Any, path: Path, env: Any) -> dict[str, Any]:
    """Give the actor the weights and the input statistics of a tracker's checkpoint.

    Returns what the header of the new one says of it. Raises CheckpointError where it does not fit.
    """
    import torch

    network, head = Mlp.load(path, "tracker", env.robot, env.actor.shape[1])
    dense, norm = [m for m in actor.mlp if hasattr(m, "weight")], actor.obs_normalizer
    hidden = list(network.sizes[1:-1])
    if hidden != list(env.settings.hidden):
        raise checkpoint.CheckpointError(
            f"{path}: its hidden layers are {hidden}; say so in configs/policies/expert.yaml"
        )
    with torch.no_grad():
        for layer, (weight, bias) in zip(dense, network.layers, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.T.copy()))
            layer.bias.copy_(torch.from_numpy(bias))
        norm._mean.copy_(torch.from_numpy(network.mean))
        norm._std.copy_(torch.from_numpy(network.std - norm.eps))
        norm._var.copy_(norm._std**2)
        norm.count.fill_(_ADOPTED_COUNT)
    # The warm-up that comes next acts with the noise that training begins with.
    actor.distribution.log_std_param.data.fill_(np.log(np.interp(_BEGUN_AT, [0.0, 1.0], env.settings.noise)))
    return {"sha256": sha256(path), "git_commit": head["git_commit"], "results": head["results"]}


def export(actor: Any, robot: Any, settings: Any, path: Path, results: dict[str, Any]) -> None:
    """Write the actor as the tracker checkpoint that runs without torch."""
    dense = [m for m in actor.mlp if hasattr(m, "weight")]
    layers = [(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in dense]
    norm = actor.obs_normalizer
    network = Mlp(layers, norm._mean.numpy()[0], norm._std.numpy()[0] + norm.eps)
    head = checkpoint.header(
        "tracker",
        robot,
        config={"hidden": list(settings.hidden), "rewards": settings.rewards},
        data="closed-loop experience on the analytic gait in randomised worlds, generated by this project",
        licence="Apache-2.0",
        results=results,
    )
    network.save(path, head)


def plot(source: Path, target: Path) -> None:
    """Draw the learning curve of a run's CSV, once it has two rows."""
    if not source.exists():
        return
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = np.genfromtxt(source, delimiter=",", names=True)
    if rows.ndim == 0:
        return
    terms = [name for name in rows.dtype.names or () if name.startswith("term_")]
    figure, axes = plt.subplots(1, 3, figsize=(15, 4), layout="constrained")
    axes[0].plot(rows["samples"], rows["episode_ticks"])
    axes[0].set(xlabel="samples", ylabel="episode [ticks]")
    axes[1].plot(rows["samples"], rows["reward"])
    axes[1].set(xlabel="samples", ylabel="reward a tick")
    for name in terms:
        axes[2].plot(rows["samples"], rows[name], label=name.removeprefix("term_"))
    axes[2].set(xlabel="samples", ylabel="weighted terms a tick")
    axes[2].legend(fontsize=6, ncols=2)
    figure.savefig(target, dpi=90)
    plt.close(figure)
