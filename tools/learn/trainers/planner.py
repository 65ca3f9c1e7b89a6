"""Train the planner of CLoSD: what follows a motion, told by a sentence and by where body parts are to be.

It learns from takes made here: the clips of the library, with what leads from one to the next, mirrored twins, and
walks of the gait; with --tracker, from the takes as that executes them, too, and with --data, from recorded walks.

On takes that it does not learn from it measures the error of the clean frames (`validation_loss`), the same with other
windows' sentences (`shuffled_loss`: no higher means that sentences are not read), by how far plans miss targets
(`target_error_m`), and the milliseconds of one core that a plan takes, with its sentence (`plan_ms`).
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.planner_settings import PlannerTraining
from servoid.tools.learn.trainers.trainer import Trainer, add_run_arguments, require_same

if TYPE_CHECKING:
    import torch

    from servoid.policy.diffusion.prefix.dataset import PlanWindows
    from servoid.policy.diffusion.prefix.planner import PrefixPlanner
    from servoid.policy.text.encoder import TextEncoder

MEASURED = ("validation_loss", "shuffled_loss", "target_error_m", "plan_ms")
_PLANS = 64  # that the missing of targets is measured on


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train planner`."""
    run = add_run_arguments(parser, PlannerTraining())
    run.add_argument("--data", type=Path, metavar="DIR", help="recorded walks (`servoid collect`) to learn from, too")
    run.add_argument("--init", type=Path, metavar="CHECKPOINT", help="start from this planner, with its normalisation")
    run.add_argument(
        "--tracker",
        metavar="CHECKPOINT",
        help="a tracker of clips: learn from the takes as it executes them in simulation, too",
    )


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    # Threads that spin while they wait for each other make a step ten times slower when another program is running.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.prefix.frames import Frames
    from servoid.policy.text.encoder import load_encoder
    from servoid.tools.learn.takes.learned import learned_from

    settings = read_settings(args, PlannerTraining())
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    frames, encoder = Frames(robot), load_encoder(settings.text)
    windows, source, licence = learned_from(robot, frames, encoder, settings, args.data, args.tracker)
    trainer = PlannerTrainer(windows, encoder, replace(settings, licence=licence), args.out, source)
    trainer.start(args.resume, args.init)
    trainer.run()
    return 0


def _plan_ms(planner: PrefixPlanner, prefix: torch.Tensor, text: torch.Tensor, plans: int = 5) -> float:
    """Processor time of a plan of one robot on one thread, so that a busy machine gives the same."""
    from servoid.policy.diffusion.prefix.target import none
    from servoid.policy.diffusion.rolling import seeded
    from servoid.policy.diffusion.runtime import one_thread

    nothing = none(planner.frames, 1)
    with one_thread():
        planner.plan(prefix, text, nothing, [seeded(0)])
        start = time.process_time()
        for number in range(plans):
            planner.plan(prefix, text, nothing, [seeded(number)])
        return 1000.0 * (time.process_time() - start) / plans


class PlannerTrainer(Trainer):
    """Trains the network; checkpoints hold the averaged one."""

    settings: PlannerTraining

    BEST = "planner.safetensors"
    LOSS = "validation_loss"
    columns = ("loss", "target_loss", "learning_rate", "steps_per_s", *MEASURED)
    panels = (("loss", "validation_loss", "shuffled_loss"), ("target_loss",), ("target_error_m",))

    def __init__(
        self, windows: PlanWindows, encoder: TextEncoder, settings: PlannerTraining, out: Path, source: str
    ) -> None:
        import torch

        from servoid.policy.diffusion.objective import Average
        from servoid.policy.diffusion.prefix import target
        from servoid.policy.diffusion.prefix.config import PlannerConfig, PlannerShape
        from servoid.policy.diffusion.prefix.network import PlannerNetwork
        from servoid.policy.diffusion.schedule import cosine_signal

        super().__init__(out, settings, source)
        torch.manual_seed(settings.seed)
        frames = windows.kinematics
        self.windows = windows
        self.config = PlannerConfig(
            size=frames.layout.size,
            target_size=target.size(frames),
            text=encoder.name,
            text_size=encoder.token_size,
            **{f.name: getattr(settings, f.name) for f in fields(PlannerShape)},
        )
        self.network = PlannerNetwork(self.config)
        self.average = Average(self.network, settings.average)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99), weight_decay=settings.weight_decay
        )
        self.signal = torch.as_tensor(cosine_signal(self.config.levels), dtype=torch.float32)
        self.generator = torch.Generator().manual_seed(settings.seed)

    def adopt(self, path: Path) -> None:
        """Take weights and normalisation of a planner, to go on with other takes, or with another prefix or other noise
        levels, which change no weight's shape. Raises ConfigError."""
        from servoid.policy.diffusion.prefix.model import load

        model = load(path, self.windows.kinematics.robot, self.windows.kinematics)
        ours = self.config
        if replace(model.config, prefix=ours.prefix, frames=ours.frames, levels=ours.levels, words=ours.words) != ours:
            raise ConfigError(f"{path}: not the network that the options ask for: {model.config}")
        weights = {name: p.detach().clone() for name, p in model.network.named_parameters()}
        self.network.load_state_dict(weights, strict=False)  # the rest are constants
        self.average.weights = {name: p.detach().clone() for name, p in weights.items()}
        self.windows.normaliser = model.normaliser

    @property
    def title(self) -> str:
        return f"a planner of {self.network.parameter_count:,} parameters on {self.windows.count:,} windows"

    @property
    def following(self) -> str:
        return f"servoid run text --policy {self.best_path}"

    def learn(self) -> dict[str, float]:
        import torch

        from servoid.policy.diffusion.prefix.objective import losses

        settings = self.settings
        warm = min(1.0, (self.step + 1) / settings.warmup_steps)
        rate = settings.learning_rate * warm * (0.5 + 0.5 * math.cos(math.pi * self.share))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        batch = self.windows.draw(settings.batch, self.generator)
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.precision == "bf16"):
            simple, target = losses(self.network, batch, self.windows, self.signal, self.generator)
        total = simple + settings.target_weight * target
        if not torch.isfinite(total):
            raise ConfigError(f"the loss is not finite at step {self.step}: try a lower --learning-rate, or fp32")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.average.update(self.network)
        self.step += 1
        return {"loss": simple.item(), "target_loss": target.item(), "learning_rate": rate}

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        text = f"loss {means['loss']:.3f}, target {means['target_loss']:.3f}, {1000 / steps_per_s:.0f} ms/step"
        return {"steps_per_s": steps_per_s}, text

    def held_out(self, count: int = 512) -> dict[str, float]:
        import torch

        from servoid.policy.diffusion.prefix.model import PlannerModel
        from servoid.policy.diffusion.prefix.network import PlannerNetwork
        from servoid.policy.diffusion.prefix.objective import losses
        from servoid.policy.diffusion.prefix.planner import PrefixPlanner
        from servoid.policy.diffusion.rolling import seeded

        network = PlannerNetwork(self.config).eval()
        network.load_state_dict(self.average.weights, strict=False)  # the rest are constants
        windows, batch = self.windows, self.windows.held_out(count)
        with torch.inference_mode():
            shuffled = replace(batch, text=batch.text.roll(1, 0))
            loss, other = (
                losses(network, given, windows, self.signal, torch.Generator().manual_seed(0))[0].item()
                for given in (batch, shuffled)
            )
            few = windows.held_out(_PLANS)
            planner = PrefixPlanner(PlannerModel(network, windows.normaliser, ()), windows.kinematics, text_weight=1.0)
            prefix = windows.normaliser.decode(few.frames[:, : self.config.prefix])
            planned = planner.plan(prefix, few.text, few.target, [seeded(i) for i in range(len(prefix))])
            distance, _ = few.target.error(windows.kinematics, planned)
            missed = distance[few.target.asked[:, :-1]].mean().item()
        model = PlannerModel(network, windows.normaliser, ())
        milliseconds = _plan_ms(PrefixPlanner(model, windows.kinematics), prefix[:1], few.text[:1])
        return dict(zip(MEASURED, (loss, other, missed, milliseconds), strict=True))

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        from servoid.policy.checkpoint import Origin
        from servoid.policy.diffusion.prefix.model import PlannerModel, save

        windows = self.windows
        origin = Origin(self.source, self.settings.licence, results, plain(self.settings))
        model = PlannerModel(self.network, windows.normaliser, windows.sentences.texts)
        save(path, self.average.weights, model, windows.kinematics, origin)

    def state(self) -> dict[str, Any]:
        return {
            "config": asdict(self.config),
            "network": self.network.state_dict(),
            "average": self.average.weights,
            "updates": self.average.updates,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "normalisation": [self.windows.normaliser.mean, self.windows.normaliser.std],
        }

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        import torch

        require_same(path, "another network", asdict(self.config), saved["config"])
        ours = self.windows.normaliser.mean, self.windows.normaliser.std
        if not all(torch.equal(a, b) for a, b in zip(ours, saved["normalisation"], strict=True)):
            raise ConfigError(f"{path}: trained on other takes; use --no-resume or another --out")
        self.network.load_state_dict(saved["network"])
        self.average.weights, self.average.updates = saved["average"], saved["updates"]
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])
