"""What an evaluation is: rows, each of an experiment's episodes by a metric, as a file of configs/evaluation/ says."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from servoid.hw.config import ConfigError, Marks, load_marked, nearest
from servoid.hw.config import resolve as resolve_config
from servoid.tools.evaluate.metrics import METRICS, Metric

Scalar = str | int | float | bool
T = TypeVar("T")


@dataclass(frozen=True)
class OwnNetwork:
    """A network that is not shipped. `train` are the options of `servoid train diffusion` beside --data and --out.

    With `latents` it plans latents, which `servoid train latent` makes first. With `policy` it is a task policy, and
    `train` all options of `servoid train policy` but --out.
    """

    name: str
    train: str
    latents: bool = False
    policy: bool = False


@dataclass(frozen=True)
class Experiment:
    """Episodes of a task. Rows with the same experiment measure the same episodes.

    `plan` overrides settings of the diffusion policy, as `set` those of the task: text, as typed on a command line.
    """

    task: str
    set: Mapping[str, str] = field(default_factory=dict)
    plan: Mapping[str, str] = field(default_factory=dict)
    policy: str | None = None  # as in `servoid run`, instead of the evaluated one
    backend: str = "sim"
    randomise: bool = False
    recover: bool = False  # it gets up after a fall, and goes on
    episodes: int = 100
    quick_seconds: float | None = None  # at most so long an episode with --quick
    clips: int = 0  # recorded motions of the expert that the task takes its keyframes from
    network: OwnNetwork | None = None  # instead of the evaluated one


@dataclass(frozen=True)
class Beside:
    """A figure to reach that is so many times the value of another row."""

    row: str
    factor: float


@dataclass(frozen=True)
class Row:
    """A row: `published` is in the paper's own unit, `figure`, the one to reach, in the metric's."""

    name: str
    title: str
    experiment: Experiment
    metric: Metric
    paper: str = ""
    published: float | None = None
    published_unit: str | None = None  # where it is not the metric's
    figure: float | Beside | None = None
    quick: bool = True  # whether --quick measures it
    note: str = ""


@dataclass(frozen=True)
class Evaluation:
    """The rows of a file, in order, and what is said beside them."""

    name: str  # the file's, without its ending
    title: str
    rows: tuple[Row, ...]
    left_out: tuple[str, ...] = ()
    quick_note: str = ""


# The file as it is written: it names what may be named, and an experiment that is `like` another says what differs.


@dataclass(frozen=True)
class _Network:
    train: str
    latents: bool = False
    policy: bool = False


@dataclass(frozen=True)
class _Experiment:
    like: str | None = None
    task: str | None = None
    set: dict[str, Scalar] | None = None
    plan: dict[str, Scalar] | None = None
    policy: str | None = None
    backend: str | None = None
    randomise: bool | None = None
    recover: bool | None = None
    episodes: int | None = None
    quick_seconds: float | None = None
    clips: int | None = None
    network: str | None = None


@dataclass(frozen=True)
class _Row:
    title: str
    experiment: _Experiment | str
    metric: Metric | str
    paper: str = ""
    published: float | None = None
    published_unit: str | None = None
    figure: Beside | float | None = None
    quick: bool = True
    variants: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class _File:
    title: str
    rows: dict[str, _Row]
    experiments: dict[str, _Experiment] = field(default_factory=dict)
    networks: dict[str, _Network] = field(default_factory=dict)
    variants: dict[str, _Experiment] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    quick_note: str = ""


def load_evaluation(name: str | Path) -> Evaluation:
    """An evaluation by name or file. Raises ConfigError naming file, line and key."""
    path = resolve_config("evaluation", name)
    file, marks = load_marked(path, _File)
    rows = tuple(_Rows(file, marks).all())
    return Evaluation(path.stem, file.title, rows, file.left_out, file.quick_note)


class _Rows:
    """Makes rows of what a file says."""

    def __init__(self, file: _File, marks: Marks) -> None:
        self._file, self._marks = file, marks
        self._checked: dict[str, None] = {}  # experiments that are known to be possible

    def all(self) -> Iterator[Row]:
        """The rows as they stand in the file, then those of each variant. Raises ConfigError."""
        for name, row in self._file.rows.items():
            yield self._row(name, row, self._experiment(row.experiment, f"rows.{name}.experiment"))
            for variant in row.variants:
                self._find(variant, self._file.variants, f"rows.{name}.variants", "variant")
        for variant, change in self._file.variants.items():
            for name, row in self._file.rows.items():
                if variant in row.variants:
                    base = self._merged(row.experiment, f"rows.{name}.experiment", ())
                    experiment = self._experiment(_over(base, change), f"variants.{variant}")
                    yield replace(
                        self._row(name, row, experiment),
                        name=f"{name}@{variant}",
                        title=f"{row.title} ({variant})",
                        figure=None,
                        quick=False,
                    )

    def _row(self, name: str, row: _Row, experiment: Experiment) -> Row:
        metric = row.metric
        if isinstance(metric, str):
            metric = self._find(metric, METRICS, f"rows.{name}.metric", "metric")
        if isinstance(row.figure, Beside):
            self._find(row.figure.row, self._file.rows, f"rows.{name}.figure.row", "row")
        return Row(
            name=name,
            title=row.title,
            experiment=experiment,
            metric=metric,
            paper=row.paper,
            published=row.published,
            published_unit=row.published_unit,
            figure=row.figure,
            quick=row.quick,
            note=row.note,
        )

    def _experiment(self, entry: _Experiment | str, key: str) -> Experiment:
        merged = self._merged(entry, key, ())
        network = None
        if merged.network is not None:
            found = self._find(merged.network, self._file.networks, key, "network")
            network = OwnNetwork(merged.network, **asdict(found))
        if merged.task is None:
            raise self._marks.error(key, "names no task")
        given = _said(merged) | {"set": _texts(merged.set), "plan": _texts(merged.plan), "network": network}
        experiment = Experiment(**given)
        if repr(experiment) not in self._checked:
            try:
                _check(experiment)
            except ConfigError as error:
                raise self._marks.error(key, str(error)) from None
            self._checked[repr(experiment)] = None
        return experiment

    def _merged(self, entry: _Experiment | str, key: str, seen: tuple[str, ...]) -> _Experiment:
        """The experiment with what those say that it is like."""
        if isinstance(entry, str):
            if entry in seen:
                raise self._marks.error(key, f"experiment '{entry}' is like itself")
            found = self._find(entry, self._file.experiments, key, "experiment")
            return self._merged(found, f"experiments.{entry}.like", (*seen, entry))
        return entry if entry.like is None else _over(self._merged(entry.like, key, seen), entry)

    def _find(self, name: str, known: Mapping[str, T], key: str, kind: str) -> T:
        if name not in known:
            raise self._marks.error(key, f"unknown {kind} '{name}'; {nearest(name, known)}")
        return known[name]


def _over(base: _Experiment, change: _Experiment) -> _Experiment:
    """What `change` says, and otherwise what `base` does; settings one by one."""
    together = {"set": {**(base.set or {}), **(change.set or {})}, "plan": {**(base.plan or {}), **(change.plan or {})}}
    return replace(base, **{**_said(change), **together})


def _said(entry: _Experiment) -> dict[str, Any]:
    """What an experiment says of itself."""
    return {name: value for name, value in asdict(entry).items() if value is not None and name != "like"}


def _texts(settings: Mapping[str, Scalar] | None) -> dict[str, str]:
    """Settings as they are typed on a command line."""
    values = (settings or {}).items()
    return {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in values}


def _check(experiment: Experiment) -> None:
    """Raise ConfigError for what no episode could be made of."""
    from servoid.policy.diffusion.settings import DiffusionSettings
    from servoid.stack.control.policies import check_policy
    from servoid.stack.runtime.backends import backend_kind
    from servoid.stack.tasks import load_settings

    if experiment.episodes < 1:
        raise ConfigError(f"episodes must be at least 1, not {experiment.episodes}")
    if not backend_kind(experiment.backend).simulated:
        raise ConfigError(f"backend '{experiment.backend}' has no truth to judge by")
    load_settings(experiment.task, dict(experiment.set))
    if experiment.policy is not None:
        check_policy(experiment.policy)
    for name in experiment.plan:  # what goes together is known when the policy is
        known: Any = asdict(DiffusionSettings())
        for part in name.split("."):
            known = known if isinstance(known, dict) else {}
            if part not in known:
                raise ConfigError(f"plan: unknown setting '{name}': {nearest(part, known)}")
            known = known[part]


def select(rows: Sequence[Row], patterns: Sequence[str], quick: bool) -> list[Row]:
    """The rows that match a pattern such as `uniphys/goal-*`, without patterns all of them or those that are quick.

    Rows that a figure to reach is taken from come along. Raises ConfigError for a pattern that matches none.
    """
    names = [row.name for row in rows]
    chosen = {row.name for row in rows if not patterns and (row.quick or not quick)}
    for pattern in patterns:
        matching = fnmatch.filter(names, pattern)
        if not matching:
            close = difflib.get_close_matches(pattern, names, n=3, cutoff=0.0)
            raise ConfigError(f"--rows {pattern}: no such row; the nearest are {', '.join(close)}; --list shows all")
        chosen.update(matching)
    chosen.update(row.figure.row for row in rows if row.name in chosen and isinstance(row.figure, Beside))
    return [row for row in rows if row.name in chosen]
