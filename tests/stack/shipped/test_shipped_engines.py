"""The checkpoint that ships, run by the engines beside torch: in its own settings, on requests of its own walk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from shipped_runs import ROBOT, drive

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import PlanRequest
from servoid.policy.checkpoint import resolve
from servoid.policy.diffusion.engines import ENGINES, check_engine, deviation, load_engine
from servoid.policy.diffusion.model.checkpoint import load
from servoid.policy.diffusion.runtime import Runtime, load_runtime
from servoid.policy.diffusion.settings import load_settings
from servoid.stack.tasks import load_task

pytestmark = pytest.mark.slow

SETTINGS = load_settings()


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache folder of these tests' own: the network is exported once, and not taken from a run before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def requests() -> Sequence[PlanRequest]:
    """Of a walk along a curve: seven of its plans."""
    return drive("walk", {"vx": "0.15", "yaw_rate": "0.3"}).planner.requests[::7]


def planner(engine: str) -> Runtime:
    cost = load_task("walk", {}, ROBOT.dt, ROBOT).objective
    return load_runtime(ROBOT, replace(SETTINGS, engine=engine), cost)


def actions(runtime: Runtime, requests: Sequence[PlanRequest], seed: int = 7) -> Array:
    return np.array([runtime.plan(replace(request, seeds=np.array(seed))).actions for request in requests])


@pytest.mark.parametrize(("engine", "most"), [("onnx", 1e-4), ("onnx-int8", 0.05)])
def test_plans_of_the_shipped_model_are_those_of_torch(
    engine: str, most: float, requests: Sequence[PlanRequest]
) -> None:
    """`most` is in rad, of any joint at any tick of a plan; what another seed changes is several times that."""
    check_engine(engine)  # `make test` installs it: without it this fails, and says what is missing
    denoiser = load(resolve(SETTINGS.checkpoint), ROBOT).denoiser
    assert deviation(load_engine(engine, denoiser), denoiser) <= ENGINES[engine].tolerance
    torch = planner("torch")
    theirs = actions(torch, requests)
    assert np.abs(actions(planner(engine), requests) - theirs).max() < most
    assert np.abs(actions(torch, requests, seed=8) - theirs).max() > 2 * most
