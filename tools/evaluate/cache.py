"""Episodes that were done, kept by what they depend on: an interrupted evaluation continues where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common.output import to_json
from servoid.tools.evaluate.code_hash import code

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings


def depends_on(settings: RunSettings, policy: Mapping[str, Any]) -> dict[str, Any]:
    """What the episodes of a run's settings depend on: the same dependencies, the same episodes.

    `policy` is what the policy is made of; the seed is that of all episodes. Raises ConfigError.
    """
    from servoid.hw.robot.description import load_robot
    from servoid.stack.log.provenance import described, files, fingerprint, versions
    from servoid.stack.tasks import load_settings, source

    robot = load_robot(settings.robot)
    task = load_settings(settings.task, dict(settings.set), robot)
    return {
        "task": settings.task,
        "source": source(settings.task),
        "settings": described(task),
        "files": files(task),
        "seconds": settings.seconds,
        "policy": dict(policy),
        "robot": fingerprint(robot),
        "backend": settings.backend,
        "randomise": settings.randomise,
        "gain": settings.gain,
        "seed": settings.seed,
        "code": code(),
        "versions": versions(),
        **({"recover": True} if settings.recover else {}),
    }


_SHOWN = 5  # of what differs


def key(dependencies: Mapping[str, Any]) -> str:
    """A name for everything that episodes depend on."""
    return hashlib.sha256(json.dumps(dependencies, sort_keys=True).encode()).hexdigest()[:20]


class EpisodeCache:
    """Records of an experiment's episodes, one JSON line each. The file's first line is what they depend on.

    A line that a killed program left half written is dropped.
    """

    def __init__(self, path: Path, dependencies: Mapping[str, Any], fresh: bool = False) -> None:
        """`fresh` forgets what is there. Raises ConfigError where the file holds episodes that depend on something
        else, or none, and where it cannot be written."""
        self.path = path
        self.records: dict[int, dict[str, Any]] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            text = "" if fresh or not self.path.exists() else self.path.read_text(encoding="utf-8")
            whole = text[: text.rfind("\n") + 1]
            if not whole:
                whole = to_json(dict(dependencies)) + "\n"
            if whole != text:
                self.path.write_text(whole, encoding="utf-8")
        except OSError as error:
            raise _unwritable(self.path, error) from None
        try:
            before, *records = (json.loads(line) for line in whole.splitlines())
            self.records = {int(record["episode"]): record for record in records}
        except (ValueError, KeyError, TypeError):
            raise ConfigError(f"{path}: no file of episodes: choose another place with --out") from None
        if differing := _differing(before, json.loads(to_json(dict(dependencies)))):
            shown = ", ".join(differing[:_SHOWN]) + (" ..." if len(differing) > _SHOWN else "")
            raise ConfigError(
                f"{path}: its episodes were done with others of these: {shown}; choose another --out, or do them anew "
                "with --fresh"
            )

    def add(self, episode: int, record: Mapping[str, Any]) -> None:
        """Keep an episode. Raises ConfigError where it cannot be written."""
        line = to_json({"episode": episode, **record})
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise _unwritable(self.path, error) from None
        self.records[episode] = json.loads(line)  # as it will be read again


def _differing(before: Any, now: Any, name: str = "") -> list[str]:
    """Names of the values, `policy.planner.steps`, that are not the same."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return [] if before == now else [name]
    keys = [key for key in (*now, *(key for key in before if key not in now))]
    return [
        differing
        for key in keys
        for differing in _differing(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
    ]


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be written ({error.strerror}): choose another place with --out")
