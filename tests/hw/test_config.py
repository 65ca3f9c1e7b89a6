"""Mistakes that people make in YAML files, each answered with the file, the line and the key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from servoid.hw.config import CONFIGS, ConfigError, from_values, load_marked, load_yaml, resolve
from servoid.hw.overrides import override


@dataclass(frozen=True)
class Gains:
    kp: float
    kd: float = 0.1


@dataclass(frozen=True)
class Machine:
    name: str
    id: int
    range: tuple[float, float]
    gains: Gains
    tags: tuple[str, ...] = ()
    sides: dict[str, Gains] | None = None
    loud: bool = False

    def __post_init__(self) -> None:
        if self.id > 252:
            raise ValueError("id: servos have IDs up to 252")


GOOD = """\
name: arm
id: 7
range: [-1, 1e-4]
gains:
  kp: 8
"""


def load(tmp_path: Path, text: str) -> Machine:
    path = tmp_path / "machine.yaml"
    path.write_text(text)
    return load_yaml(path, Machine)


def test_reads_what_people_write(tmp_path: Path) -> None:
    """YAML 1.1 calls 1e-4 a string, and a whole number is good enough for a float."""
    machine = load(tmp_path, GOOD + "loud: yes\ntags: [a, 'no']\nsides: {left: {kp: 1_000, kd: .5}}\n")
    assert machine.range == (-1.0, 1e-4)
    assert isinstance(machine.gains.kp, float)
    assert machine.gains == Gains(8.0, 0.1)
    assert machine.tags == ("a", "no")
    assert machine.loud is True
    assert machine.sides == {"left": Gains(1000.0, 0.5)}


@pytest.mark.parametrize(
    ("change", "line", "words"),
    [
        (("  kp: 8", "  kp: .inf"), 5, "gains.kp: expected a finite number, got the number '.inf'"),
        (("  kp: 8", "  kp: -.NaN"), 5, "gains.kp: expected a finite number"),
        (("  kp: 8", "  <<: {kp: 8}"), 5, "gains.<<: keys of another part cannot be merged in here: write them out"),
        (("  kp: 8", "  kpp: 8"), 5, "gains.kpp: unknown key; did you mean 'kp'"),
        (("id: 7\n", ""), 1, "missing key 'id'"),
        (("  kp: 8", "  kd: 8"), 4, "gains: missing key 'kp'"),
        (("name: arm", "name: 3"), 1, "name: expected text as value, got the number '3'; write \"3\""),
        (("name: arm", "name: no"), 1, "name: expected text as value, got the boolean 'no'; write \"no\""),
        (("name: arm", "name:"), 1, "name: expected text as value, got nothing"),
        (("name: arm", "name: 2026-01-02"), 1, "name: expected text as value, got the date"),
        (("id: 7", "id: 7.5"), 2, "id: expected a whole number, got the number '7.5'"),
        (("id: 7", "id: yes"), 2, "id: expected a whole number, got the boolean 'yes'"),
        (("id: 7", "id: 1:30"), 2, "id: expected a whole number"),  # base 60 in YAML 1.1
        (("id: 7", "id: 300"), 2, "id: servos have IDs up to 252"),
        (("kp: 8", "kp: '8'"), 5, "gains.kp: expected a number, got the text '8'; take the quotes away"),
        (("kp: 8", "kp: 8 N m"), 5, "gains.kp: expected a number"),
        (("kp: 8", "kp: 45deg"), 5, "without the unit 'deg'"),
        (("kp: 8", "kp: .nan"), 5, "gains.kp: expected a"),
        (("kp: 8", "kp: [8]"), 5, "gains.kp: expected float, got a list of 1"),
        (("range: [-1, 1e-4]", "range: [-1, 0, 1]"), 3, "range: expected 2 values, got 3"),
        (("range: [-1, 1e-4]", "range: 1"), 3, "range: expected a list, got the number '1'"),
        (("range: [-1, 1e-4]", "range: [-1, one]"), 3, "range[1]: expected a number, got 'one'"),
        (("id: 7", "id: 7\nid: 8"), 3, "id: duplicate key, first given on line 2"),
        (("id: 7", "on: 7"), 2, "on: expected text as key, got the boolean 'on'"),
        (("gains:\n  kp: 8", "gains: 8"), 4, "gains: expected keys and values, got the number '8'"),
        (("gains:\n  kp: 8", f"gains: {'a' * 200}"), 4, f"keys and values, got '{'a' * 60}...'"),
        (("id: 7", "id: [7"), 3, "not valid YAML"),
        (("id: 7", "\tid: 7"), 2, "not valid YAML"),
        (("id: 7", "id: 7\n--- \nid: 8"), 3, "not valid YAML"),
    ],
)
def test_mistakes_name_line_and_key(tmp_path: Path, change: tuple[str, str], line: int, words: str) -> None:
    assert change[0] in GOOD
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, GOOD.replace(*change))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'machine.yaml'}:{line}: "), message
    assert words in message
    assert "\n" not in message


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the file is empty; it needs name, id"):
        load(tmp_path, "# nothing here\n")
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"name: \xff\xfe")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_yaml(path, Machine)
    path.write_bytes(b"name: a\x00b")
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_yaml(path, Machine)
    path.write_text("[" * 5000)
    with pytest.raises(ConfigError, match="nested too deeply"):
        load_yaml(path, Machine)
    with pytest.raises(ConfigError, match=re.escape(str(tmp_path)) + ".*cannot be read"):
        load_yaml(tmp_path, Machine)


def test_missing_file_and_name_offer_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(GOOD)
    assert resolve("robots", tmp_path / "mine.yaml") == tmp_path / "mine.yaml"
    assert resolve("robots", "op3") == CONFIGS / "robots" / "op3.yaml"
    with pytest.raises(ConfigError, match=r"no such file; did you mean 'mine\.yaml'"):
        resolve("robots", tmp_path / "mien.yaml")
    with pytest.raises(ConfigError, match="unknown robot 'op4': did you mean 'op3'"):
        resolve("robots", "op4")
    with pytest.raises(ConfigError, match=r"no such file; there is no YAML file .*; shipped: .*op3"):
        resolve("robots", tmp_path / "nowhere" / "x.yaml")


def test_what_is_shipped_is_found_by_its_path_from_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pages name it so; an installed package is not where one works."""
    monkeypatch.chdir(tmp_path)
    assert resolve("policies", "configs/policies/uniphys.yaml") == CONFIGS / "policies" / "uniphys.yaml"
    with pytest.raises(ConfigError, match=r"configs/policies/unifys\.yaml: no such file; .*shipped: .*uniphys"):
        resolve("policies", "configs/policies/unifys.yaml")
    own = tmp_path / "configs" / "policies" / "uniphys.yaml"
    own.parent.mkdir(parents=True)
    own.touch()
    assert resolve("policies", "configs/policies/uniphys.yaml").resolve() == own


def test_values_of_a_file_that_is_no_yaml_are_checked_alike() -> None:
    """A log's header holds settings of long ago."""
    values = {"name": "a", "rate": 50, "step": 1e-05}
    assert from_values(values, Values, Path("a.mcap")) == Values("a", 50.0, 1e-05, None)
    for wrong, said in (({"rate": "x"}, "rate: expected a number"), ({"rates": 1}, "unknown key; did you mean 'rate'")):
        with pytest.raises(ConfigError, match=rf"a\.mcap.*{said}"):
            from_values({**values, **wrong}, Values, Path("a.mcap"))


@dataclass(frozen=True)
class Values:
    name: str
    rate: float
    step: float
    most: int | None = None


def test_marks_find_lines_inside_lists(tmp_path: Path) -> None:
    path = tmp_path / "machine.yaml"
    path.write_text(GOOD + "tags:\n  - a\n  - b\n")
    _, marks = load_marked(path, Machine)
    assert str(marks.error("tags[1]", "no good")) == f"{path}:8: tags[1]: no good"
    assert str(marks.error("gains.kd", "defaulted")).startswith(f"{path}:4: ")  # falls back to the part above
    assert str(marks.error("sides.left.kp", "absent")).startswith(f"{path}:1: ")


BASE = Machine("arm", 7, (0.0, 1.0), Gains(1.0))


def test_override_reads_text_by_type() -> None:
    changed = override(BASE, {"name": "3", "range": "-0.5:2", "gains.kp": "1e-2", "loud": "true", "tags": "a,b"})
    assert changed == Machine("3", 7, (-0.5, 2.0), Gains(0.01), ("a", "b"), None, True)
    assert override(BASE, {"range": "0.6"}).range == (0.6, 0.6)
    assert BASE.range == (0.0, 1.0)


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("nmae", "x", "unknown setting 'nmae': did you mean 'name'"),
        ("id", "seven", "--set id=seven: expected a whole number"),
        ("id", "300", "--set id=300: id: servos have IDs up to 252"),
        ("range", "1:2:3", "expected 2 values"),
        ("gains.kp", "5m", "without the unit 'm'"),
        ("gains.kp", "nan", "expected a finite number"),
        ("gains", "5", "can only be given in a file"),
        ("id.x", "5", "has no settings of its own"),
        ("loud", "maybe", "expected true or false"),
    ],
)
def test_override_refuses(key: str, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        override(BASE, {key: text})


@dataclass(frozen=True)
class Span:
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise ValueError(f"low: {self.low:g} is above high ({self.high:g})")


@dataclass(frozen=True)
class Ruler:
    span: Span = Span()


@pytest.mark.parametrize("keys", [("low", "high"), ("high", "low")])
def test_settings_that_are_good_together_come_in_any_order(keys: tuple[str, str]) -> None:
    moved = {"low": "2", "high": "3"}
    assert override(Span(), {key: moved[key] for key in keys}) == Span(2.0, 3.0)
    assert override(Ruler(), {f"span.{key}": moved[key] for key in keys}) == Ruler(Span(2.0, 3.0))
    with pytest.raises(ConfigError, match=r"--set span\.low=2: low: 2 is above high"):
        override(Ruler(), {"span.low": "2"})
