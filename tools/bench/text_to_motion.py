"""Measure how well a planner's motions go with its sentences: R-precision, FID, distances and variety.

A contrastive encoder of motions and sentences is trained first, on the takes that `servoid train planner` makes, as
authored and, with --tracker, as executed. By it are compared, each told the same sentences: the data's own motions that
no training saw, the planner alone, the planner told other sentences, and what the robot does of its plans in physics,
in a closed loop from standing. How many different motions there are is printed: the more, the harder it is to tell them
apart.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common.output import Report, add_json_argument, reporting

if TYPE_CHECKING:
    import torch

    from servoid.hw.contracts.body import Array
    from servoid.policy.diffusion.prefix.dataset import PlanWindows
    from servoid.policy.diffusion.prefix.retrieval import RetrievalNetwork

_BATCH = 64


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid bench text-to-motion`."""
    parser.add_argument("--planner", type=Path, required=True, metavar="FILE", help="a planner's .safetensors file")
    parser.add_argument("--tracker", metavar="CHECKPOINT", help="tracker of clips: measure the closed loop, too")
    parser.add_argument("--steps", type=int, default=1500, help="of the encoder's training (default: 1500)")
    parser.add_argument("--each", type=int, default=8, help="motions of each sentence (default: 8)")
    parser.add_argument("--takes", type=int, default=400, help="takes of clips, and half as many walks (default: 400)")
    parser.add_argument("--text-weight", type=float, default=2.5, help="of guidance by the sentence (default: 2.5)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: 0)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Measure; returns 0. Raises ConfigError."""
    if min(args.steps, args.each) < 1 or args.takes < 40:
        raise ConfigError("--steps and --each must be positive, and --takes at least 40: some are held out")
    with reporting(args.json) as report:
        _run(args, report)
    return 0


def _run(args: argparse.Namespace, report: Report) -> None:
    import numpy as np
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.prefix.frames import Frames
    from servoid.policy.diffusion.prefix.model import load
    from servoid.policy.text.encoder import load_encoder
    from servoid.tools.evaluate.retrieval import COLUMNS, POOL, measures
    from servoid.tools.learn.planner_settings import PlannerTraining
    from servoid.tools.learn.takes.learned import learned_from

    torch.set_num_threads(1)
    robot = load_robot()
    frames = Frames(robot)
    model = load(args.planner, robot, frames)
    encoder, shape = load_encoder(model.config.text), model.config
    settings = PlannerTraining(
        clip_takes=args.takes, walk_takes=args.takes // 2, walk_seconds=12.0, seed=args.seed + 1,
        prefix=shape.prefix, frames=shape.frames, words=shape.words,
    )  # fmt: skip
    windows, _, _ = learned_from(robot, frames, encoder, settings, None, args.tracker)
    windows.normaliser = model.normaliser
    if len(windows.labels) < POOL:
        raise ConfigError(
            f"only {len(windows.labels)} motions are among the takes held out, and {POOL} are compared: more --takes"
        )
    network = trained(windows, shape.size, shape.text_size, args.steps, args.seed)
    labels = windows.labels
    report.line(f"{len(labels)} different motions; the encoder saw {windows.count:,} windows in {args.steps} steps")
    text = torch.stack([windows.sentences.first(label) for label in labels])
    generator, rng = torch.Generator().manual_seed(args.seed), np.random.default_rng(args.seed)
    number = np.repeat(np.arange(len(labels)), args.each)
    told = torch.tensor([labels[i] for i in number])
    batch = windows.held_out_of(told, generator)
    with torch.inference_mode():
        codes = network.text(text).numpy()
        own = network.motion(batch.frames[:, shape.prefix :]).numpy()
    found = {"data": own}
    shuffled = torch.from_numpy(rng.permutation(len(number)))
    for name, words in (("planner", text[number]), ("shuffled text", text[number][shuffled])):
        found[name] = planned(args, model, frames, windows, network, batch.frames, words)
    if args.tracker is not None:
        found["after physics"] = executed(args, frames, windows, network, [windows.sentences.said(i) for i in labels])
    rows, rounded = [], {}
    for name, motion in found.items():
        which = np.repeat(np.arange(len(labels)), len(motion) // len(labels))
        values = measures(motion, codes, which, own, np.random.default_rng(args.seed))
        rounded[name] = {key: round(value, 4) for key, value in values.items()}
        rows.append([name, *(f"{values[column]:.3f}" for column in COLUMNS)])
    report.table(("motions of", *COLUMNS), rows)
    report.result({"motions": len(labels), "each": args.each, "measures": rounded})


def trained(windows: PlanWindows, size: int, text_size: int, steps: int, seed: int) -> RetrievalNetwork:
    """An encoder that has learned to tell motions by their sentences, half of them as executed."""
    import torch

    from servoid.policy.diffusion.prefix.retrieval import RetrievalNetwork

    torch.manual_seed(seed)
    network = RetrievalNetwork(size, text_size)
    optimiser = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=1e-3)
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        batch, label = windows.labelled(_BATCH, generator, executed=step % 2 == 0)
        loss = network.loss(batch.frames[:, windows.shape.prefix :], batch.text, label)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return network.eval()


def planned(
    args: argparse.Namespace, model: Any, frames: Any, windows: PlanWindows, network: RetrievalNetwork,
    before: torch.Tensor, words: torch.Tensor,
) -> Array:  # fmt: skip
    """Embeddings of plans that go on from the data's own prefixes."""
    import torch

    from servoid.policy.diffusion.prefix import target
    from servoid.policy.diffusion.prefix.planner import PrefixPlanner
    from servoid.policy.diffusion.rolling import seeded

    planner, out = PrefixPlanner(model, frames, text_weight=args.text_weight), []
    prefix = windows.normaliser.decode(before[:, : windows.shape.prefix])
    for first in range(0, len(prefix), _BATCH):
        part = slice(first, first + _BATCH)
        count = len(prefix[part])
        seeds = [seeded(args.seed, first + i) for i in range(count)]
        plan = planner.plan(prefix[part], words[part], target.none(frames, count), seeds)
        with torch.inference_mode():
            out.append(network.motion(windows.normaliser.encode(plan)))
    embedded: Array = torch.cat(out).numpy()
    return embedded


def executed(
    args: argparse.Namespace, frames: Any, windows: PlanWindows, network: RetrievalNetwork, sentences: list[str]
) -> Array:
    """Embeddings of what robots do in physics that stand and are told a sentence, by the estimate, falls included."""
    import numpy as np
    import torch

    from servoid.hw.contracts.control import Instruction
    from servoid.policy.features import raw_row
    from servoid.stack.control.closed_loop import closed_loop_policy, load_settings
    from servoid.stack.control.fleet import Fleet
    from servoid.stack.estimation.odometry import load_odometry

    robot, n = frames.robot, args.each
    settings = replace(
        load_settings(), checkpoint=str(args.planner), tracker=args.tracker, text_weight=args.text_weight
    )
    policy, odometry, out = closed_loop_policy(robot, settings, shape=(n,)), load_odometry(robot), []
    ticks = settings.delay + frames.stride * windows.shape.frames + 1
    for number, sentence in enumerate(sentences):
        fleet = Fleet(robot, n, odometry, seed=args.seed, tag=2**29 + number)
        fleet.reset(np.ones(n, bool))
        policy.reset(None, np.arange(n) + n * number)
        rows = []
        for _ in range(ticks):
            state = fleet.observe()
            rows.append(raw_row(state))
            fleet.step(policy.act(state, fleet.applied, Instruction(np.zeros((n, 3)), text=sentence)))
        seen = np.stack(rows, 1)[:, settings.delay :: frames.stride]
        relative = torch.from_numpy(frames.to_relative(frames.of_states(seen)).astype(np.float32))
        with torch.inference_mode():
            out.append(network.motion(windows.normaliser.encode(relative)))
    embedded: Array = torch.cat(out).numpy()
    return embedded
