"""Latent actions: the divergence that holds them to the prior, what the decoder's state is good for, and the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_recording import write_dataset

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, Origin, read_header
from servoid.policy.features import Normaliser, raw_layout
from servoid.policy.latent.actions import (
    LatentActions,
    LatentConfig,
    load_latents,
    proprioception,
    proprioception_layout,
    same_latents,
    save_latents,
)
from servoid.policy.latent.dataset import Demonstrations
from servoid.policy.latent.network import Gaussian, LatentNetwork
from servoid.policy.recording import DatasetError, Recording, read_recording

ROBOT = load_robot()
N = len(ROBOT.joints)
ORIGIN = Origin("made up", "Apache-2.0", results={}, training={})


def latents(size: int = 6, seed: int = 0) -> LatentActions:
    """Untrained ones."""
    torch.manual_seed(seed)
    states = Normaliser(torch.randn(proprioception_layout(N).size), torch.rand(proprioception_layout(N).size) + 0.5)
    actions = Normaliser(torch.tensor(ROBOT.home, dtype=torch.float32), torch.full((N,), 0.2))
    return LatentNetwork(LatentConfig(size, 24, 2), states, actions).to_numpy()


def rows(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal((count, raw_layout(N).size)).astype(np.float32)


def test_the_divergence_is_what_sampling_finds() -> None:
    generator = torch.Generator().manual_seed(0)
    p, q = (Gaussian(*torch.randn(2, 3, 4, generator=generator)) for _ in range(2))

    def log_density(of: Gaussian, x: torch.Tensor) -> torch.Tensor:
        normal = torch.distributions.Normal(of.mean, (0.5 * of.log_variance).exp())
        return normal.log_prob(x).sum(-1)

    many = Gaussian(*(x.expand(200_000, 3, 4) for x in (p.mean, p.log_variance)))
    drawn = many.draw(generator)
    found = (log_density(p, drawn) - log_density(q, drawn)).mean(0)
    torch.testing.assert_close(p.kl(q), found, rtol=0.03, atol=0.03)
    assert (p.kl(p).abs() < 1e-6).all()


def test_the_place_in_the_world_does_not_matter() -> None:
    made, here = latents(), rows(5)
    there = here.copy()
    there[:, [0, 1, 3]] += [7.0, -3.0, 2.0]
    target = ROBOT.home + 0.1 * np.random.default_rng(1).standard_normal((5, N))
    np.testing.assert_array_equal(made.encode(here, target), made.encode(there, target))
    np.testing.assert_array_equal(made.decode(here, np.ones((5, 6))), made.decode(there, np.ones((5, 6))))
    layout = proprioception_layout(N)
    for name, part in layout.split(proprioception(here)).items():
        expected = here[:, 2:3] if name == "height" else here[:, raw_layout(N).slice(name)]
        np.testing.assert_array_equal(part, expected)


def test_numpy_computes_what_was_trained() -> None:
    torch.manual_seed(0)
    size = proprioception_layout(N).size
    states, actions = Normaliser(torch.randn(size), torch.rand(size) + 0.5), Normaliser(torch.randn(N), torch.rand(N))
    network = LatentNetwork(LatentConfig(6, 24, 2), states, actions)
    made, raw, target = network.to_numpy(), rows(40), np.random.default_rng(1).standard_normal((40, N))
    with torch.no_grad():
        state = states.encode(proprioception(torch.from_numpy(raw)))
        action = actions.encode(torch.from_numpy(target).float())
        mean = network.posterior(state, action).mean
        decoded = actions.decode(network.decoder(torch.cat([state, mean], -1)))
        prior = network.prior(state)[:, :6]
    np.testing.assert_allclose(made.encode(raw, target), mean.numpy(), atol=1e-4)
    np.testing.assert_allclose(made.decode(raw, mean.numpy()), decoded.numpy(), atol=1e-4)
    np.testing.assert_allclose(made.expected(raw), prior.numpy(), atol=1e-4)


def state_dependent(count: int, seed: int) -> Recording:
    """Targets that follow the joint positions, twenty numbers, and two decisions that the state does not show."""
    rng = np.random.default_rng(seed)
    raw = rng.standard_normal((count, raw_layout(N).size)).astype(np.float32)
    decided = rng.standard_normal((count, 2)) @ rng.standard_normal((2, N))
    action = (raw[:, raw_layout(N).slice("position")] + 0.5 * decided).astype(np.float32)
    episode = np.repeat(np.arange(count // 50), 50)
    return Recording(raw, action, action, np.zeros((count, 3), np.float32), episode, {})


def trained(recording: Recording, size: int, steps: int = 250) -> float:
    """What a space of `size` numbers loses of held-out targets [rad]."""
    pairs, generator = Demonstrations(recording, ROBOT, held_out=0.1), torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    network = LatentNetwork(LatentConfig(size, 64, 1), pairs.states, pairs.actions)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(steps):
        terms = network.terms(*pairs.draw(128, generator), generator)
        optimiser.zero_grad()
        (terms.reconstruction + 1e-3 * terms.kl).backward()
        optimiser.step()
    raw, target = (x.numpy() for x in pairs.held_out(500))
    made = network.to_numpy()
    return float(np.sqrt(np.square(made.decode(raw, made.encode(raw, target)) - target).mean()))


@pytest.mark.slow
def test_a_few_latents_are_enough_because_the_decoder_knows_the_state() -> None:
    """Four numbers cannot hold twenty joints, unless the state tells the rest."""
    recording = state_dependent(3000, seed=0)
    blind = replace(recording, raw=np.random.default_rng(9).permutation(recording.raw))
    assert trained(recording, 4) < 0.5 * trained(blind, 4)


def test_pairs_follow_each_other_in_one_episode_and_half_of_them_ran(tmp_path: Path) -> None:
    recording = read_recording(write_dataset(tmp_path / "data", ROBOT), ROBOT)
    numbered = recording.raw.copy()
    numbered[:, 2] = np.arange(len(numbered))
    pairs = Demonstrations(replace(recording, raw=numbered), ROBOT)
    raw, target = pairs.draw(600, torch.Generator().manual_seed(0))
    index = raw[..., 2].long()
    assert (index[:, 1] == index[:, 0] + 1).all()
    assert (recording.episode[index[:, 0]] == recording.episode[index[:, 1]]).all()
    mirrored = torch.from_numpy(recording.action)[index]
    plain = torch.isclose(target, mirrored).all(-1).all(-1).float().mean()
    assert 0.15 < plain < 0.35  # decided, not mirrored: a quarter
    held, wanted = pairs.held_out(50)
    assert not set(held[..., 2].long().flatten().tolist()) & set(pairs.training.tolist())
    torch.testing.assert_close(wanted, torch.from_numpy(recording.action)[held[..., 2].long()])
    with pytest.raises(DatasetError, match="two episodes"):
        Demonstrations(replace(recording, episode=np.zeros_like(recording.episode)), ROBOT)


def test_a_file_gives_the_same_space_back(tmp_path: Path) -> None:
    made, path = latents(), tmp_path / "latent.safetensors"
    save_latents(path, made, ROBOT, ORIGIN)
    loaded = load_latents(path, ROBOT)
    assert same_latents(made, loaded)
    assert not same_latents(made, latents(seed=1))
    assert not same_latents(made, None)
    assert loaded.size == 6
    np.testing.assert_array_equal(loaded.decode(rows(3), np.ones((3, 6))), made.decode(rows(3), np.ones((3, 6))))
    assert read_header(path)["config"] == {"size": 6, "width": 24, "layers": 2}


def test_what_does_not_fit_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "latent.safetensors"
    save_latents(path, latents(), ROBOT, ORIGIN)
    with pytest.raises(CheckpointError, match="joints do not fit"):
        load_latents(path, replace(ROBOT, joints=ROBOT.joints[1:]))
    with pytest.raises(CheckpointError, match="runs at 100"):
        load_latents(path, replace(ROBOT, rate=100))
    short = latents()
    save_latents(path, replace(short, decoder=short.prior), ROBOT, ORIGIN)
    with pytest.raises(CheckpointError, match="do not fit its own header"):
        load_latents(path, ROBOT)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="truncated"):
        load_latents(path, ROBOT)
    shipped = Path(__file__).resolve().parents[3] / "policy" / "checkpoints" / "expert.safetensors"
    with pytest.raises(CheckpointError, match="holds a tracker network, but a latent network is needed"):
        load_latents(shipped, ROBOT)
    with pytest.raises(ValueError, match="size must be at least 1"):
        LatentConfig(size=0)
