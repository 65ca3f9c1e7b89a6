"""The control tables that the official SDK ships: an oracle."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

easy_sdk = pytest.importorskip("dynamixel_easy_sdk")
SHIPPED = Path(easy_sdk.__file__).parent / "control_table"
# Names that differ in spelling between the SDK's tables and these.
SPELLING = {"secondary_shadow_id": "secondary_id", "protocol_version": "protocol_type"}


def shipped(model: str) -> dict[str, tuple[int, int]]:
    """Address and width of each register in the SDK's table of a model, by this project's names."""
    lines = (SHIPPED / f"{model.replace('-', '_')}.model").read_text().split("[control table]")[1].splitlines()
    rows = [line.split("\t") for line in lines if re.match(r"\d+\t\d", line)]
    assert len(rows) > 40, model
    found = {}
    for address, width, name in rows:
        key = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        found[SPELLING.get(key, key)] = (int(address), int(width))
    return found
