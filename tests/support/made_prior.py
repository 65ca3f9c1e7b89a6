"""A small motion prior, trained for a few steps on a made-up recording: quick, and no judge of motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from servoid.hw.robot.description import load_robot
from servoid.policy.priors.features import PriorFeatures
from servoid.policy.priors.score_matching.network import PriorConfig
from servoid.policy.priors.score_matching.windows import PriorWindows
from servoid.sim.kinematics import limbs_of
from servoid.tools.learn.prior_settings import PriorTraining
from servoid.tools.learn.trainers.prior import PriorTrainer, read_by_style

SMALL = replace(PriorTraining(), frames=4, width=16, levels=10, batch=64, steps=30, evaluate_every=0.0)


def trainer(data: Path, out: Path, settings: PriorTraining = SMALL) -> PriorTrainer:
    robot = load_robot()
    recordings = read_by_style(data, robot)
    features = PriorFeatures(robot, limbs_of(robot))
    styles = tuple(style for style in recordings if style)
    shape = {name: getattr(settings, name) for name in ("frames", "stride", "layers", "width", "heads", "levels")}
    config = PriorConfig(features.layout.size, **shape, styles=styles)
    return PriorTrainer(PriorWindows(recordings, features, config), features, settings, out, "made up")


def write_prior(data: Path, out: Path, settings: PriorTraining = SMALL) -> Path:
    """Train one and return its checkpoint."""
    made = trainer(data, out, settings)
    made.start(resume=False)
    made.run()
    return made.best_path
