"""Recorded motions to take keyframes from: runs of the expert that no training saw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.evaluate.cache import key
from servoid.tools.evaluate.code_hash import code

SECONDS = 10.0
SEED = 7_000_000  # of the first clip; demonstrations come from other streams
_TRIES = 4  # times as many runs as clips, since some may fall


def recipe(robot: str) -> dict[str, Any]:
    """What clips depend on beside their number. Raises ConfigError for an unknown robot."""
    from dataclasses import asdict

    from servoid.hw.robot.description import load_robot
    from servoid.policy.checkpoint import resolve
    from servoid.policy.references.gait import gait_of
    from servoid.stack.log.provenance import fingerprint, sha256

    return {
        "expert": sha256(resolve("expert", load_robot(robot))),
        "gait": asdict(gait_of(load_robot(robot))),
        "robot": fingerprint(load_robot(robot)),
        "seconds": SECONDS,
        "seed": SEED,
        "code": code(),
    }


def record_clips(folder: Path, robot: str, number: int, say: Callable[[str], None]) -> list[Path]:
    """Flight logs of `number` walks in all directions, recorded where they are not in `folder` yet.

    Raises ConfigError where the expert falls too often.
    """
    from servoid.stack.runtime.run import RunSettings, run

    place, clips = folder / key(recipe(robot)), []
    for seed in range(SEED, SEED + _TRIES * number):
        path, fallen = place / f"walk-{seed}.mcap", place / f"walk-{seed}.fell"
        if fallen.exists():
            continue
        if not path.exists():
            # Under another name until it is whole: a killed program leaves no half clip behind.
            part = place / f"part-{seed}.mcap"
            place.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            say(f"recording {path}, one of {number} walks of the expert that keyframes are taken from")
            result = run(RunSettings("walk", policy="expert", robot=robot, seconds=SECONDS, seed=seed, record=part))
            if result.interrupted:  # a Ctrl-C that the run took for itself
                raise KeyboardInterrupt
            if result.outcome not in ("succeeded", "timed_out"):
                part.unlink()
                fallen.touch()
                continue
            part.rename(path)
        clips.append(path.resolve())
        if len(clips) == number:
            return clips
    raise ConfigError(
        f"{place}: the expert fell in most of its walks: only {len(clips)} of {number} clips were recorded"
    )
