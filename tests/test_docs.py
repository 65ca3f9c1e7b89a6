"""The worked example of docs/own-robot.md, as a reader would type it in, and the errors that it promises."""

from __future__ import annotations

import os
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Imu, Joint, Limits, Link, Robot, Walking, load_robot
from servoid.policy.checkpoint import REQUIRED
from servoid.policy.features import raw_layout
from servoid.sim.model import build
from servoid.sim.worlds import Worlds
from servoid.stack.log.format import SCHEMAS
from servoid.tools.learn.collect import _features

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "own-robot.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (yaml,), (xml,) = blocks("yaml"), blocks("xml")
    (tmp_path / "stilts.yaml").write_text(yaml)
    (tmp_path / "stilts.xml").write_text(xml)
    return tmp_path


def test_the_example_loads_and_stands_in_simulation(folder: Path) -> None:
    robot = load_robot(folder / "stilts.yaml")
    assert robot.names == ("l_hip", "l_knee", "r_hip", "r_knee")
    worlds = Worlds(robot, 1, threads=1)
    worlds.reset(np.array([0]), [np.random.default_rng(0)])
    assert worlds.truth.position[0, 2] == pytest.approx(robot.standing_height, abs=1e-3)
    assert worlds.truth.foot_position[0, :, 2] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "number"),
    [
        (('joint name="l_knee"', 'joint name="l_knee2"'), 0),
        (('site name="imu"', 'site name="imu2"'), 1),
        (('geom name="l_sole"', 'geom name="l_sole2"'), 2),
        (("<freejoint/>", '<freejoint/><body><joint name="tail"/><geom size="0.01"/></body>'), 3),
    ],
)
def test_what_the_body_lacks_is_reported_as_promised(folder: Path, change: tuple[str, str], number: int) -> None:
    (promised,) = blocks("text")
    path = folder / "stilts.xml"
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(ConfigError) as caught:
        build(load_robot(folder / "stilts.yaml"))
    assert str(caught.value).replace(f"{folder}{os.sep}", "") == promised.splitlines()[number]


def test_every_key_is_explained() -> None:
    """A key that is added to the robot's file must be added to the table."""
    table = "\n".join(line for line in PAGE.splitlines() if line.startswith("| `"))
    parts = {
        "bus": "bus.baud",
        "limits": Limits,
        "imu": Imu,
        "walking": Walking,
        "feet": "feet.NAME",
        "legs": Link,
        "joints": Joint,
    }
    prefixes = {
        "limits": "limits.",
        "imu": "imu.",
        "walking": "walking.",
        "legs": "legs.NAME[i].",
        "joints": "joints[i].",
    }
    for key in (f.name for f in fields(Robot)):
        part = parts.get(key, key)
        names = [part] if isinstance(part, str) else [prefixes[key] + f.name for f in fields(part)]
        for name in names:
            assert f"`{name}" in table, f"{name} is not in the table of docs/own-robot.md"


def test_every_channel_column_and_header_key_is_explained() -> None:
    """A field that a log, a dataset or a checkpoint gains must be added to docs/files.md."""
    page = (ROOT / "docs" / "files.md").read_text()
    rows = {line.split("|")[1].strip(): line for line in page.splitlines() if line.startswith("| `")}
    for channel, schema in SCHEMAS.items():
        for field in schema["properties"].keys() - {"tick"}:
            assert f"`{field}`" in rows[f"`{channel}`"], f"{channel} {field}"
    columns = _features(load_robot())
    assert columns.keys() <= {name.strip("`") for name in rows}
    for field, _ in raw_layout(1).fields:
        assert f"`{field}`" in rows["`observation.state`"]
    assert raw_layout(20).size == 13 + 2 * 20
    keys = re.findall(r"`(\w+)`", "".join(rows))
    assert set(REQUIRED) <= set(keys)
