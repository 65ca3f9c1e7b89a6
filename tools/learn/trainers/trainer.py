"""A training run in a folder, whatever is trained: budget, checkpoints, going on, progress, log, the best network."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import yaml

from servoid.hw.config import ConfigError
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.parser import counted
from servoid.tools.learn.flags import add_setting_flags, plain
from servoid.tools.learn.progress import ProgressLine
from servoid.tools.learn.settings import TrainingRun

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.tools.learn.trainers.logger import Logger

# From a checkpoint's path to what was measured of it where it runs; "survival" in it is the share of worlds that stayed
# up, 0 to 1.
Judge = Callable[[Path], Mapping[str, float]]

_CHUNK = 10.0  # seconds of training between two rows of the log, at most


def add_run_arguments(
    parser: argparse.ArgumentParser,
    base: TrainingRun,
    out: Path | None = None,
    what: str = "folder of the run: checkpoints, log, learning curve",
    *,
    data: bool = False,
    threads: int = 0,
) -> argparse._ArgumentGroup:
    """Add what every training takes, and a flag for each setting of `base`; returns the group of the run itself."""
    run = parser.add_argument_group("run")
    if data:
        run.add_argument(
            "--data", type=Path, required=True, metavar="DIR", help="dataset folder, written by `servoid collect`"
        )
    shown = what + (f" (default: {out})" if out else "")
    run.add_argument("--out", type=Path, default=out, required=out is None, metavar="PATH", help=shown)
    run.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    run.add_argument(
        "--config", metavar="NAME|FILE", help="settings file, or its name in configs/training; flags override it"
    )
    run.add_argument(
        "--resume",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="continue the run in --out with the settings it started with; its length may change (default: yes)",
    )
    shown = f"threads of torch (default: {threads or 'all cores'})"
    run.add_argument("--threads", type=counted, default=threads or os.cpu_count(), metavar="N", help=shown)
    add_setting_flags(parser, base, run)
    return run


class Trainer(ABC):
    """The loop. A method says what it optimises and how it is judged.

    `LAST` is the newest network, `BEST` the one with the best score, `resume.pt` all that is needed to go on.
    """

    BEST: ClassVar[str] = "best.safetensors"
    LAST: ClassVar[str] = "last.safetensors"
    LOSS: ClassVar[str] = ""  # of what `held_out` returns, what decides between networks that survive equally often
    columns: Sequence[str]  # of the log, beside the minutes: what `learn`, `shown`, `held_out` and `judge` give
    panels: Sequence[Sequence[str]]  # columns that are drawn, by picture

    def __init__(self, out: Path, settings: TrainingRun, source: str, judge: Judge | None = None) -> None:
        """`source` says what is learned from: a run goes on with the same. `judge` runs a checkpoint in closed loop."""
        self.out, self.settings, self.source, self.judge = out, settings, source, judge
        self.every = settings.evaluate_every / settings.minutes or math.inf  # share of the budget between evaluations
        self.step = 0
        self.seconds = 0.0  # of training, evaluations not counted
        self.evaluated = 0.0  # share of the budget that was used at the last evaluation
        self.best: tuple[float, float] | None = None
        self.best_path = out / self.BEST
        self._shipped = 0  # step of the newest network on disk
        self.begun_with: dict[str, Any] = {}  # the checkpoint that training began with, if any
        out.mkdir(parents=True, exist_ok=True)

    # -- what a method says --------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def title(self) -> str:
        """What is trained on what."""

    @property
    @abstractmethod
    def following(self) -> str:
        """The command that follows a training."""

    @abstractmethod
    def learn(self) -> Mapping[str, float]:
        """One step of the method, which adds to `step`; returns what is logged of it, by column."""

    @abstractmethod
    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[Mapping[str, float], str]:
        """Further columns, and the text that is shown, of the means of what `learn` returned since the last row."""

    @abstractmethod
    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        """Write a checkpoint whose header says `results`."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """What `resume.pt` holds beside the run's own progress: tensors, numbers, text."""

    @abstractmethod
    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        """Inverse of `state`. Raises ConfigError naming `path` where it does not fit."""

    def prepare(self) -> None:  # noqa: B027
        """What is done before the first step of a call, in a new run and in one that goes on."""

    def adopt(self, path: Path) -> None:
        """Begin with the weights of the checkpoint `path`. Raises ConfigError where it does not fit."""
        raise NotImplementedError

    def held_out(self) -> dict[str, float]:
        """What is measured on what was not trained on, `LOSS` among it."""
        return {}

    def score(self, results: Mapping[str, float]) -> tuple[float, float]:
        """How good a network is: by survival, and among equals by `LOSS`."""
        return results.get("survival", 0.0), -results[self.LOSS]

    # -- a run ---------------------------------------------------------------------------------------------------------

    @property
    def share(self) -> float:
        """Of the budget, 0 to 1: of the steps where they are given, or else of the minutes."""
        budget = self.settings.budget
        return min(1.0, self.step / budget if budget else self.seconds / (60 * self.settings.minutes))

    @property
    def length(self) -> str:
        """The budget in words."""
        budget = self.settings.budget
        return f"{budget:,.0f} steps" if budget else f"{self.settings.minutes:g} minutes"

    @property
    def progress(self) -> dict[str, Any]:
        """How far the run has come, and what it began with, for the header of a checkpoint."""
        progress = {"step": self.step, "minutes": round(self.seconds / 60, 2), "share": round(self.share, 4)}
        return {**progress, **({"begun_with": self.begun_with} if self.begun_with else {})}

    def start(self, resume: bool, init: Path | None = None) -> None:
        """Go on with the run in the folder, or begin anew, with the checkpoint `init` if any. Raises ConfigError."""
        from servoid.policy.checkpoint import read_header
        from servoid.stack.log.provenance import sha256

        if resume and self.resume():
            if init is not None and self.begun_with.get("sha256") != sha256(init):
                raise ConfigError(
                    f"{self.out}: holds a run that did not start from {init}: use --no-resume or another --out"
                )
        elif init is not None:
            self.adopt(init)
            header = read_header(init)
            known = {name: header[name] for name in ("git_commit", "data", "licence", "results")}
            self.begun_with = {"checkpoint": init.name, "sha256": sha256(init), **known}

    def run(self) -> None:
        """Train until the budget is used up. Interrupted, it saves what is needed to go on, and the newest network."""
        with locked(self.out):
            self._run()

    def _run(self) -> None:
        from servoid.tools.learn.trainers.logger import Logger

        print(f"training {self.title}, {self.length}, in {self.out}", file=sys.stderr)
        text = yaml.safe_dump(plain(self.settings), sort_keys=False)
        (self.out / "settings.yaml").write_text(text, encoding="utf-8")
        if self.share < 1.0 or self.evaluated < self.share:
            self.prepare()
        try:
            with Logger(self.out, ("minutes", *self.columns), self.step) as logger, ProgressLine(self.share) as line:
                while self.share < 1.0:
                    self._train_until(self.evaluated + self.every, logger, line)
                    if self.evaluated + self.every <= self.share < 1.0:
                        self._evaluate(logger, line)
                if self.evaluated < self.share:
                    self._evaluate(logger, line)
        except KeyboardInterrupt:
            self.save()
            if self._shipped < self.step:
                self.ship(self.out / self.LAST, self.progress)
            print(f"interrupted: the same command goes on from step {self.step:,}", file=sys.stderr)
            raise
        print(f"best network: {self.best_path}\nnext: {self.following}", file=sys.stderr)

    def _train_until(self, share: float, logger: Logger, line: ProgressLine) -> None:
        """Train until that share of the budget is used, at most for ten seconds, and log the means."""
        before, start = self.seconds, time.perf_counter()
        first, rows = self.step, [self.learn()]
        self.seconds = before + time.perf_counter() - start
        while self.share < min(share, 1.0) and self.seconds - before < _CHUNK:
            rows.append(self.learn())
            self.seconds = before + time.perf_counter() - start
        means = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}
        elapsed = self.seconds - before
        more, text = self.shown(means, (self.step - first) / elapsed)
        logger.log(self.step, {"minutes": self.seconds / 60, **means, **more})
        line.trained(self.share, elapsed, f"step {self.step:,}, {text}")

    def _evaluate(self, logger: Logger, line: ProgressLine) -> None:
        """Save, judge the network, and keep it when it is the best so far."""
        line.note("measuring on held-out data ...")
        results = self.held_out()
        last = self.out / self.LAST
        self.ship(last, {**self.progress, **results})
        self._shipped = self.step
        self.save()
        if self.judge is not None:
            line.note("measuring in closed loop ...")
            results |= {name: float(value) for name, value in self.judge(last).items()}
        score = self.score(results)
        if better := self.best is None or score > self.best:
            self.best = score
            self.ship(self.best_path, {**self.progress, **results})
        self.evaluated = self.share
        self.save()
        if results:
            logger.log(
                self.step, {"minutes": self.seconds / 60} | {k: v for k, v in results.items() if k in self.columns}
            )
            text = ", ".join(f"{name} {value:.4g}" for name, value in results.items())
            line.write(f"step {self.step:,}, {self.seconds / 60:.1f} min: {text}{' (best)' if better else ''}")
        logger.plot(self.out / "learning_curve.png", self.panels, x="minutes")
        line.note(f"step {self.step:,}")

    # -- files ---------------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write `resume.pt`, whole or not at all."""
        import torch

        path = self.out / "resume.pt"
        part = path.with_suffix(".part")
        run = {
            "step": self.step,
            "seconds": self.seconds,
            "evaluated": self.evaluated,
            "best": list(self.best) if self.best else [],
            "source": self.source,
            "begun_with": self.begun_with,
            "settings": asdict(self.settings),
        }
        torch.save({**self.state(), **run}, part)
        part.replace(path)

    def resume(self) -> bool:
        """Go on where the run in the folder stopped, if there is one. Raises ConfigError when it does not fit."""
        import pickle

        import torch

        path = self.out / "resume.pt"
        if not path.exists():
            return False
        try:
            saved: dict[str, Any] = torch.load(path, weights_only=True)
        except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
            raise ConfigError(f"{path}: cannot be resumed ({error}); use --no-resume or another --out") from error
        ours = {name: value for name, value in asdict(self.settings).items() if name not in self.settings.FREE}
        # A checkpoint's header states them for the whole run. Those of an older program are not known.
        require_same(path, "other settings", ours, ours | saved.get("settings", {}))
        if (source := saved.get("source", self.source)) != self.source:
            raise ConfigError(f"{path}: trained on {source}, not on {self.source}; use --no-resume or another --out")
        self.restore(path, saved)
        self.begun_with = saved.get("begun_with", {})
        self.step, self.seconds = saved["step"], saved["seconds"]
        self.evaluated = min(saved["evaluated"], self.share)  # of another budget, perhaps
        self.best = (saved["best"][0], saved["best"][1]) if saved["best"] else None
        done = "; nothing is left to train" if self.share == 1.0 else ""
        print(f"resumed at step {self.step:,}, {self.seconds / 60:.1f} minutes{done}", file=sys.stderr)
        return True


def require_same(path: Path, otherwise: str, ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    """Refuse to resume what was begun `otherwise`, with another config say. Raises ConfigError naming what changed."""
    changed = [f"{key} was {theirs.get(key)}, is {value}" for key, value in ours.items() if theirs.get(key) != value]
    if changed:
        what = "; ".join(changed)
        raise ConfigError(f"{path}: {otherwise} ({what}); use its options, --no-resume or another --out")


def option_of(robot: Robot) -> str:
    """` --robot FILE` for a robot other than the one that commands take by themselves."""
    file = Path(robot.folder).with_suffix(".yaml")
    return f" --robot {file}" if robot.name != "op3" and file.is_file() else ""
