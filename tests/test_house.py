"""The house plan: packages import downwards only, help stays light, and files stay short."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
parse = cache(ast.parse)  # several checks read each file

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
    "torch": (
        "policy/diffusion/",
        "policy/priors/score_matching/",
        "policy/priors/adversarial/",
        "policy/latent/network.py",
        "policy/latent/dataset.py",
    ),
    "mujoco": (
        "sim/",
        "tools/robots/compare.py",
        "tools/robots/home.py",
        "tools/robots/draft.py",
        "tools/robots/feet.py",
        "tools/robots/couplings.py",
    ),  # hw/robot/ reads the robot's body by it, when a robot is loaded
}
LONGEST = 400  # lines of a file
ROOMIEST = 12  # modules of a folder beside its folders
MOST_ARGUMENTS = 7
# Where there are more, since a class would only say them once again.
MANY = {("stack/estimation/odometry.py", "push")}  # an array for each group of columns of a network's input
# Where an object is asked what it has, since it is not ours: by file, what it is asked for.
ASKED = {
    ("hw/clock.py", "prctl"),  # the C library's: Linux alone has it
    ("hw/config.py", "CSafeLoader"),  # PyYAML has it where it was built with libyaml
    ("hw/config.py", "__name__"),  # a type hint's
    ("hw/setting.py", "__metadata__"),  # a type hint's
    ("hw/dynamixel/transport/port.py", "errno"),  # pyserial's errors
    ("tools/common/output.py", "tolist"),  # numpy's arrays and numbers
    ("tools/commands/doctor.py", "sched_getaffinity"),  # the operating system's
}
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
        for line, module in imports(parse(code))
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
        if name(path).startswith(HEAVY[library]):
            continue
        top = ast.Module(parse(path.read_text()).body, [])
        direct = [n for n in top.body if isinstance(n, ast.Import | ast.ImportFrom)]
        modules = {module.split(".")[0] for _, module in imports(ast.Module(list(direct), []))}
        assert library not in modules, f"{name(path)} imports {library} when it is imported"


def test_the_command_loads_neither_torch_nor_mujoco() -> None:
    code = "import sys, servoid.tools.cli; print(sorted({'torch', 'mujoco', 'numpy', 'matplotlib'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout.strip() in ("[]", "['numpy']")  # the contracts name numpy's array type


def test_files_stay_short() -> None:
    for path in (path for package in (*BELOW, "tests") for path in sources(package)):
        lines = len(path.read_text().splitlines())
        assert lines <= LONGEST, f"{path.relative_to(ROOT)} has {lines} lines: it is more than one concept"


def test_folders_stay_small() -> None:
    folders = {path.parent for package in BELOW for path in sources(package)}
    modules = {name(at): sum(path.name != "__init__.py" for path in at.glob("*.py")) for at in folders}
    assert {at: count for at, count in modules.items() if count > ROOMIEST} == {}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def asked(code: str) -> Iterator[tuple[int, str]]:
    """Line and member of every question whether an object has a member that is named there."""
    for node in ast.walk(parse(code)):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) > 1):
            continue
        member = node.args[1]
        fixed = isinstance(member, ast.Constant)
        if node.func.id == "hasattr" or (node.func.id == "getattr" and fixed):
            yield node.lineno, str(member.value) if isinstance(member, ast.Constant) else ast.unparse(member)


def test_no_object_is_asked_what_it_has() -> None:
    """A contract declares its members: what is found by name is found by no type checker, and a typo goes unseen."""
    found = {
        (name(path), member) for package in BELOW for path in sources(package) for _, member in asked(path.read_text())
    }
    assert found == ASKED


@pytest.mark.parametrize("code", ["hasattr(body, 'truth')", "hasattr(body, part)", "getattr(task, 'goal', None)"])
def test_a_question_is_seen(code: str) -> None:
    assert len(list(asked(code))) == 1


CLOCKS = {f"{name}{unit}" for name in ("time", "monotonic", "perf_counter", "process_time") for unit in ("", "_ns")}


def timed(code: str) -> list[int]:
    """Lines of comparisons with the time of a clock that is read there, or that an operand was calculated from. One
    that is passed to a function, as a deadline is, counts for nothing."""

    def reads(node: ast.AST, names: set[str]) -> bool:
        if isinstance(node, ast.Call):
            function = ast.unparse(node.func)
            if function.removeprefix("time.") in CLOCKS:
                return True
            if function not in ("abs", "round", "float", "int", "min", "max"):
                return False
        of_one = isinstance(node, ast.Name) and node.id in names
        return of_one or any(reads(child, names) for child in ast.iter_child_nodes(node))

    found: set[int] = set()
    if not any(f"{clock}(" in code for clock in CLOCKS):
        return []
    for scope in (node for node in ast.walk(parse(code)) if isinstance(node, ast.FunctionDef)):
        names: set[str] = set()
        for node in ast.walk(scope):
            if isinstance(node, ast.Assign) and reads(node.value, names):
                names |= {part.id for target in node.targets for part in ast.walk(target) if isinstance(part, ast.Name)}
        found |= {node.lineno for node in ast.walk(scope) if isinstance(node, ast.Compare) and reads(node, names)}
    return sorted(found)


def test_no_test_asserts_on_a_clock() -> None:
    """It would fail where two other programs are busy. How long a thing takes is for `servoid bench`; whatever waits
    for something that may never come is ended by pytest's own timeout."""
    found = {name(path): lines for path in sources("tests") if (lines := timed(path.read_text()))}
    assert found == {}


@pytest.mark.parametrize(
    "body",
    [
        "assert time.monotonic() - began < 1.0",
        "began = time.perf_counter(); work(); took = time.perf_counter() - began; assert took < 1.0",
        "end = monotonic() + 5\n    while now() < end: pass",
    ],
)
def test_an_assertion_on_a_clock_is_seen(body: str) -> None:
    assert timed(f"def test():\n    {body}") != []


def rooms(package: str) -> dict[str, set[str]]:
    """The folders of a package, and those of the same package that each imports from."""
    found: dict[str, set[str]] = {}
    for path in sources(package):
        here = found.setdefault(name(path.parent), set())
        for _, module in imports(parse(path.read_text())):
            if module.startswith(f"servoid.{package}."):
                here.add(room(module))
    return {at: others - {at} for at, others in found.items()}


def room(module: str) -> str:
    """The folder of a module, or of a name in one."""
    path = ROOT.joinpath(*module.split(".")[1:])
    return name(path if path.is_dir() else path.parent if path.with_suffix(".py").is_file() else path.parent.parent)


def circles(edges: dict[str, set[str]]) -> set[frozenset[str]]:
    """Groups of folders each of which imports, over others, from each."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        ahead = [start]
        while ahead:
            further = edges.get(ahead.pop(), set()) - seen
            seen |= further
            ahead += further
        return seen

    reach = {at: reached(at) for at in edges}
    return {frozenset(b for b in edges if b in reach[a] and a in reach[b]) for a in edges if a in reach[a]}


def test_folders_of_a_package_do_not_import_each_other_in_a_circle() -> None:
    assert set().union(*(circles(rooms(package)) for package in BELOW)) == set()


def test_a_circle_is_seen() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == {frozenset("abc")}


def classes(code: str) -> Iterator[str]:
    return (node.name for node in ast.walk(parse(code)) if isinstance(node, ast.ClassDef))


def test_a_class_name_stands_for_one_thing() -> None:
    """Two things of one name are told apart by their imports alone, and in a log or an error by nothing."""
    where: dict[str, list[str]] = {}
    for path in (path for package in BELOW for path in sources(package)):
        for found in classes(path.read_text()):
            where.setdefault(found, []).append(name(path))
    assert {found: paths for found, paths in where.items() if len(paths) > 1} == {}


def crowds(code: str) -> Iterator[tuple[str, int]]:
    """Name and number of the arguments of every function that takes more than `MOST_ARGUMENTS`."""
    for node in ast.walk(parse(code)):
        if isinstance(node, ast.FunctionDef):
            taken = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            count = len(taken) - (taken[:1] in (["self"], ["cls"]))
            if count > MOST_ARGUMENTS:
                yield node.name, count


def test_what_takes_many_arguments_takes_a_dataclass() -> None:
    found = {
        (name(path), function)
        for package in BELOW
        for path in sources(package)
        for function, _ in crowds(path.read_text())
    }
    assert found == MANY


def test_a_crowd_of_arguments_is_seen() -> None:
    assert list(crowds("class A:\n    def f(self, a, b, c, d, e, f, *, g, h): ...")) == [("f", 8)]


def test_configs_hold_data_alone() -> None:
    assert {path.suffix for path in (ROOT / "configs").rglob("*") if path.is_file()} <= {
        ".yaml",
        ".xml",
        ".safetensors",
    }
