"""The numpy network computes what torch does, and a file that does not fit is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from servoid.hw.robot.description import load_robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.mlp import Mlp

ROBOT = load_robot()


def network() -> tuple[nn.Sequential, Mlp]:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(7, 16), nn.ELU(), nn.Linear(16, 8), nn.ELU(), nn.Linear(8, 3))
    layers = [(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in net if isinstance(m, nn.Linear)]
    return net, Mlp(layers, np.linspace(-1, 1, 7, dtype=np.float32), np.linspace(0.5, 2, 7, dtype=np.float32))


def saved(path: Path) -> Mlp:
    _, mlp = network()
    head = checkpoint.header("tracker", ROBOT, config={}, data="none", licence="Apache-2.0", results={})
    mlp.save(path, head)
    return mlp


def test_it_equals_torch_also_where_elu_bends() -> None:
    net, mlp = network()
    x = 30 * np.random.default_rng(0).standard_normal((50, 7)).astype(np.float32)  # deep into both arms of ELU
    with torch.no_grad():
        expected = net(torch.from_numpy((x - mlp.mean) / mlp.std)).numpy()
    np.testing.assert_allclose(mlp(x), expected, rtol=1e-4, atol=1e-4)
    assert np.abs(expected).max() > 1


def test_any_leading_dimensions_and_float64_out() -> None:
    _, mlp = network()
    x = np.random.default_rng(1).standard_normal((4, 5, 7))
    y = mlp(x)
    assert y.shape == (4, 5, 3)
    assert y.dtype == np.float64
    np.testing.assert_allclose(mlp(x[2, 3]), y[2, 3], atol=1e-5)
    assert np.isfinite(mlp(np.full(7, 1e4))).all()


def test_a_file_gives_the_same_network_back(tmp_path: Path) -> None:
    mlp = saved(tmp_path / "net.safetensors")
    again, head = Mlp.load(tmp_path / "net.safetensors", "tracker", ROBOT, 7)
    x = np.random.default_rng(2).standard_normal((9, 7))
    np.testing.assert_array_equal(again(x), mlp(x))
    assert head["robot"] == "op3"
    assert head["licence"] == "Apache-2.0"


def test_what_does_not_fit_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    saved(path)
    with pytest.raises(CheckpointError, match="takes 7 inputs, but this program's features are 8"):
        Mlp.load(path, "tracker", ROBOT, 8)
    with pytest.raises(CheckpointError, match="holds a tracker network, but a odometry network"):
        Mlp.load(path, "odometry", ROBOT, 7)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="truncated"):
        Mlp.load(path, "tracker", ROBOT, 7)
