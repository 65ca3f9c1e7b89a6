"""Completion, by what bash answers: verbs, options, and the names that they take."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from servoid.stack import tasks
from servoid.tools.cli import VERBS, main

# Words are cut where readline cuts them.
ASK = r"""
source "$1"
COMP_LINE=$2 COMP_POINT=${#2}
line=${2//:/ : } line=${line//=/ = } line=${line//@/ @ }
read -ra COMP_WORDS <<<"$line"
[[ $2 == *' ' ]] && COMP_WORDS+=("")
[[ $2 == *[=:] ]] && COMP_WORDS+=("")
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_servoid
printf '%s\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The script of each shell."""
    folder, written = tmp_path_factory.mktemp("completion"), {}
    for shell in ("bash", "zsh", "fish"):
        done = subprocess.run([sys.executable, "-m", "servoid", "completion", shell], capture_output=True, check=True)
        written[shell] = folder / shell
        written[shell].write_bytes(done.stdout)
    return written


@pytest.fixture
def bash(scripts: dict[str, Path]) -> Path:
    return scripts["bash"]


def answers(script: Path, line: str, folder: Path | None = None) -> list[str]:
    """What bash makes of Tab at the end of a line."""
    done = subprocess.run(
        ["bash", "--norc", "-c", ASK, "bash", str(script), line], capture_output=True, text=True, cwd=folder
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("servoid ", {*VERBS, "--help", "--version"}),
        ("servoid ro", {"robot", "rollout"}),
        ("servoid bringup ", {*VERBS["bringup"].verbs}),
        ("servoid train od", {"odometry"}),
        ("servoid run wa", {"walk"}),
        ("servoid run walk --bac", {"--backend"}),
        ("servoid run walk --backend ", {"sim", "virtual", "dynamixel"}),
        ("servoid run walk --backend=v", {"virtual"}),
        ("servoid run walk --policy uni", {"uniphys"}),
        ("servoid rollout walk --policy gait --policy exp", {"expert"}),
        ("servoid virtual --robot op", {"op3"}),
        ("servoid virtual --clock ", {"real", "locked"}),
        ("servoid evaluate pa", {"papers"}),
        ("servoid evaluate papers --rows uniphys/forest --qu", {"--quick"}),
        ("servoid completion f", {"fish"}),
        ("servoid run walk --seed 1", set()),
        ("servoid nonsense ", set()),
        ("servoid run nonsense", set()),
    ],
)
def test_bash_completes_what_can_be_typed(bash: Path, line: str, found: set[str], tmp_path: Path) -> None:
    assert set(answers(bash, line, tmp_path)) == found


def test_every_task_and_every_row_is_known(bash: Path, tmp_path: Path) -> None:
    assert set(answers(bash, "servoid tasks ", tmp_path)) == {*tasks.names()}
    rows = answers(bash, "servoid evaluate papers --rows uniphys/forest uniphys/goal-n", tmp_path)
    assert "uniphys/goal-near" in rows, "after the first as after the second"


def test_a_word_that_readline_cuts_is_completed_behind_the_cut(bash: Path, tmp_path: Path) -> None:
    """Else the line would read uniphys/goal-near@uniphys/goal-near@virtual."""
    rows = answers(bash, "servoid evaluate papers --rows uniphys/goal-near@", tmp_path)
    assert rows
    assert not any("/" in row for row in rows)


def test_files_are_completed_where_a_file_is_asked_for(bash: Path, tmp_path: Path) -> None:
    (tmp_path / "demo.mcap").touch()
    assert answers(bash, "servoid replay d", tmp_path) == ["demo.mcap"]
    assert answers(bash, "servoid run walk --policy d", tmp_path) == [
        "diffusion",
        "dodgeball",
        "diffuse_cloc",
        "demo.mcap",
    ]
    assert answers(bash, "servoid run walk --backend d", tmp_path) == ["dynamixel"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_shell_itself_finds_no_fault_in_its_script(shell: str, scripts: dict[str, Path]) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    done = subprocess.run([shell, "-n", str(scripts[shell])], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_it_is_quick_since_no_network_and_no_physics_are_loaded() -> None:
    code = (
        "import sys, servoid.tools.cli; servoid.tools.cli.main(['completion', 'fish']); "
        "print([m for m in ('torch', 'onnxruntime', 'matplotlib') if m in sys.modules], file=sys.stderr)"
    )
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stderr.strip() == "[]"


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "csh"]) == 2
    assert "'bash', 'zsh', 'fish'" in capsys.readouterr().err
