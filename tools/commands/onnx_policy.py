"""Write a diffusion policy for ONNX Runtime alone: programs that plan with it need neither Servoid nor torch.

POLICY is the diffusion policy's name, its settings (.yaml) or its checkpoint (.safetensors). The folder --out gets
`denoiser.onnx`, the network, and `policy.npz`, all that is calculated around it: normalisation, noise levels, the code
of the sentence --text, and an example with the plan that torch makes of it. docs/onnx_policy.py plans with them in
numpy, and compares. Plans are unguided: what a task's cost asks for is not in the files.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.model.checkpoint import Model
    from servoid.policy.diffusion.settings import DiffusionSettings

NETWORK, AROUND = "denoiser.onnx", "policy.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", metavar="POLICY", help="diffusion policy: name, settings (.yaml) or checkpoint")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into")
    parser.add_argument("--text", default="walk forward", metavar="TEXT", help="what it is told (default: %(default)s)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--replace", action="store_true", help="overwrite what is in the folder")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from dataclasses import replace

    from servoid.hw.robot.description import load_robot
    from servoid.policy.checkpoint import resolve
    from servoid.policy.diffusion.engines import check_engine
    from servoid.policy.diffusion.engines.export import exported
    from servoid.policy.diffusion.model.checkpoint import load
    from servoid.policy.diffusion.settings import DiffusionSettings, load_settings

    with reporting(args.json) as report:
        check_engine("onnx")
        robot = load_robot(args.robot)
        trained = args.policy.endswith(".safetensors")
        settings = DiffusionSettings(checkpoint=args.policy) if trained else load_settings(args.policy)
        settings = replace(settings, engine="torch")
        model = load(resolve(settings.checkpoint, robot), robot)
        _check(settings, model)
        paths = {name: args.out / name for name in (NETWORK, AROUND)}
        for path in paths.values():
            if path.exists() and not args.replace:
                raise ConfigError(f"{path}: already exists: use --replace, or choose another folder with --out")
        around = _around(settings, model, robot, args.text)
        try:
            args.out.mkdir(parents=True, exist_ok=True)
            paths[NETWORK].write_bytes(exported(model.denoiser))
            np.savez(paths[AROUND], **around)
        except OSError as error:
            raise ConfigError(f"{args.out}: cannot be written ({error.strerror}): choose another with --out") from None
        for path in paths.values():
            report.line(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        report.line(f"next: python docs/onnx_policy.py {args.out}")
        report.result({"network": paths[NETWORK], "around": paths[AROUND], "text": args.text})
    return DONE


def _check(settings: DiffusionSettings, model: Model) -> None:
    """Raises ConfigError for what needs more than a plan from noise."""
    settings.check(model.config, model.header.get("training"))
    if model.latents is not None:
        raise ConfigError(f"{settings.checkpoint}: plans latents, whose decoder is not exported")
    for name, value, needed in (
        ("schedule", settings.schedule == "rolling", "another than rolling, which goes on from the plan before"),
        ("eta", settings.eta != 0.0, "0: the example draws no noise on its way"),
        ("text_weight", settings.text_weight not in (0.0, 1.0), "0 or 1"),
    ):
        if value:
            raise ConfigError(f"{name} must be {needed}, to be exported")


def _around(settings: DiffusionSettings, model: Model, robot: Robot, text: str) -> dict[str, Any]:
    """Arrays of policy.npz."""
    import torch

    from servoid.hw.contracts.control import Instruction
    from servoid.policy.diffusion.rolling import seeded
    from servoid.policy.diffusion.runtime import Runtime
    from servoid.policy.diffusion.sampler import draw_noise
    from servoid.policy.diffusion.schedule import cosine_signal
    from servoid.policy.features import token_layout

    config, joints = model.config, len(robot.joints)
    used_states, used_actions = settings.used(config)
    ran = config.history - 1 + settings.delay
    known_states = (config.state_ticks <= 0) & used_states
    known_actions = (np.arange(len(config.action_ticks)) < ran) & used_actions
    matrix, signal = settings.matrix(config).hold(known_states, known_actions), cosine_signal(config.levels)
    runtime = Runtime(model, settings, robot)
    history = _strolling(robot, config.history)
    applied = np.tile(robot.home, (ran, 1))
    planned, _ = runtime.plan_batch(history[None], applied[None], Instruction(np.zeros(3), text=text), [(0, 0)])
    generator = [seeded(0, 0)]  # as the runtime draws it
    noise = [
        draw_noise(generator, len(ticks), size)[0].numpy()
        for ticks, size in ((config.state_ticks, config.state_size), (config.action_ticks, config.action_size))
    ]
    found: dict[str, Any] = {
        "joints": np.array(robot.names),
        "known_states": known_states,
        "known_actions": known_actions,
        "planned_from": config.history - 1,
        "planned_ticks": runtime.actions,
        "example_history": history,
        "example_ran": applied,
        "example_noise_states": noise[0],
        "example_noise_actions": noise[1],
        "example_planned": planned[0],
    }
    if config.text and settings.text_weight:
        found["text"] = _code(config.text, text, settings.text_nearest)
    elif config.text_size:
        found["untold"] = np.zeros(config.text_size, np.float32)
    for name, normaliser, size, rows in (
        ("states", model.states, token_layout(joints).size, matrix.states),
        ("actions", model.actions, joints, matrix.actions),
    ):
        with torch.no_grad():
            zero = normaliser.encode(torch.zeros(size))
            found[f"{name}_encode"] = (normaliser.encode(torch.eye(size)) - zero).numpy()
            found[f"{name}_encode_0"] = zero.numpy()
        found |= {f"{name}_{key}": value for key, value in _walk(rows, signal, settings.stabilization_level).items()}
    with torch.no_grad():
        zero = model.actions.decode(torch.zeros(config.action_size))
        found["actions_decode"] = (model.actions.decode(torch.eye(config.action_size)) - zero).numpy()
        found["actions_decode_0"] = zero.numpy()
    return found


def _strolling(robot: Robot, ticks: int) -> Array:
    """Raw rows of a robot that glides along a curve in its home pose: none of their numbers hides a mistake."""
    t = np.arange(ticks) * robot.dt
    rows = np.zeros((ticks, 13 + 2 * len(robot.joints)))
    rows[:, :4] = np.stack([1.0 + 0.2 * t, 0.5 + 0.1 * t, np.full(ticks, robot.standing_height), 0.8 + 0.5 * t], -1)
    rows[:, 4:13] = 0.2, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, -1.0
    rows[:, 13 : 13 + len(robot.joints)] = robot.home
    return rows


def _code(encoder: str, text: str, nearest: bool) -> Array:
    from servoid.policy.text.encoder import load_encoder
    from servoid.policy.text.nearest_phrase import Phrasebook

    reader = load_encoder(encoder)
    code: Array = reader.encode([Phrasebook(reader).familiar(text) if nearest else text])[0]
    return code


def _walk(rows: Array, signal: Array, stabilization_level: int) -> dict[str, Array]:
    """A denoising matrix `(calls + 1, tokens)` as each call needs it: the levels that the network is told, which tokens
    go on, and the factors of a DDIM step of theirs `(calls, 4, tokens)`: signal and noise before it, and after it."""
    kept = signal.astype(np.float32)[rows]
    a, b = kept[:-1], kept[1:]
    factors = np.sqrt([a, np.maximum(1 - a, 1e-12), b, 1 - b])
    told = np.where(rows[:-1] == 0, stabilization_level, rows[:-1])
    return {"levels": told, "goes_on": rows[1:] < rows[:-1], "factors": factors.transpose(1, 0, 2).astype(np.float32)}
