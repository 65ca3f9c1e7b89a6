"""Engines that run a denoiser: torch, which is the reference, and others that are given the network as an ONNX graph.

Each computes the same function on one thread, and is compared with torch on two windows when it is loaded. What an
output may differ by, root mean square over that of torch's output, is the engine's tolerance. Nothing heavy is imported
before an engine is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array

if TYPE_CHECKING:
    from torch import Tensor

    from servoid.policy.diffusion.model.denoiser import Denoiser

# The call of a Denoiser: (states, actions, state levels, action levels, text, text_mask) -> clean states, clean actions
Engine = Callable[..., "tuple[Tensor, Tensor]"]
# Inputs by name -> clean states, clean actions
RunGraph = Callable[[Mapping[str, Array]], "tuple[Array, Array]"]

REFERENCE = "torch"


@dataclass(frozen=True)
class EngineKind:
    """What an engine needs, and how far it may be from torch."""

    tolerance: float
    packages: tuple[str, ...] = ()
    extra: str = ""  # of this project, which installs the packages


_ONNX = ("onnxruntime", "onnxscript")
_OPENVINO = ("openvino", "onnxscript")
ENGINES: dict[str, EngineKind] = {
    REFERENCE: EngineKind(0.0),
    "onnx": EngineKind(1e-4, _ONNX, "onnx"),
    "onnx-int8": EngineKind(0.08, _ONNX, "onnx"),
    "openvino": EngineKind(1e-4, _OPENVINO, "openvino"),
    "openvino-bf16": EngineKind(0.04, _OPENVINO, "openvino"),
}


def check_engine(name: str) -> None:
    """Raise ConfigError, with the remedy, where there is no such engine or it is not installed. Imports nothing."""
    if name not in ENGINES:
        raise ConfigError(f"unknown engine '{name}': {nearest(name, ENGINES)}")
    kind = ENGINES[name]
    missing = [package for package in kind.packages if find_spec(package) is None]
    if missing:
        raise ConfigError(
            f"the engine '{name}' needs {' and '.join(missing)}, which are not installed: "
            f"pip install 'servoid[{kind.extra}]', or set engine: {REFERENCE}"
        )


def load_engine(name: str, denoiser: Denoiser) -> Engine:
    """A function with the signature of `denoiser` that computes it with the engine `name`, without gradients.

    Raises ConfigError where there is no such engine, where it is not installed, and where what it computes differs from
    torch by more than its tolerance.
    """
    check_engine(name)
    if name == REFERENCE:
        return denoiser
    from servoid.policy.diffusion.engines.export import exported, quantised

    graph = exported(denoiser)
    if name == "onnx-int8":
        graph = quantised(graph)
    run = _onnx_runtime(graph) if name.startswith("onnx") else _openvino(graph, "bf16" if "bf16" in name else "f32")
    engine = Exported(run, denoiser.config.text_size)
    error = deviation(engine, denoiser)
    if not error <= ENGINES[name].tolerance:
        raise ConfigError(
            f"the engine '{name}' differs from torch by {error:.2g} of its output on this network, more than the "
            f"{ENGINES[name].tolerance:g} allowed: set another engine ({', '.join(ENGINES)})"
        )
    return engine


class Exported:
    """A denoiser's graph, called with torch tensors like the denoiser itself."""

    def __init__(self, run: RunGraph, text_size: int) -> None:
        self._run = run
        self._text_size = text_size

    def __call__(
        self,
        states: Tensor,
        actions: Tensor,
        state_levels: Tensor,
        action_levels: Tensor,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See `Denoiser.forward`. Raises RuntimeError when a gradient is wanted: only torch has one."""
        import torch

        if states.requires_grad or actions.requires_grad:
            raise RuntimeError("this engine has no gradient through the network; the engine torch has")
        batch = len(states)
        inputs = {
            "states": states,
            "actions": actions,
            "state_levels": state_levels.expand(batch, -1),
            "action_levels": action_levels.expand(batch, -1),
        }
        if self._text_size:
            # The graph always reads a text; a window that is not told it has none.
            if text is None:
                text, text_mask = torch.zeros(batch, self._text_size), torch.zeros(batch, dtype=torch.bool)
            inputs["text"] = text
            inputs["text_mask"] = torch.ones(batch, dtype=torch.bool) if text_mask is None else text_mask
        clean = self._run({name: np.ascontiguousarray(value.numpy()) for name, value in inputs.items()})
        return torch.from_numpy(clean[0]), torch.from_numpy(clean[1])


def deviation(engine: Engine, denoiser: Denoiser) -> float:
    """Root mean square of what `engine` differs by from `denoiser`, over that of the denoiser's output.

    Taken over a window alone, with one level for each tick of its tokens, and over two with levels of their own, where
    one is told a text and the other is not, as classifier-free guidance asks. The larger of states and actions.
    """
    import torch

    config = denoiser.config
    generator = torch.Generator().manual_seed(0)
    n_states, n_actions = len(config.state_ticks), len(config.action_ticks)
    found = []
    for batch in (1, 2):
        shared = () if batch == 1 else (batch,)
        inputs = (
            torch.randn(batch, n_states, config.state_size, generator=generator),
            torch.randn(batch, n_actions, config.action_size, generator=generator),
            torch.randint(config.levels + 1, (*shared, n_states), generator=generator),
            torch.randint(config.levels + 1, (*shared, n_actions), generator=generator),
        )
        text = {}
        if config.text_size and batch == 2:
            words = torch.randn(batch, config.text_size, generator=generator) / config.text_size**0.5
            text = {"text": words, "text_mask": torch.tensor([True, False])}
        with torch.no_grad():
            for ours, theirs in zip(engine(*inputs, **text), denoiser(*inputs, **text), strict=True):
                found.append((ours - theirs).norm() / theirs.norm().clamp_min(1e-9))
    return float(torch.stack(found).max())  # not a number where any of them is not


def _onnx_runtime(graph: bytes) -> RunGraph:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors: warnings about the graph help nobody at the robot
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def run(inputs: Mapping[str, Array]) -> tuple[Array, Array]:
        states, actions = session.run(["clean_states", "clean_actions"], dict(inputs))
        return states, actions

    return run


def _openvino(graph: bytes, precision: str) -> RunGraph:
    """`precision` is "f32" or "bf16". It must be said: left to itself, OpenVINO takes bf16 where the CPU has it."""
    import openvino

    settings = {
        "INFERENCE_PRECISION_HINT": precision,
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": "1",
        "NUM_STREAMS": "1",
    }
    core = openvino.Core()
    request = core.compile_model(core.read_model(graph), "CPU", settings).create_infer_request()

    def run(inputs: Mapping[str, Array]) -> tuple[Array, Array]:
        clean = request.infer(dict(inputs))
        return clean["clean_states"], clean["clean_actions"]

    return run
