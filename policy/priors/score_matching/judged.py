"""The manner of one run, by a prior and its data: the error of its windows, amplitude of the leg joints and cadence."""

from __future__ import annotations

import numpy as np
import torch

from servoid.hw.contracts.body import Array
from servoid.policy.features import raw_layout
from servoid.policy.priors.features import seen_from_last
from servoid.policy.priors.manner import beside
from servoid.policy.priors.score_matching.model import Prior, Style
from servoid.policy.priors.score_matching.score import Score

SETTLED = 2.0  # s from the start that are not judged: to walk from standing takes a while


def manner_of(raw: Array, prior: Prior, style: Style | None = None) -> dict[str, float]:
    """Of a run's estimates, raw rows `(ticks, raw size)`: `prior_error` in multiples of held-out data's, and what
    `beside` says of its joints at its mean speed, which means something where one speed was asked for all the time;
    of a policy with a `style`, how often that is what it shows.

    Empty for a run too short to tell, and for a prior of carrying: a run's estimates do not tell where a box was.
    """
    config, robot = prior.config, prior.features.robot
    span, first = (config.frames - 1) * config.stride, round(SETTLED * robot.rate)
    last = np.arange(max(first, span), len(raw), config.stride)
    if not len(last) or prior.features.box:
        return {}
    frames, yaw = prior.features.of(raw)
    rows = last[:, None] + np.arange(-config.frames + 1, 1) * config.stride
    style = style or Style()
    windows = torch.from_numpy(seen_from_last(frames[rows], yaw[rows]).astype(np.float32))
    error = Score(prior, style, 0)(windows).mean(0)
    names = ("error_high", "error_middle", "error_low")
    ratio = (error / [float(prior.header["results"][name]) for name in names]).mean()
    row = raw_layout(len(robot.joints)).split(raw[first:])
    way = row["displacement"][-1, :2] - row["displacement"][0, :2]
    speed = float(np.linalg.norm(way)) * robot.rate / max(len(raw) - first - 1, 1)
    shown = {**beside(prior.manner, robot, row["position"][None], speed), **prior.shown(windows, style)}
    return {"prior_error": float(ratio), **shown}
