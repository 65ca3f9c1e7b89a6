"""The random matrix of the emphasis projection is part of a checkpoint: drawn anew, it would be another language."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from test_runtime import ROBOT, model

from servoid.hw.contracts.body import Array
from servoid.policy.checkpoint import Origin, resolve
from servoid.policy.diffusion.model import checkpoint
from servoid.policy.features import Emphasis, Normaliser, token_layout

SIZE = token_layout(20).size


def emphasis(seed: int) -> Emphasis:
    generator = np.random.default_rng(5)
    plain = Normaliser(
        generator.standard_normal(SIZE).astype(np.float32), generator.uniform(0.1, 2.0, SIZE).astype(np.float32)
    )
    return Emphasis.of(plain, 20, 2.0, seed)


def saved(path: Path, states: Normaliser, **shape: Any) -> checkpoint.Model:
    """What comes back of a model with these states, from a file."""
    made = model(**shape)
    facts: dict[str, Any] = {"data": "made up", "licence": "Apache-2.0", "results": {}, "training": {}}
    trained = checkpoint.Trained(made.denoiser.state_dict(), made.config, states, made.actions)
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    return checkpoint.load(path, ROBOT)


def bits(states: Normaliser) -> dict[str, bytes]:
    return {name: np.ascontiguousarray(value).tobytes() for name, value in states.to_numpy().items()}


def test_the_matrix_and_its_inverse_survive_a_checkpoint_bit_by_bit(tmp_path: Path) -> None:
    made = emphasis(seed=11)
    # As the trainer has it and as numpy does; and a second time, from the file that was loaded.
    for states in (made, made.to_torch()):
        loaded = saved(tmp_path / "net.safetensors", states, state_size=2 * SIZE).states
        assert isinstance(loaded, Emphasis)
        assert set(bits(loaded)) == {"mean", "std", "project", "recover"}
        assert bits(loaded) == bits(made)
        assert all(value.dtype == np.float32 for value in loaded.to_numpy().values())
        assert bits(saved(tmp_path / "again.safetensors", loaded, state_size=2 * SIZE).states) == bits(made)
    assert bits(emphasis(seed=12))["project"] != bits(made)["project"]


def test_windows_are_encoded_and_decoded_as_before(tmp_path: Path) -> None:
    made = emphasis(seed=11)
    loaded = saved(tmp_path / "net.safetensors", made, state_size=2 * SIZE).states
    rows: Array = np.random.default_rng(0).standard_normal((4, SIZE)).astype(np.float32)
    encoded = loaded.encode(torch.from_numpy(rows))
    np.testing.assert_allclose(encoded.numpy(), made.encode(rows), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(loaded.decode(encoded).numpy(), rows, rtol=1e-4, atol=1e-4)


def test_states_without_emphasis_come_back_without(tmp_path: Path) -> None:
    loaded = saved(tmp_path / "net.safetensors", Normaliser(torch.zeros(SIZE), torch.ones(SIZE))).states
    assert type(loaded) is Normaliser


def test_the_shipped_model_has_one_which_is_kept_when_it_is_saved_again(tmp_path: Path) -> None:
    shipped = checkpoint.load(resolve("diffusion"), ROBOT)
    assert isinstance(shipped.states, Emphasis)
    path = tmp_path / "again.safetensors"
    head = shipped.header
    facts = {key: head[key] for key in ("data", "licence", "results", "training")}
    weights = shipped.denoiser.state_dict()
    trained = checkpoint.Trained(weights, shipped.config, shipped.states, shipped.actions)
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    again = checkpoint.load(path, ROBOT)
    assert bits(again.states) == bits(shipped.states)
    assert bits(again.actions) == bits(shipped.actions)
    assert all(torch.equal(value, weights[name]) for name, value in again.denoiser.state_dict().items())
