"""A multilayer perceptron in numpy: fast for one robot, the same for a thousand worlds, and free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint


class Mlp:
    """Normalised inputs, dense layers with ELU between them. Weights are `(inputs, outputs)`, float32."""

    def __init__(self, layers: list[tuple[Array, Array]], mean: Array, std: Array) -> None:
        self.layers, self.mean, self.std = layers, mean, std

    @property
    def sizes(self) -> tuple[int, ...]:
        """Inputs, hidden units of each layer, outputs."""
        return (self.layers[0][0].shape[0], *(len(bias) for _, bias in self.layers))

    def __call__(self, x: Array) -> Array:
        """Map `(..., inputs)` to `(..., outputs)`, float64."""
        y = ((x - self.mean) / self.std).astype(np.float32)
        for i, (weight, bias) in enumerate(self.layers):
            y = y @ weight + bias
            if i < len(self.layers) - 1:
                y = np.where(y > 0, y, np.expm1(np.minimum(y, 0)))
        return y.astype(float)

    def widened(self, inputs: int) -> Mlp:
        """The same network with so many more inputs at the end, which change nothing yet."""
        (first, bias), *others = self.layers
        weight = np.concatenate([first, np.zeros((inputs, first.shape[1]), np.float32)])
        mean = np.concatenate([self.mean, np.zeros(inputs, np.float32)])
        return Mlp([(weight, bias), *others], mean, np.concatenate([self.std, np.ones(inputs, np.float32)]))

    def to_tensors(self) -> dict[str, Array]:
        """Its arrays by name, float32, as a checkpoint stores them."""
        tensors = {"mean": self.mean, "std": self.std}
        for i, (weight, bias) in enumerate(self.layers):
            tensors[f"{i}.weight"], tensors[f"{i}.bias"] = weight, bias
        return {name: value.astype(np.float32) for name, value in tensors.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Array]) -> Mlp:
        """Inverse of `to_tensors`. Raises KeyError where one is missing."""
        count = sum(name.endswith(".weight") for name in tensors)
        layers = [(tensors[f"{i}.weight"], tensors[f"{i}.bias"]) for i in range(count)]
        return cls(layers, tensors["mean"], tensors["std"])

    def save(self, path: Path, head: Mapping[str, Any]) -> None:
        """Write a checkpoint with header `head`. Raises CheckpointError."""
        checkpoint.write(path, self.to_tensors(), head)

    @classmethod
    def load(cls, path: Path, kind: str, robot: Robot, inputs: int) -> tuple[Mlp, dict[str, Any]]:
        """Read a network of `kind` for `robot` with so many inputs, and its header. Raises CheckpointError."""
        head, tensors = checkpoint.read(path)
        checkpoint.check(path, head, kind, robot)
        if len(tensors["mean"]) != inputs:
            raise checkpoint.CheckpointError(
                f"{path}: takes {len(tensors['mean'])} inputs, but this program's features are {inputs}; train it again"
            )
        return cls.from_tensors(tensors), head
