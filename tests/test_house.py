"""The house plan: packages import downwards only, help stays light, and files stay short."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Each package and those that it may import. policy and sim stand side by side.
BELOW: dict[str, set[str]] = {
    "hw": set(),
    "sim": {"hw"},
    "policy": {"hw"},
    "stack": {"hw", "sim", "policy"},
    "tools": {"hw", "sim", "policy", "stack"},
}
# Where a heavy library may be imported as soon as its module is; elsewhere it waits inside a function.
HEAVY = {
    "torch": ("policy/diffusion/", "policy/latent/network.py", "policy/latent/dataset.py"),
    "mujoco": ("sim/",),
}
LONGEST = 400  # lines of a file
MODULE_NAME = re.compile(rf"servoid\.({'|'.join(BELOW)})(\.\w+)+")


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and module of every import, inside functions too, and of every module named in a string by itself, since
    backends and verbs are looked up by name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.lineno, node.module
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE_NAME.fullmatch(node.value):
            yield node.lineno, node.value


def upward(package: str, code: str) -> list[str]:
    """Imports in `code` that its package may not have."""
    allowed = BELOW[package] | {package}
    return [
        f"line {line} imports {module}"
        for line, module in imports(ast.parse(code))
        if (found := folder(module)) is not None and found not in allowed
    ]


def folder(module: str) -> str | None:
    """The top-level folder that a module is in; None for other people's modules. One that is named without the package
    would be found only where the repository's root is on the path, and is never allowed."""
    first, *rest = module.split(".")
    if first == "servoid":
        return rest[0] if rest else "servoid"
    return f"{first}, not servoid.{first}," if first in {*BELOW, "tests"} else None


@pytest.mark.parametrize("package", BELOW)
def test_imports_point_downwards(package: str) -> None:
    assert sources(package), f"no source in {package}/"
    for path in sources(package):
        assert upward(package, path.read_text()) == [], path.relative_to(ROOT)


@pytest.mark.parametrize(
    ("package", "code"),
    [
        ("hw", "from servoid.stack.runtime.loop import Loop"),
        ("policy", "def f():\n    import servoid.sim.backend"),
        ("sim", "if TYPE_CHECKING:\n    from servoid.policy.references.gait import Gait"),
        ("sim", "import_module('servoid.stack.runtime.loop')"),
        ("stack", "import servoid.tools.cli as cli"),
    ],
)
def test_an_upward_import_is_seen_wherever_it_hides(package: str, code: str) -> None:
    """A check that sees nothing would pass for ever."""
    assert len(upward(package, code)) == 1


@pytest.mark.parametrize("library", HEAVY)
def test_heavy_libraries_are_imported_where_they_are_used(library: str) -> None:
    """One import at the top of a shared module would slow every command by seconds."""
    for path in (path for package in BELOW for path in sources(package)):
        name = path.relative_to(ROOT).as_posix()
        if name.startswith(HEAVY[library]):
            continue
        top = ast.Module(ast.parse(path.read_text()).body, [])
        direct = [n for n in top.body if isinstance(n, ast.Import | ast.ImportFrom)]
        modules = {module.split(".")[0] for _, module in imports(ast.Module(list(direct), []))}
        assert library not in modules, f"{name} imports {library} when it is imported"


def test_the_command_loads_neither_torch_nor_mujoco() -> None:
    code = "import sys, servoid.tools.cli; print(sorted({'torch', 'mujoco', 'numpy', 'matplotlib'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() in ("[]", "['numpy']")  # the contracts name numpy's array type


def test_files_stay_short() -> None:
    for path in (path for package in (*BELOW, "tests") for path in sources(package)):
        lines = len(path.read_text().splitlines())
        assert lines <= LONGEST, f"{path.relative_to(ROOT)} has {lines} lines: it is more than one concept"


def test_configs_hold_data_alone() -> None:
    assert {path.suffix for path in (ROOT / "configs").rglob("*") if path.is_file()} <= {".yaml", ".xml"}
