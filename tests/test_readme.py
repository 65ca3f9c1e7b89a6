"""What the documentation shows can be typed as it stands: commands, settings, files and Python."""

from __future__ import annotations

import json
import re
import shlex
from argparse import Namespace
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.plugins import is_file_reference
from servoid.stack import tasks
from servoid.stack.control.policies import names as policies
from servoid.stack.runtime.backends import BACKENDS
from servoid.stack.tasks.learned import LEARNED_TASKS
from servoid.stack.tasks.learned.clip import PREFIX
from servoid.tools.cli import VERBS, Verb, main
from servoid.tools.commands import rollout
from servoid.tools.common.parser import Parser, settings

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
SHOWN = [page.relative_to(ROOT).as_posix() for page in PAGES]
FOLDERS = ("hw", "sim", "policy", "stack", "tools", "configs", "tests", "docs", ".ci")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def inline(text: str) -> list[str]:
    """What stands between single backticks, outside code blocks."""
    return re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))


def commands(text: str) -> Iterator[list[str]]:
    """Words after `servoid` of every command line, comments taken away."""
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    for line in (*lines, *(" ".join(span.split()) for span in inline(text))):
        words = shlex.split(line, comments=True) if line.startswith("servoid") else []
        if words and words[0] == "servoid":
            yield words[1 : words.index(">") if ">" in words else None]


def check(words: list[str], verbs: dict[str, Verb] = VERBS) -> None:
    """Parse a command line as `servoid` would, and look up the names in it. A verb by itself is a mention of it."""
    if not words or words[0] in ("--help", "--version", "COMMAND"):
        return
    assert words[0] in verbs, f"no verb {words[0]}"
    verb, rest = verbs[words[0]], words[1:]
    if verb.verbs:
        check(rest, verb.verbs)
    elif rest:
        module = import_module(verb.module)
        parser = Parser(prog="servoid")
        module.add_arguments(parser)
        look_up(parser.parse_args(rest), verb)


def look_up(args: Namespace, verb: Verb) -> None:
    """Names that are not placeholders must exist."""
    task = getattr(args, "task", None)
    if verb.module == "servoid.tools.learn.trainers.policy":
        assert task in LEARNED_TASKS or task.startswith(PREFIX)
    elif task and task != "TASK" and not is_file_reference(task):  # which its page writes, and its test runs
        given = settings(args) if hasattr(args, "set") else {}
        tasks.load_settings(task, given)
    if verb.module in ("servoid.tools.commands.run", "servoid.tools.commands.rollout"):
        given = [args.policy] if isinstance(args.policy, str) else rollout.policies(args.policy)
        assert all(name in policies() or (ROOT / name).is_file() for name in given)
        assert args.backend in BACKENDS


@pytest.mark.parametrize("page", SHOWN)
def test_every_command_line_parses(page: str) -> None:
    for words in commands((ROOT / page).read_text()):
        try:
            check(words)
        except SystemExit:
            pytest.fail(f"{page}: servoid {' '.join(words)} is not a command line")


def test_a_wrong_command_line_is_seen() -> None:
    """A check that passes everything would pass for ever."""
    wrong = ("rnu goal", "run gaol", "run goal --sped 2", "run walk --set vxx=1", "run goal --backend dynamixl")
    for line in wrong:
        with pytest.raises((SystemExit, AssertionError, ConfigError)):
            check(line.split())
    text = "```sh\nservoid tasks  # all\n```\nand `servoid doctor --json`, `servo`"
    assert list(commands(text)) == [["tasks"], ["doctor", "--json"]]


def test_every_verb_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    names = [f"{name} {inner}".strip() for name, verb in VERBS.items() for inner in verb.verbs or [""]]
    for name in names:
        assert f"| `servoid {name}` |" in text, f"servoid {name} is not in the table of commands"


@pytest.mark.parametrize("page", SHOWN)
def test_every_named_file_exists(page: str) -> None:
    text = (ROOT / page).read_text()
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert ((ROOT / page).parent / link).exists(), f"{page}: link to {link}"
    for span in inline(text):
        if re.fullmatch(rf"({'|'.join(map(re.escape, FOLDERS))})/[\w./-]*", span) and "NAME" not in span:
            assert (ROOT / span).exists(), f"{page}: {span}"


@pytest.mark.parametrize("page", SHOWN)
def test_every_linked_section_exists(page: str) -> None:
    text = (ROOT / page).read_text()
    for file, section in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", text):
        target = (ROOT / page).parent / file if file else ROOT / page
        heads = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE)
        assert section in [re.sub(r"[^\w\- ]", "", head).lower().replace(" ", "-") for head in heads]


@pytest.mark.parametrize("page", SHOWN)
def test_every_make_target_exists(page: str) -> None:
    text = (ROOT / page).read_text()
    shown = {m for span in (*inline(text), *blocks(text, "sh")) for m in re.findall(r"^make (\w+)", span, re.MULTILINE)}
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert shown <= set(targets)


@pytest.mark.slow
def test_the_python_of_the_readme_is_the_run_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As written but for the policy: the gait needs no planner, and so no minute of a slow machine."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text()
    (code,) = blocks(text, "python")
    assert 'policy="diffusion"' in code
    names: dict[str, object] = {}
    for _ in range(2):  # a person runs it again
        exec(compile(code.replace('policy="diffusion"', 'policy="gait"'), "README.md", "exec"), names)
    result = names["result"]
    printed = capsys.readouterr().out
    assert printed.startswith(f"{result.outcome} after {result.seconds:.1f} s, ")  # type: ignore[attr-defined]
    assert "running" in printed
    assert (tmp_path / "runs" / "api.mcap").is_file()

    command = re.search(r"The same run as `servoid (.+)`:", text)
    assert command is not None
    main([*command[1].split(), "--policy", "gait", "--record", "command.mcap", "--json"])
    assert json.loads(capsys.readouterr().out)["metrics"] == pytest.approx(result.metrics)  # type: ignore[attr-defined]
