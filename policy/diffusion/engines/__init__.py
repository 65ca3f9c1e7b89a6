"""Engines that run a denoiser: torch, which is the reference, and others that are given the network as an ONNX graph.

Each computes the same function on one thread, and is compared with torch on two windows when it is loaded. What an
output may differ by, root mean square over that of torch's output, is the engine's tolerance; so is it for the gradient
through the network, where that is asked for. Nothing heavy is imported before an engine is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array

if TYPE_CHECKING:
    from torch import Tensor

    from servoid.policy.diffusion.model.denoiser import Denoiser

# The call of a Denoiser: (states, actions, state levels, action levels, text, text_mask) -> clean states, clean actions
Engine = Callable[..., "tuple[Tensor, Tensor]"]
# Inputs by name -> outputs, in the order of the graph
RunGraph = Callable[[Mapping[str, Array]], "Sequence[Array]"]

REFERENCE = "torch"


@dataclass(frozen=True)
class EngineKind:
    """What an engine needs, how far it may be from torch, and whether it has a gradient through the network."""

    tolerance: float
    gradient: bool
    packages: tuple[str, ...] = ()
    extra: str = ""  # of this project, which installs the packages


_ONNX = ("onnxruntime", "onnxscript")
_OPENVINO = ("openvino", "onnxscript")
ENGINES: dict[str, EngineKind] = {
    REFERENCE: EngineKind(1e-5, True),  # of its own gradient, by autograd
    "onnx": EngineKind(1e-4, True, _ONNX, "onnx"),
    "onnx-int8": EngineKind(0.08, False, _ONNX, "onnx"),
    "openvino": EngineKind(1e-4, True, _OPENVINO, "openvino"),
    "openvino-bf16": EngineKind(0.04, False, _OPENVINO, "openvino"),
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


def load_engine(name: str, denoiser: Denoiser, gradient: bool = False) -> Engine:
    """A function with the signature of `denoiser` that computes it with the engine `name`.

    With `gradient` it has one on the states, which autograd finds. Raises ConfigError where there is no such engine,
    where it is not installed or has no gradient, and where what it computes differs from torch by more than its
    tolerance.
    """
    check_engine(name)
    if gradient and not ENGINES[name].gradient:
        able = ", ".join(engine for engine, kind in ENGINES.items() if kind.gradient)
        raise ConfigError(f"the engine '{name}' has no gradient through the network: set another one ({able})")
    if name == REFERENCE:
        return _torch(denoiser) if gradient else denoiser
    from servoid.policy.diffusion.engines import export

    graph = export.exported(denoiser)
    if name == "onnx-int8":
        graph = export.quantised(graph)
    load = _onnx_runtime if name.startswith("onnx") else partial(_openvino, "bf16" if "bf16" in name else "f32")
    whole = Exported(load(graph), denoiser.config.text_size)
    engine: Engine = whole
    if gradient:
        passes = [load(export.exported(denoiser, part)) for part in (export.FORWARD, export.BACKWARD)]
        engine = _with_gradient(whole, denoiser, *passes)
    error = deviation(engine, denoiser, gradient)
    if not error <= ENGINES[name].tolerance:
        raise ConfigError(
            f"the engine '{name}' differs from torch by {error:.2g} of its output on this network, more than the "
            f"{ENGINES[name].tolerance:g} allowed: set another engine ({', '.join(ENGINES)})"
        )
    return engine


def _torch(denoiser: Denoiser) -> Engine:
    """Torch by the written-out passes, which take two thirds of what autograd does."""
    from servoid.policy.diffusion.engines.differentiable import Differentiable
    from servoid.policy.diffusion.model.backward import Backward, Forward

    forward, backward = Forward(denoiser), Backward(denoiser)

    def ahead(*inputs: Tensor, **text: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        states, actions, *kept = forward(*inputs, **text)
        return states, actions, tuple(kept)

    return Differentiable(denoiser, ahead, lambda pull, kept: backward(pull, *kept))


def _with_gradient(engine: Exported, denoiser: Denoiser, forward: RunGraph, backward: RunGraph) -> Engine:
    """Exported passes of a network; what one keeps for the other stays in numpy."""
    import torch

    from servoid.policy.diffusion.engines.differentiable import Differentiable
    from servoid.policy.diffusion.model.backward import kept_names

    names = kept_names(denoiser)

    def ahead(*inputs: Tensor, **text: Tensor) -> tuple[Tensor, Tensor, tuple[Array, ...]]:
        states, actions, *kept = forward(engine.inputs(*inputs, **text))
        return torch.from_numpy(states), torch.from_numpy(actions), tuple(kept)

    def back(pull: Tensor, kept: tuple[Array, ...]) -> Tensor:
        (gradient,) = backward({"pull": pull.numpy(), **dict(zip(names, kept, strict=True))})
        return torch.from_numpy(gradient)

    return Differentiable(engine, ahead, back)


class Exported:
    """A denoiser's graph, called with torch tensors like the denoiser itself."""

    def __init__(self, run: RunGraph, text_size: int) -> None:
        self._run = run
        self._text_size = text_size
        self._told: dict[int, tuple[Array, Array]] = {}  # by batch: all are told, and an instruction for those without

    def __call__(self, *inputs: Tensor, **text: Any) -> tuple[Tensor, Tensor]:
        """See `Denoiser.forward`. Raises RuntimeError when a gradient is wanted, which a graph has not."""
        import torch

        if inputs[0].requires_grad or inputs[1].requires_grad:
            raise RuntimeError("this engine was loaded without a gradient through the network")
        states, actions = self._run(self.inputs(*inputs, **text))
        return torch.from_numpy(states), torch.from_numpy(actions)

    def inputs(
        self,
        states: Tensor,
        actions: Tensor,
        state_levels: Tensor,
        action_levels: Tensor,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
    ) -> dict[str, Array]:
        """What the graph is given. Levels that a batch shares are given for each, and a text always."""
        batch = len(states)
        levels = [
            levels.numpy() if levels.ndim == 2 else np.ascontiguousarray(levels.expand(batch, -1).numpy())
            for levels in (state_levels, action_levels)
        ]
        given = {"states": states.numpy(), "actions": actions.numpy()}
        given |= {"state_levels": levels[0], "action_levels": levels[1]}
        if not self._text_size:
            return given
        if batch not in self._told:
            self._told[batch] = np.ones(batch, bool), np.zeros((batch, self._text_size), np.float32)
        all_told, nothing = self._told[batch]
        if text is None:
            return given | {"text": nothing, "text_mask": ~all_told}
        return given | {"text": text.numpy(), "text_mask": all_told if text_mask is None else text_mask.numpy()}


def deviation(engine: Engine, denoiser: Denoiser, gradient: bool = False) -> float:
    """Root mean square of what `engine` differs by from `denoiser`, over that of the denoiser's output.

    Taken over a window alone, with one level for each tick of its tokens, and over two with levels of their own, where
    one is told a text and the other is not, as classifier-free guidance asks. The larger of states and actions, and,
    where it is asked for, of the `gradient` on the states.
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
        if gradient:
            pull = torch.randn(inputs[0].shape, generator=generator)
            slopes = []
            for network in (engine, denoiser):
                source = inputs[0].clone().requires_grad_()
                with torch.enable_grad():
                    clean, _ = network(source, *inputs[1:], **text)
                slopes.append(torch.autograd.grad(clean, source, pull)[0])
            found.append((slopes[0] - slopes[1]).norm() / slopes[1].norm().clamp_min(1e-9))
    return float(torch.stack(found).max())  # not a number where any of them is not


def _onnx_runtime(graph: bytes) -> RunGraph:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors: warnings about the graph help nobody at the robot
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    outputs = [output.name for output in session.get_outputs()]

    def run(inputs: Mapping[str, Array]) -> Sequence[Array]:
        found: Sequence[Array] = session.run(outputs, inputs)
        return found

    return run


def _openvino(precision: str, graph: bytes) -> RunGraph:
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

    def run(inputs: Mapping[str, Array]) -> Sequence[Array]:
        found = request.infer(dict(inputs))
        return [found[i] for i in range(len(found))]

    return run
