"""meta/servoid.yaml of a dataset: how it was recorded, and what it was appended to."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import yaml

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot
from servoid.tools.learn.collect.parts import FleetRecipe

LICENCE = "Apache-2.0"
MIRRORING = "applied when read (servoid.policy.diffusion.dataset): each window also serves with left and right swapped"
SOURCES = "servoid.yaml"  # in meta/


def earlier(args: argparse.Namespace, how: FleetRecipe) -> dict[str, Any]:
    """What meta/servoid.yaml says of the dataset that is appended to. Raises ConfigError where it would be recorded
    once more."""
    path = args.out / "meta" / SOURCES
    if not args.append or not path.is_file():
        return {}
    before: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    for one in (before, *before.get("appended_to", ())):
        if one.get("seed") == args.seed and one.get("policy") == how.sources()["policy"]:
            raise ConfigError(f"--append: seed {args.seed} is in {args.out} already: give another with --seed")
    return before


def provenance(
    args: argparse.Namespace,
    robot: Robot,
    how: FleetRecipe,
    result: Mapping[str, Any],
    before: dict[str, Any],
) -> str:
    """meta/servoid.yaml: all that is needed to record the dataset again, what it was appended to included."""
    import mujoco
    import numpy as np

    from servoid.policy.checkpoint import git_commit
    from servoid.tools.learn.collect.episode_cutter import FALL_SECONDS, SHORTEST_SECONDS
    from servoid.tools.learn.collect.skills import skills_of

    def plain(values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    skills = skills_of(robot)
    names = (
        "frames",
        "worlds",
        "seconds",
        "randomise",
        "plain_odometry",
        "skills",
        "crouched",
        "style",
        "only",
        "carry",
        "velocity",
        "parts",
    )
    options = {name: vars(args)[name] for name in names}
    content = {
        "licence": LICENCE,
        "git_commit": git_commit(),
        "versions": {"mujoco": mujoco.__version__, "numpy": np.__version__},
        "robot": robot.name,
        "seed": args.seed,
        "options": options,
        **how.sources(),
        "mirroring": MIRRORING,
        "episodes": {
            "ticks": round(args.seconds * robot.rate),
            "dropped_before_fall": FALL_SECONDS,
            "shortest": SHORTEST_SECONDS,
        },
        "commands": {
            "segment_seconds": {skill.name: list(skill.seconds) for skill in skills},
            "skills": [
                {"name": s.name, "weight": s.weight, "boxes": [plain(asdict(box)) for box in s.boxes]} for s in skills
            ],
        },
        "disturbances": plain(asdict(how.disturbances)),
        "result": dict(result),
    }
    if before:
        last = {name: value for name, value in before.items() if name not in ("appended_to", "logs")}
        content["appended_to"] = [*([last] if "seed" in last else []), *before.get("appended_to", ())]
        content |= {"logs": before["logs"]} if "logs" in before else {}
    return yaml.safe_dump(content, sort_keys=False)
