"""Every engine gives what torch gives, in all ways that the planner calls it, or says why it cannot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_runtime import ROBOT, model, request, seeded_with, speed_cost

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.contracts.body import Array
from servoid.policy.diffusion import engines
from servoid.policy.diffusion.engines import ENGINES, REFERENCE, Engine, check_engine, deviation, export, load_engine
from servoid.policy.diffusion.guidance import classifier_free
from servoid.policy.diffusion.model.backward import reached
from servoid.policy.diffusion.model.checkpoint import Model
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.model.masks import MASKS
from servoid.policy.diffusion.runtime import Runtime
from servoid.policy.diffusion.settings import DiffusionSettings, GuidanceSettings
from servoid.policy.text.encoder import load_encoder

OTHERS = tuple(name for name in ENGINES if name != REFERENCE)
TEXT = 12  # size of an encoded instruction


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache folder of these tests' own: each network is exported once."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


def installed(name: str) -> str:
    """The engine, which `make test` installs: without it the test fails and says what is missing."""
    check_engine(name)
    return name


@pytest.fixture(params=OTHERS)
def engine(request: pytest.FixtureRequest) -> str:
    return installed(request.param)


def told_model(**shape: Any) -> Model:
    """A model that reads instructions, all of its parts at work."""
    made = model(**({"text": "words", "text_size": TEXT} | shape))
    torch.nn.init.normal_(made.denoiser.no_text)  # zeros would hide a window without a text
    return made


def window(config: DenoiserConfig, batch: int, shared: bool, seed: int = 1) -> tuple[torch.Tensor, ...]:
    """Noisy states and actions, and levels that all of the batch share or not."""
    generator = torch.Generator().manual_seed(seed)
    shape = () if shared else (batch,)
    sizes = ((len(config.state_ticks), config.state_size), (len(config.action_ticks), config.action_size))
    noise = [torch.randn(batch, *size, generator=generator) for size in sizes]
    levels = [torch.randint(config.levels + 1, (*shape, tokens), generator=generator) for tokens, _ in sizes]
    return *noise, *levels


def difference(ours: tuple[torch.Tensor, ...], theirs: tuple[torch.Tensor, ...]) -> float:
    return max(float((a - b).norm() / b.norm()) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.slow
def test_any_batch_is_computed_as_torch_does(engine: str) -> None:
    denoiser = model().denoiser
    run = load_engine(engine, denoiser)
    for batch, shared in ((1, True), (3, True), (1, False), (5, False)):
        inputs = window(denoiser.config, batch, shared)
        with torch.inference_mode():
            ours, theirs = run(*inputs), denoiser(*inputs)
        assert [x.shape for x in ours] == [x.shape for x in theirs]
        assert difference(ours, theirs) <= ENGINES[engine].tolerance


@pytest.mark.slow
def test_instructions_are_read_as_torch_reads_them(engine: str) -> None:
    denoiser = told_model().denoiser
    run, inputs = load_engine(engine, denoiser), window(denoiser.config, 2, shared=True)
    text = torch.randn(2, TEXT, generator=torch.Generator().manual_seed(2))
    mixed = torch.tensor([True, False])
    outputs = []
    with torch.no_grad():
        for instruction in ({}, {"text": text}, {"text": text, "text_mask": mixed}):
            ours = run(*inputs, **instruction)
            assert difference(ours, denoiser(*inputs, **instruction)) <= ENGINES[engine].tolerance
            outputs.append(ours[0])
        guided = [classifier_free(predict, text, 2.5)(*inputs) for predict in (run, denoiser)]
    without, with_text, some = outputs
    assert difference((with_text,), (without,)) > 0.1
    assert difference((some,), (torch.stack([with_text[0], without[1]]),)) <= ENGINES[engine].tolerance
    # The difference of two windows is taken 2.5 times, and so is what they are wrong by.
    assert difference(*guided) <= 6 * ENGINES[engine].tolerance


@pytest.mark.slow
@pytest.mark.parametrize("mask", sorted(MASKS))
def test_attention_is_masked_as_the_network_says(mask: str) -> None:
    denoiser = model(mask=mask, layers=1).denoiser
    run = load_engine(installed("onnx"), denoiser)
    config, n = denoiser.config, len(denoiser.config.state_ticks)
    states, actions, *levels = window(config, 1, shared=True)
    visible = denoiser.mask.numpy()
    with torch.no_grad():
        before = run(states, actions, *levels)
        for token in (0, n // 2, n - 1, n, n + len(config.action_ticks) - 1):
            moved_states, moved_actions = states.clone(), actions.clone()
            (moved_states if token < n else moved_actions)[0, token if token < n else token - n] += 5.0
            after = run(moved_states, moved_actions, *levels)
            change = torch.cat([(a - b).abs().amax(-1)[0] for a, b in zip(after, before, strict=True)])
            seen = visible[:, token] | (np.arange(len(visible)) == token)
            assert not change[~seen].any()
            assert (change[seen] > 1e-5).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance"), [("onnx", 1e-5), ("openvino", 1e-5), ("onnx-int8", 0.03), ("openvino-bf16", 0.02)]
)
@pytest.mark.parametrize("schedule", ["full_sequence", "rolling"])
def test_plans_are_those_of_torch(name: str, tolerance: float, schedule: str) -> None:
    """Tolerances in rad, of joint targets that differ by 0.2 rad between samples."""
    made = told_model(width=64, text_size=load_encoder("words").size)
    settings = DiffusionSettings(
        steps=4, delay=2, schedule=schedule, text_weight=2.0, guidance=GuidanceSettings(weight=5.0, clip=10.0)
    )
    plans = []
    for which in (installed(name), REFERENCE):
        runtime = Runtime(made, replace(settings, engine=which), ROBOT, speed_cost)
        first = runtime.plan(seeded_with(request(), 7))
        plans.append(runtime.plan(seeded_with(replace(request(tick=42), previous=first), 7)).actions)
    assert np.abs(plans[0] - plans[1]).max() <= tolerance
    assert (
        np.abs(plans[1] - Runtime(made, settings, ROBOT, speed_cost).plan(seeded_with(request(), 8)).actions).max()
        > 0.1
    )


@pytest.mark.slow
def test_fewer_actions_than_states_are_exported_too(engine: str) -> None:
    denoiser = model(horizon=12, actions=6).denoiser
    ours = load_engine(engine, denoiser)(*window(denoiser.config, 1, shared=True))
    assert ours[0].shape == (1, 16, 54)
    assert ours[1].shape == (1, 9, 20)


def test_an_unknown_engine_is_refused_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'onnx-int8'"):
        load_engine("onnx-int9", model().denoiser)
    file = tmp_path / "policy.yaml"
    file.write_text("steps: 4\nengine: opnvino\n")
    with pytest.raises(ConfigError, match="did you mean 'openvino'"):
        load_yaml(file, DiffusionSettings)


def test_what_is_not_installed_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda package: None)
    made = model()
    for name, extra in (("onnx", "onnx"), ("onnx-int8", "onnx"), ("openvino", "openvino")):
        with pytest.raises(ConfigError, match=rf"pip install 'servoid\[{extra}\]'"):
            Runtime(made, DiffusionSettings(engine=name), ROBOT)
    Runtime(made, DiffusionSettings(), ROBOT)  # torch needs nothing


@pytest.mark.parametrize("mask", ["state_full_action_causal", "causal"])
def test_the_way_back_that_is_written_out_is_that_of_autograd(mask: str) -> None:
    """Where states see no action it is about states alone; the causal mask has them see actions."""
    made = told_model(mask=mask).denoiser
    assert reached(made) == (len(made.config.state_ticks) if mask != "causal" else len(made.mask))
    assert deviation(load_engine(REFERENCE, made, gradient=True), made, gradient=True) <= ENGINES[REFERENCE].tolerance
    assert deviation(made, told_model(mask=mask, seed=5).denoiser, gradient=True) > 0.1


@pytest.mark.slow
def test_a_plan_guided_through_the_network_is_that_of_autograd_with_every_engine_that_can() -> None:
    """As told, and beyond that by two windows; three steps a call, for two robots at once; in rad."""
    made = told_model(width=64, text_size=load_encoder("words").size)
    guidance = GuidanceSettings(weight=100.0, clip=300.0, gradient="network", scaled=True, repeats=3)
    asked = request()
    two = replace(asked, states=np.stack([asked.states] * 2), actions=np.stack([asked.actions] * 2))
    two = replace(seeded_with(two, 7), seeds=np.array([7, 8]))

    def planned(settings: DiffusionSettings, engine: Engine | None = None) -> Array:
        return Runtime(made, settings, ROBOT, speed_cost, engine).plan(two).actions

    for text_weight in (1.0, 2.0):
        settings = DiffusionSettings(steps=4, delay=2, text_weight=text_weight, guidance=guidance)
        theirs = planned(settings, made.denoiser)  # autograd
        unguided = planned(replace(settings, guidance=replace(guidance, weight=0.0)))
        assert np.abs(theirs - unguided).max() > 0.01
        for name in ("torch", "onnx", "openvino"):
            assert np.abs(planned(replace(settings, engine=installed(name))) - theirs).max() < 1e-5


@pytest.mark.slow
def test_an_engine_without_a_gradient_through_the_network_says_so() -> None:
    guidance = GuidanceSettings(gradient="network")
    with pytest.raises(ValueError, match="set engine: torch or onnx or openvino"):
        DiffusionSettings(engine="onnx-int8", guidance=guidance)
    DiffusionSettings(engine="onnx-int8", guidance=replace(guidance, weight=0.0))  # unguided
    denoiser = model().denoiser
    states, *rest = window(denoiser.config, 1, shared=True)
    with pytest.raises(ConfigError, match="'onnx-int8' has no gradient"):
        load_engine(installed("onnx-int8"), denoiser, gradient=True)
    with pytest.raises(RuntimeError, match="without a gradient through the network"):
        load_engine(installed("onnx"), denoiser)(states.requires_grad_(), *rest)


@pytest.mark.parametrize("broken", ["states", "actions"])
def test_what_is_not_a_number_deviates_from_torch(broken: str) -> None:
    denoiser = model().denoiser

    def engine(*inputs: torch.Tensor, **text: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        states, actions = denoiser(*inputs, **text)
        return (states * math.nan, actions) if broken == "states" else (states, actions * math.nan)

    assert math.isnan(deviation(engine, denoiser))


@pytest.mark.slow
def test_an_engine_that_computes_something_else_is_refused(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = export.exported(model(seed=1).denoiser)
    monkeypatch.setattr(export, "exported", lambda denoiser: graph)
    with pytest.raises(ConfigError, match=f"'{engine}' differs from torch"):
        load_engine(engine, model(seed=2).denoiser)


@pytest.mark.slow
def test_a_network_is_exported_once_and_a_damaged_file_again(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    denoiser = model(seed=3, layers=1).denoiser
    installed("onnx")
    made = export.exported(denoiser)
    path = export.cache_path(denoiser)
    assert cache in path.parents
    assert not list(path.parent.glob("*.partial"))
    calls = []

    def count(_: Denoiser, part: str) -> bytes:
        calls.append(1)
        return made

    monkeypatch.setattr(export, "to_onnx", count)
    assert export.exported(denoiser) == made
    assert not calls
    path.write_bytes(path.read_bytes()[:-100])
    assert export.exported(denoiser) == made
    assert export.exported(denoiser) == made
    assert len(calls) == 1
    assert export.cache_path(model(seed=4, layers=1).denoiser) != path


def test_a_cache_that_cannot_be_written_is_done_without(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "servoid").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(export, "to_onnx", lambda denoiser, part: b"graph")
    assert export.exported(model().denoiser) == b"graph"
