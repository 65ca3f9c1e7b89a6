"""The planner's windows, network and plans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, Origin
from servoid.policy.diffusion.prefix import target
from servoid.policy.diffusion.prefix.config import PlannerConfig, PlannerShape
from servoid.policy.diffusion.prefix.dataset import UNTOLD, PlanWindows, Sequences, ToldSentences, asked
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.diffusion.prefix.model import PlannerModel, load, save
from servoid.policy.diffusion.prefix.network import PlannerNetwork
from servoid.policy.diffusion.prefix.planner import PrefixPlanner
from servoid.policy.diffusion.rolling import seeded
from servoid.policy.features import Normaliser
from servoid.policy.recording import DatasetError
from servoid.policy.text.encoder import load_encoder

ROBOT = load_robot("op3")
FRAMES = Frames(ROBOT)
ENCODER = load_encoder("words")
SHAPE = PlannerShape(layers=1, width=32, prefix=4, frames=6, levels=5, words=6)
CONFIG = PlannerConfig(
    layers=1, width=32, prefix=4, frames=6, levels=5, words=6,
    size=FRAMES.layout.size, target_size=target.size(FRAMES), text="words", text_size=ENCODER.token_size,
)  # fmt: skip


def _model(seed: int = 0) -> PlannerModel:
    torch.manual_seed(seed)
    size = FRAMES.layout.size
    return PlannerModel(
        PlannerNetwork(CONFIG).eval(), Normaliser(torch.zeros(size), torch.ones(size)), ("wave", "kick")
    )


def _plan(planner: PrefixPlanner, prefix: torch.Tensor, text: str | None = "wave", count: int = 6) -> torch.Tensor:
    words = None if text is None else torch.from_numpy(ENCODER.tokens([text] * len(prefix), 6))
    generators = [seeded(7, i) for i in range(len(prefix))]
    return planner.plan(prefix, words, target.none(FRAMES, len(prefix)), generators, count)


def test_a_plan_depends_on_prefix_sentence_and_target_and_on_nothing_else() -> None:
    planner = PrefixPlanner(_model(), FRAMES)
    prefix = torch.randn(2, 4, FRAMES.layout.size, generator=torch.Generator().manual_seed(1))
    plan = _plan(planner, prefix)
    torch.testing.assert_close(_plan(planner, prefix), plan, atol=0.0, rtol=0.0)
    torch.testing.assert_close(_plan(planner, prefix[:1]), plan[:1], atol=1e-5, rtol=0.0)
    assert not torch.allclose(_plan(planner, prefix + 0.1), plan, atol=1e-4)
    assert not torch.allclose(_plan(planner, prefix, "kick"), plan, atol=1e-4)
    assert not torch.allclose(_plan(planner, prefix, None), plan, atol=1e-4)
    words = torch.from_numpy(ENCODER.tokens(["wave"] * 2, 6))
    there = target.of_points(FRAMES, [("ground", [0.3, 0.0])])
    both = target.BodyTarget(there.places.repeat(2, 1, 1), there.heading.repeat(2), there.asked.repeat(2, 1))
    assert not torch.allclose(planner.plan(prefix, words, both, [seeded(7, i) for i in range(2)]), plan, atol=1e-4)


def test_a_longer_plan_goes_on_from_its_own_prediction() -> None:
    planner = PrefixPlanner(_model(), FRAMES)
    prefix = torch.randn(1, 4, FRAMES.layout.size, generator=torch.Generator().manual_seed(1))
    generators = [seeded(7, 0)]
    words = torch.from_numpy(ENCODER.tokens(["wave"], 6))
    nothing = target.none(FRAMES, 1)
    first = planner.plan(prefix, words, nothing, generators)
    second = planner.plan(torch.cat([prefix, first], 1)[:, -4:], words, nothing, generators)
    torch.testing.assert_close(_plan(planner, prefix, count=9), torch.cat([first, second], 1)[:, :9])


def test_padding_of_a_sentence_says_nothing() -> None:
    network = _model().network
    frames, step, code = torch.randn(1, 10, FRAMES.layout.size), torch.tensor([3]), torch.zeros(1, CONFIG.target_size)
    text = torch.from_numpy(ENCODER.tokens(["wave now"], 6))
    short = text[:, : int(text.isfinite().all(-1).sum())]
    torch.testing.assert_close(network(frames, step, code, text), network(frames, step, code, short))
    untold = network(frames, step, code, text, torch.tensor([False]))
    torch.testing.assert_close(untold, network(frames, step, code, torch.full_like(text, torch.nan)))


def test_a_planner_is_kept_whole_in_its_file_and_refused_for_another_robot(tmp_path: Path) -> None:
    model, path = _model(), tmp_path / "planner.safetensors"
    origin = Origin("nothing", "Apache-2.0", {}, {})
    save(path, dict(model.network.named_parameters()), model, FRAMES, origin)
    loaded = load(path, ROBOT, FRAMES)
    assert loaded.sentences == ("wave", "kick")
    prefix = torch.randn(1, 4, FRAMES.layout.size)
    torch.testing.assert_close(
        _plan(PrefixPlanner(loaded, FRAMES), prefix), _plan(PrefixPlanner(model, FRAMES), prefix), atol=1e-5, rtol=0.0
    )
    names = tuple(replace(joint, name=f"{joint.name}_2") for joint in ROBOT.joints)
    with pytest.raises(CheckpointError, match="joints do not fit"):
        load(path, replace(ROBOT, joints=names), FRAMES)


def test_windows_are_told_what_is_asked_when_they_begin() -> None:
    """Where something else is asked on the way they are told nothing; a motion may come to its end."""
    stand, wave, walk = 0, 5, 2
    rows = [[wave] * 6, [wave, wave, stand, stand, stand, stand], [wave, wave, walk, walk, walk, walk], [stand] * 6,
            [stand, stand, wave, wave, wave, wave], [wave, stand, wave, wave, stand, stand]]  # fmt: skip
    assert asked(np.array(rows), stand).tolist() == [wave, wave, UNTOLD, stand, UNTOLD, UNTOLD]


def test_batches_hold_mirrored_windows_with_the_other_side_s_words() -> None:
    told = {"stand": ("stand",), "left": ("raise the left hand",)}
    sentences = ToldSentences(told, ENCODER, 6)
    generator = torch.Generator().manual_seed(0)
    both = sentences.of(torch.tensor([1, 1, UNTOLD]), torch.tensor([False, True, False]), generator)
    expected = torch.from_numpy(ENCODER.tokens(["raise the left hand", "raise the right hand"], 6))
    torch.testing.assert_close(both[:2], expected, equal_nan=True)
    assert both[2].isnan().all()

    rng = np.random.default_rng(0)
    made = Sequences()
    for _ in range(20):
        joints = ROBOT.home + 0.1 * rng.standard_normal((60, len(ROBOT.joints)))
        place, orientation = np.tile([0.0, 0.0, 0.26], (60, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (60, 1))
        made.add(FRAMES, FRAMES.motion(place, orientation, joints), np.repeat([0, 1], 30))
    windows = PlanWindows(made, FRAMES, SHAPE, sentences, 0.1, 0)
    batch = windows.draw(256, generator)
    assert batch.frames.shape == (256, 10, FRAMES.layout.size)
    assert float(batch.frames.std()) == pytest.approx(1.0, abs=0.25)
    raw = windows.normaliser.decode(batch.frames)
    distance, _ = batch.target.error(FRAMES, raw[:, 4:])
    assert float(distance[batch.target.asked[:, :-1]].max()) < 1e-3
    finer = PlanWindows(made, FRAMES, SHAPE, sentences, 0.1, 0, 5.0).normaliser.std / windows.normaliser.std
    root = torch.cat([finer[FRAMES.layout.slice(name)] for name in ("yaw_rate", "velocity", "height")])
    torch.testing.assert_close(root, torch.full((4,), 0.2))
    assert int((finer < 1.0).sum()) == 4
    with pytest.raises(DatasetError, match="longer"):
        PlanWindows(made, FRAMES, replace(SHAPE, frames=200), sentences, 0.1, 0)
