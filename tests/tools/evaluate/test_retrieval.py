"""Text-to-motion measures: what they are of embeddings whose answer is known, and an encoder that learns."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.prefix.retrieval import RetrievalNetwork
from servoid.tools.bench import text_to_motion
from servoid.tools.evaluate.retrieval import (
    POOL,
    diversity,
    frechet_distance,
    measures,
    multimodal_distance,
    multimodality,
    r_precision,
)


def test_motions_at_their_own_sentences_are_found_and_shuffled_ones_by_chance() -> None:
    rng = np.random.default_rng(0)
    text = rng.normal(size=(40, 8))
    label = np.repeat(np.arange(40), 20)
    near = text[label] + 0.01 * rng.normal(size=(800, 8))
    assert r_precision(near, text, label, rng) == {f"r_precision_top{k}": 1.0 for k in (1, 2, 3)}
    shuffled = r_precision(rng.permutation(near), text, label, rng)
    for k in (1, 2, 3):
        assert shuffled[f"r_precision_top{k}"] == pytest.approx(k / POOL, abs=0.03)
    with pytest.raises(ValueError, match="needs 32 different sentences, not 31"):
        r_precision(near, text[:31], label, rng)


def test_distances_are_those_of_gaussians_and_of_pairs() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(20_000, 4)), 2.0 * rng.normal(size=(20_000, 4)) + [3.0, 0.0, 0.0, 0.0]
    assert frechet_distance(a, a) == pytest.approx(0.0, abs=1e-6)
    assert frechet_distance(a, b) == pytest.approx(9.0 + 4.0, rel=0.03)  # (1 + 4 - 2 * 2) in each of 4 dimensions
    text, label = np.eye(4), np.array([0, 0, 1, 1])
    motion = np.array([[1.0, 0, 0, 0], [1.0, 2.0, 0, 0], [0, 1.0, 0, 0], [0, 1.0, 4.0, 0]])
    assert multimodal_distance(motion, text, label) == pytest.approx(1.5)
    assert multimodality(motion, label) == pytest.approx(3.0)
    assert np.isnan(multimodality(motion[:2], label[[0, 2]]))
    assert diversity(a, rng) == pytest.approx(np.sqrt(8.0), rel=0.1)


def test_an_encoder_learns_which_sentence_a_motion_has() -> None:
    torch.manual_seed(0)
    shapes, words = torch.randn(POOL, 12, 6), torch.randn(POOL, 3, 5)
    words[:, 2] = torch.nan  # shorter sentences
    network = RetrievalNetwork(6, 5, width=32)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(150):
        label = torch.randint(POOL, (64,))
        loss = network.loss(shapes[label] + 0.2 * torch.randn(64, 12, 6), words[label], label)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    label = np.arange(POOL)
    with torch.inference_mode():
        motion, text = network.motion(shapes + 0.2 * torch.randn_like(shapes)).numpy(), network.text(words).numpy()
    found = measures(motion, text, label, motion, np.random.default_rng(0))
    assert found["r_precision_top3"] > 0.9
    assert measures(motion[::-1], text, label, motion, np.random.default_rng(0))["r_precision_top3"] < 0.4


def test_what_cannot_be_measured_is_refused(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    text_to_motion.add_arguments(parser)
    with pytest.raises(ConfigError, match="--takes at least 40"):
        text_to_motion.main(parser.parse_args(["--planner", str(tmp_path / "none.safetensors"), "--takes", "3"]))
