"""A denoiser as an ONNX graph, for engines other than torch."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from servoid.hw.user_folders import user_folder
from servoid.policy.diffusion.model.backward import Backward, Forward, kept_names
from servoid.policy.diffusion.model.denoiser import Denoiser

OPSET = 18
OUTPUTS = ("clean_states", "clean_actions")
# What is exported: the network, or the two passes of its gradient (see servoid.policy.diffusion.model.backward).
WHOLE, FORWARD, BACKWARD = "whole", "forward", "backward"
GRADIENT = "gradient"
_DIGEST = 32  # bytes of a file before the graph: its SHA-256
_VERSION = 2  # of the graph that is made of a denoiser: files of another one are not read


def exported(denoiser: Denoiser, part: str = WHOLE) -> bytes:
    """The graph of `to_onnx`, kept in the user's cache folder, because exporting takes seconds."""
    path = cache_path(denoiser, part)
    with contextlib.suppress(OSError):  # it was not made before, or the folder cannot be read
        kept = path.read_bytes()
        if hashlib.sha256(kept[_DIGEST:]).digest() == kept[:_DIGEST]:  # else the file is damaged
            return kept[_DIGEST:]
    graph = to_onnx(denoiser, part)
    with contextlib.suppress(OSError):  # without a folder to write to, it is made anew the next time
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.stem, suffix=".partial", delete=False) as file:
            file.write(hashlib.sha256(graph).digest() + graph)
        os.replace(file.name, path)  # whole or not at all, also with several processes at once
    return graph


def cache_path(denoiser: Denoiser, part: str = WHOLE) -> Path:
    """Where the graph of these weights is kept: under servoid/ in $XDG_CACHE_HOME, or ~/.cache. For a user without a
    home it is where nothing can be."""
    made_by = {"config": asdict(denoiser.config), "torch": torch.__version__, "opset": OPSET, "version": _VERSION}
    made_by |= {} if part == WHOLE else {"part": part}
    digest = hashlib.sha256(json.dumps(made_by, sort_keys=True).encode())
    for name, weights in sorted(denoiser.state_dict().items()):
        digest.update(name.encode() + weights.numpy().tobytes())
    folder = user_folder("XDG_CACHE_HOME", ".cache") or Path(os.devnull)
    return folder / "engines" / digest.hexdigest()[:32]


def to_onnx(denoiser: Denoiser, part: str = WHOLE) -> bytes:
    """The graph, its weights included.

    Inputs `states` `(batch, state tokens, state_size)`, `actions` `(batch, action tokens, action_size)` float32,
    `state_levels` and `action_levels` `(batch, tokens)` int64 and, where the network reads instructions, `text`
    `(batch, text_size)` float32 and `text_mask` `(batch,)` bool. Outputs `clean_states` and `clean_actions`; of the
    forward pass those that are kept as well. The backward pass takes these, and `pull` on clean states, and gives
    `gradient` on noisy ones. Any batch.
    """
    config = denoiser.config
    n_states, n_actions, batch = len(config.state_ticks), len(config.action_ticks), 2  # 1 would be taken for fixed
    inputs = {
        "states": torch.zeros(batch, n_states, config.state_size),
        "actions": torch.zeros(batch, n_actions, config.action_size),
        "state_levels": torch.zeros(batch, n_states, dtype=torch.int64),
        "action_levels": torch.zeros(batch, n_actions, dtype=torch.int64),
    }
    if config.text_size:
        inputs["text"] = torch.zeros(batch, config.text_size)
        inputs["text_mask"] = torch.ones(batch, dtype=torch.bool)
    if part == WHOLE:
        return _graph(denoiser, inputs, OUTPUTS)
    forward, kept = Forward(denoiser), kept_names(denoiser)
    if part == FORWARD:
        return _graph(forward, inputs, (*OUTPUTS, *kept))
    with torch.no_grad():
        made = forward(*inputs.values())[len(OUTPUTS) :]
    inputs = {"pull": torch.zeros_like(inputs["states"]), **dict(zip(kept, made, strict=True))}
    return _graph(Backward(denoiser), inputs, (GRADIENT,))


def _graph(module: nn.Module, inputs: dict[str, Tensor], outputs: Sequence[str]) -> bytes:
    any_batch = {0: torch.export.Dim("batch")}
    shapes: tuple[Any, ...] = (any_batch,) * len(inputs)
    if isinstance(module, Backward):  # takes as many as are kept
        shapes = (any_batch, shapes[1:])
    # With gradients enabled attention is spelled out (see denoiser._attend), which every engine can read and fuse.
    with _quiet(), torch.enable_grad():
        program = torch.onnx.export(
            module,
            tuple(inputs.values()),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_shapes=shapes,
        )
    assert program is not None
    graph: bytes = program.model_proto.SerializeToString()
    return graph


def quantised(graph: bytes) -> bytes:
    """The graph with the weights of its linear layers as int8, a scale each channel; inputs are quantised as they come.

    Products of two activations, as in attention, stay in float32, and so do the layers that outputs come from: they
    are small, and that of the states alone makes a third of all error.
    """
    import onnx
    from onnxruntime.quantization import QuantType, quantize_dynamic
    from onnxruntime.quantization.shape_inference import quant_pre_process

    with tempfile.TemporaryDirectory(prefix="servoid-") as folder:
        whole, folded, small = (Path(folder) / f"{name}.onnx" for name in ("whole", "folded", "small"))
        whole.write_bytes(graph)
        quant_pre_process(str(whole), str(folded), skip_symbolic_shape=True)  # weights become constants
        last = _last_products(onnx.load(str(folded)).graph)
        quantize_dynamic(folded, small, weight_type=QuantType.QInt8, per_channel=True, nodes_to_exclude=last)
        return small.read_bytes()


def _last_products(graph: Any) -> list[str]:
    """Names of the matrix products that each output of an ONNX graph is made of."""
    makers = {name: node for node in graph.node for name in node.output}
    found = []
    for output in graph.output:
        node = makers[output.name]
        while node.op_type not in ("MatMul", "Gemm"):  # the sum with the bias
            node = next(makers[name] for name in node.input if name in makers)
        found.append(node.name)
    return found


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter says of packages that are not needed and of names of axes."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
