"""What a plan is worth: its cost, and how far it is from the motions that the model knows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Plan, PlanRequest
from servoid.policy.diffusion.rolling import Previous, clean_start, seeded
from servoid.policy.diffusion.schedule import cosine_signal
from servoid.policy.features import joints_seen, to_tokens
from servoid.policy.trajectory import SlopedCost, Trajectory

if TYPE_CHECKING:
    from servoid.policy.diffusion.runtime import Runtime

LEVEL_SHARE = 0.25  # of the noise levels: which a plan is denoised from


def plan_cost(runtime: Runtime, request: PlanRequest, plan: Plan, cost: SlopedCost, dt: float) -> Array:
    """Cost `(batch,)` of the plans of many robots."""
    joints = joints_seen(runtime.model.states)
    tokens = to_tokens(plan.states, np.asarray(request.states[:, -1], np.float32), joints)
    return cost(Trajectory.of(tokens, joints, dt, runtime.ticks), request.instruction)


def denoising_error(runtime: Runtime, request: PlanRequest, plan: Plan) -> Array:
    """Mean squared error `(batch,)` of what the model makes of the plans' states from `LEVEL_SHARE` of all noise.

    In the network's inputs, with the past clean and no sentence; each plan gets the same noise, so that two plans of a
    request can be compared. What the model has learned it restores, and what lies far off it draws to what it knows.
    """
    model, config = runtime.model, runtime.model.config
    known = runtime.known(request.states, request.actions, request.instruction)
    states, actions = clean_start(
        config,
        model.states,
        model.actions,
        Previous(0, plan.states, plan.actions, runtime.ticks),
        request.states[:, -1],
    )
    level = round(LEVEL_SHARE * config.levels)
    a = float(cosine_signal(config.levels)[level])
    noisy, levels = [], []
    parts = (states, known.states, known.state_mask), (actions, known.actions, known.action_mask)
    for kind, (planned, given, mask) in enumerate(parts):
        drawn = torch.randn(planned.shape[1:], generator=seeded(kind))
        noisy.append(torch.where(mask[:, None], given, a**0.5 * planned + (1.0 - a) ** 0.5 * drawn))
        levels.append(torch.where(mask, 0, level))
    with torch.inference_mode():
        clean, _ = runtime.engine(*noisy, *levels)
    future = slice(config.history, config.history + len(runtime.ticks))
    return np.asarray((clean[:, future] - states[:, future]).square().mean((1, 2)))
