"""Print what completes the words of `servoid` in a shell: verbs, options, and the names that they take.

    servoid completion bash > ~/.local/share/bash-completion/completions/servoid
    servoid completion zsh > DIR/_servoid      (DIR: one of those in $fpath)
    servoid completion fish > ~/.config/fish/completions/servoid.fish

Make the file's folder first where there is none, and open a new shell. Names are those of today: print it again after
you installed a package that brings tasks or policies.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from servoid.hw.config import available
from servoid.tools.common import exit_codes
from servoid.tools.common.output import say

_BASH = r"""# bash completion of servoid
_servoid() {
    local word=${COMP_LINE:0:COMP_POINT} cur=${COMP_WORDS[COMP_CWORD]} verb=${COMP_WORDS[1]} first=2
    local option= since=0 i names= many= files= reply
    word=${word##*[[:space:]]}
    COMPREPLY=()
    case $verb in
        GROUPS)
            verb="$verb ${COMP_WORDS[2]}" first=3 ;;
    esac
    if ((COMP_CWORD < first)); then
        case "$COMP_CWORD ${COMP_WORDS[1]}" in
VERBS
        esac
    else
        for ((i = COMP_CWORD - 1; i >= first; i--)); do
            if [[ ${COMP_WORDS[i]} == -* ]]; then
                option=${COMP_WORDS[i]} since=$((COMP_CWORD - i))
                break
            fi
        done
        [[ $word == --*=* ]] && option=${word%%=*} word=${word#*=} since=1
        case "$verb $option" in
OPTIONS
            *) since=0 ;;
        esac
        if ((since == 0 || since > 1 && !many)) || [[ $since -gt 1 && $word == -* ]]; then
            names= files=
            if [[ $word == -* ]]; then
                case $verb in
FLAGS
                esac
            else
                case $verb in
PLACES
                esac
            fi
        fi
    fi
    while IFS= read -r reply; do
        COMPREPLY+=("${reply#"${word%"$cur"}"}")
    done < <(compgen -W "$names" -- "$word"; [[ $files ]] && compgen -f -- "$word")
    [[ $files ]] && compopt -o filenames 2>/dev/null
    return 0
}
complete -F _servoid servoid
"""

_ZSH = r"""#compdef servoid
_servoid() {
    local -a verbs
    local verb=$words[2]
    integer inner=2
    case $verb in
        GROUPS) verb="$words[2] $words[3]" inner=3 ;;
    esac
    if (( CURRENT <= inner )); then
        case "$CURRENT $words[2]" in
VERBS
        esac
        _describe verb verbs
        return
    fi
    shift $(( inner - 1 )) words
    (( CURRENT -= inner - 1 ))
    case $verb in
ARGUMENTS
    esac
}
if [[ $funcstack[1] == _servoid ]]; then _servoid "$@"; else compdef _servoid servoid; fi
"""

_FISH = r"""# fish completion of servoid
function __servoid_at
    set -l words (commandline -opc)
    test "$words[2..]" = "$argv"
end
function __servoid_in
    set -l words (commandline -opc)
    test (count $words) -gt (count $argv); and test "$words[2..$(math (count $argv) + 1)]" = "$argv"
end
complete -c servoid -f
"""


@dataclass(frozen=True)
class Argument:
    """An option or a positional argument, and what can follow."""

    options: tuple[str, ...]  # none: positional
    help: str
    takes: str  # the name of its value; empty: a flag
    names: tuple[str, ...]  # that its value may be
    files: bool  # or may name
    many: bool  # values after one option


Commands = Mapping[str, list[Argument]]  # by "run", "bringup scan"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))


def main(args: argparse.Namespace) -> int:
    """Print the completion of a shell."""
    from servoid.tools.cli import VERBS

    groups = {"": {name: verb.help for name, verb in VERBS.items()}}
    groups |= {name: {n: v.help for n, v in verb.verbs.items()} for name, verb in VERBS.items() if verb.verbs}
    write = {"bash": bash, "zsh": zsh, "fish": fish}[args.shell]
    say(write(groups, commands()).rstrip("\n"), sys.stdout)
    return exit_codes.DONE


def commands() -> Commands:
    """All verbs with their arguments, by their parsers."""
    from servoid.tools.cli import VERBS, parser_of

    known = _Names()
    inner = {f"{name} {n}".strip(): v for name, verb in VERBS.items() for n, v in (verb.verbs or {"": verb}).items()}
    return {
        name: [_argument(action, known) for action in parser_of(f"servoid {name}", verb)._actions]
        for name, verb in inner.items()
    }


class _Names:
    """What values are called, by the argument's `dest`; looked up once."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[str, ...]] = {}
        self._sources: dict[str, Callable[[], Iterable[str]]] = {
            "task": _tasks, "policy": _policies, "robot": lambda: available("robots"), "backend": _backends,
            "evaluation": lambda: available("evaluation"), "rows": _rows,
        }  # fmt: skip

    def __call__(self, dest: str) -> tuple[str, ...]:
        if dest not in self._found:
            self._found[dest] = tuple(self._sources[dest]()) if dest in self._sources else ()
        return self._found[dest]


def _tasks() -> Iterable[str]:
    from servoid.stack import tasks

    return tasks.names()


def _policies() -> Iterable[str]:
    from servoid.stack.control import policies

    return policies.names()


def _backends() -> Iterable[str]:
    from servoid.stack.runtime.backends import BACKENDS

    return BACKENDS


def _rows() -> Iterable[str]:
    from servoid.tools.evaluate.spec import load_evaluation

    return [row.name for row in load_evaluation("papers").rows]


def _argument(action: argparse.Action, known: _Names) -> Argument:
    takes = "" if action.nargs == 0 else str(action.metavar or action.dest)
    names = tuple(map(str, action.choices)) if action.choices else known(action.dest)
    file = action.type is Path or re.search(r"FILE|DIR|PATH", takes) is not None
    named = file or action.dest in ("task", "policy", "robot", "evaluation")  # which all may be files
    text = " ".join((action.help or "").split()) % vars(action) if action.help else ""
    return Argument(
        options=tuple(action.option_strings),
        help=text,
        takes=takes,
        names=names if takes else (),
        files=bool(takes) and named,
        many=action.nargs in ("+", "*"),
    )


def bash(groups: Mapping[str, Mapping[str, str]], verbs: Commands) -> str:
    """`groups` holds names and helps of verbs, by the verb that they belong to."""
    options, flags, places = [], [], []
    for name, arguments in verbs.items():
        for one in arguments:
            if one.options and one.takes:
                cases = "|".join(f'"{name} {option}"' for option in one.options)
                options.append(f"{cases}) {_bash_set(one.names, one.files)}{' many=1' if one.many else ''} ;;")
        shown = [option for one in arguments for option in one.options]
        flags.append(f'"{name}") names="{" ".join(shown)}" ;;')
        positional = [one for one in arguments if not one.options]
        words = [word for one in positional for word in one.names]
        places.append(f'"{name}") {_bash_set(words, any(one.files for one in positional))} ;;')
    inner = [f'"2 {name}") names="{" ".join(group)}" ;;' for name, group in groups.items() if name]
    inner.append(f'1*) names="{" ".join(groups[""])} --help --version" ;;')
    return _filled(_BASH, GROUPS=_groups(groups), VERBS=inner, OPTIONS=options, FLAGS=flags, PLACES=places)


def _bash_set(names: Iterable[str], files: bool) -> str:
    return f'names="{" ".join(names)}" files={"1" if files else ""}'


def zsh(groups: Mapping[str, Mapping[str, str]], verbs: Commands) -> str:
    """Like `bash`."""
    inner = [f'"3 {name}") {_described(group)} ;;' for name, group in groups.items() if name]
    inner.append(f"2*) {_described(groups[''])} ;;")
    cases = [f'"{name}") _arguments {" ".join(_zsh(one) for one in found)} ;;' for name, found in verbs.items()]
    return _filled(_ZSH, GROUPS=_groups(groups), VERBS=inner, ARGUMENTS=cases)


def _described(group: Mapping[str, str]) -> str:
    return f"verbs=({' '.join(_quoted(f'{name}:{text}') for name, text in group.items())})"


def _zsh(one: Argument) -> str:
    """A specification of `_arguments`."""
    action = f"({' '.join(one.names)})" if one.names else " "
    if one.files:
        action = f"{{compadd -- {' '.join(one.names)}; _files}}" if one.names else "_files"
    value = f":{_plain(one.takes)}:{action}" if one.takes else ""
    if not one.options:
        return _quoted(f"*{value}")
    many = ":*" if one.many else ""
    return " ".join(_quoted(f"*{option}[{_plain(one.help)}]{many}{value}") for option in one.options)


def fish(groups: Mapping[str, Mapping[str, str]], verbs: Commands) -> str:
    """Like `bash`."""
    lines = [
        f"complete -c servoid -n '__servoid_at {name}' -a {_quoted(verb)} -d {_quoted(text)}"
        for name, group in groups.items()
        for verb, text in group.items()
    ]
    for name, found in verbs.items():
        lines += [line for one in found for line in _fish(name, one)]
    return _FISH + "\n".join(lines) + "\n"


def _fish(name: str, one: Argument) -> Iterator[str]:
    start = f"complete -c servoid -n '__servoid_in {name}'"
    names = f" -a {_quoted(' '.join(one.names))}" if one.names else ""
    files = " -F" if one.files else ""
    if not one.options:
        if names or files:
            yield start + files + names
        return
    takes = (" -r" + files if files else " -x") if one.takes else ""
    flags = "".join(f" -l {o[2:]}" if o.startswith("--") else f" -s {o[1:]}" for o in one.options)
    yield f"{start}{flags}{takes}{names} -d {_quoted(one.help)}"


def _filled(template: str, **parts: str | list[str]) -> str:
    """`template` with its words in capitals replaced; of a list, each line on its own."""
    for name, part in parts.items():
        text = part if isinstance(part, str) else "\n".join(" " * 12 + line for line in part)
        template = template.replace(name, text)
    return template


def _groups(groups: Mapping[str, Mapping[str, str]]) -> str:
    return "|".join(name for name in groups if name)


def _plain(text: str) -> str:
    """Text without what `_arguments` would read."""
    return re.sub(r"([\[\]:\\])", r"\\\1", text)


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"
