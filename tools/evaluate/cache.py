"""Episodes that were done, kept by what they depend on: an interrupted evaluation goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.common.output import to_json


def key(dependencies: Mapping[str, Any]) -> str:
    """A name for everything that episodes depend on."""
    return hashlib.sha256(json.dumps(dependencies, sort_keys=True).encode()).hexdigest()[:20]


class EpisodeCache:
    """Records of an experiment's episodes, one JSON line each, in `folder/KEY.jsonl`. Its first line is what they
    depend on.

    A line that a killed program left half written is dropped.
    """

    def __init__(self, folder: Path, dependencies: Mapping[str, Any], fresh: bool = False) -> None:
        """`fresh` forgets what is there. Raises ConfigError where the folder cannot be written."""
        self.path = folder / f"{key(dependencies)}.jsonl"
        self.records: dict[int, dict[str, Any]] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            text = "" if fresh or not self.path.exists() else self.path.read_text(encoding="utf-8")
            whole = text[: text.rfind("\n") + 1]
            if not whole:
                whole = to_json(dict(dependencies)) + "\n"
            if whole != text:
                self.path.write_text(whole, encoding="utf-8")
        except OSError as error:
            raise _unwritable(self.path, error) from None
        for line in whole.splitlines()[1:]:
            record = json.loads(line)
            self.records[int(record["episode"])] = record

    def add(self, episode: int, record: Mapping[str, Any]) -> None:
        """Keep an episode. Raises ConfigError where it cannot be written."""
        line = to_json({"episode": episode, **record})
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise _unwritable(self.path, error) from None
        self.records[episode] = json.loads(line)  # as it will be read again


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be written ({error.strerror}): choose another place with --out")
