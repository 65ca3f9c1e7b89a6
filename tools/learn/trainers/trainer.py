"""A training run of a given time or number of steps, in a folder where it goes on, that keeps its best network."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from servoid.hw.config import ConfigError

# From a checkpoint's path to what was measured; "survival" in it is the share of worlds that stayed up, 0 to 1.
Survival = Callable[[Path], Mapping[str, float]]

BUDGET = ("minutes", "steps", "evaluate_every")  # settings that may change where a run goes on


def add_run_arguments(parser: argparse.ArgumentParser, minutes: float, evaluate_every: float, otherwise: str) -> None:
    """Add the options that all such trainers share. `otherwise` chooses the best where survival is not measured."""
    parser.add_argument("--data", type=Path, required=True, help="dataset folder, as `servoid collect` writes it")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run: checkpoints, logs, learning curve")
    parser.add_argument("--robot", default="op3", help="robot name or file (default op3)")
    parser.add_argument("--minutes", type=float, default=minutes, help="training time; evaluations come on top")
    parser.add_argument(
        "--steps",
        type=int,
        default=0,
        help="train for so many steps instead, the same on any machine; evaluated as often as in --minutes",
    )
    parser.add_argument(
        "--resume",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="continue in --out, with the options of before; --minutes, --steps and --evaluate-every may be others",
    )
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="torch threads (default: all cores)")
    parser.add_argument("--evaluate-every", type=float, default=evaluate_every, help="minutes; 0: only at the end")
    parser.add_argument("--survival-seconds", type=float, default=10.0)
    parser.add_argument("--survival-worlds", type=int, default=32, help=f"0: keep the best by {otherwise} instead")
    parser.add_argument("--licence", default="Apache-2.0", help="licence of the data, kept in the checkpoint")
    parser.add_argument("--seed", type=int, default=0)


class TimedTrainer:
    """One run in one folder; a trainer of a network says what a step is and what its files hold.

    `last.safetensors` is the newest network, `BEST` the one with the best closed-loop survival (ties: the lower `LOSS`
    on what was held out), `resume.pt` all that is needed to go on.
    """

    BEST: ClassVar[str] = "best.safetensors"
    LOSS: ClassVar[str]
    COLUMNS: ClassVar[tuple[str, ...]]  # of the log: "minutes", and all that is measured
    PANELS: ClassVar[Sequence[Sequence[str]]]  # columns that are drawn, by picture

    def __init__(self, out: Path, settings: Any, survival: Survival | None) -> None:
        """`settings` is a dataclass that has `BUDGET`, and what else the trainer of a network is told.

        There, `minutes` are of training, evaluations not counted, or else `steps` where they are not 0;
        `evaluate_every` are minutes, of `minutes`; 0: only at the end. Raises ConfigError for less than nothing.
        """
        minutes, every = settings.minutes, settings.evaluate_every
        if minutes <= 0 or settings.steps < 0 or every < 0:
            raise ConfigError("--minutes must be positive, --steps and --evaluate-every not negative")
        self.out, self.settings, self.survival = out, settings, survival
        self.minutes, self.steps = minutes, settings.steps
        self.every = every / minutes or math.inf  # share of the budget from an evaluation to the next
        self.step = 0
        self.seconds = 0.0  # of training, evaluations not counted
        self.evaluated = 0.0  # share of the budget that was used at the last evaluation
        self.best: tuple[float, float] | None = None  # survival, minus the held-out loss
        out.mkdir(parents=True, exist_ok=True)

    # -- what a trainer of a network says ----------------------------------------------------------------------------

    def _title(self) -> str:
        """What is trained on what."""
        raise NotImplementedError

    def _step(self) -> tuple[float, ...]:
        """One step of the optimiser; returns its losses."""
        raise NotImplementedError

    def _progress(self, losses: tuple[float, ...], steps_per_s: float) -> tuple[dict[str, float], str]:
        """What is logged of the mean losses of the last steps, by column, and what is shown of them."""
        raise NotImplementedError

    def _held_out(self) -> dict[str, float]:
        """Losses on what was held out, `LOSS` among them."""
        raise NotImplementedError

    def _ship(self, path: Path, results: Mapping[str, float]) -> None:
        """Write a checkpoint."""
        raise NotImplementedError

    def _state(self) -> dict[str, Any]:
        """What `resume.pt` holds beside the run's own progress."""
        raise NotImplementedError

    def _restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        """Inverse of `_state`. Raises ConfigError naming `path` when it is of another network or of other data."""
        raise NotImplementedError

    # -- a run -----------------------------------------------------------------------------------------------------

    @property
    def share(self) -> float:
        """Of the time or of the steps that is used up, 0 to 1."""
        return min(1.0, self.step / self.steps if self.steps else self.seconds / (60 * self.minutes))

    @property
    def progress(self) -> dict[str, float]:
        """How far the run has come, for the header of a checkpoint."""
        return {"step": self.step, "minutes": round(self.seconds / 60, 2), "share": round(self.share, 4)}

    def run(self) -> None:
        """Train until the budget is used up. Interrupted, it saves first what `resume` needs."""
        from tqdm import tqdm

        from servoid.tools.learn.trainers.logger import Journal

        budget = f"{self.steps:,} steps" if self.steps else f"{self.minutes:g} minutes"
        print(f"training {self._title()}, {budget}, in {self.out}", file=sys.stderr)
        with (
            Journal(self.out, self.COLUMNS, self.step) as journal,
            tqdm(total=100, initial=round(100 * self.share), unit="%", file=sys.stderr, mininterval=2) as bar,
        ):
            try:
                while self.share < 1.0:
                    self._train_until(self.evaluated + self.every, journal, bar)
                    if self.evaluated + self.every <= self.share < 1.0:
                        self._evaluate(journal, bar)
                if self.evaluated < self.share:
                    self._evaluate(journal, bar)
            except KeyboardInterrupt:
                self.save()
                print(f"interrupted: the same command goes on from step {self.step}", file=sys.stderr)
                raise

    def _train_until(self, share: float, journal: Any, bar: Any) -> None:
        """Train until that share of the budget is used, at most for ten seconds, and log the means."""
        before, start = self.seconds, time.perf_counter()
        losses: list[tuple[float, ...]] = []
        while not losses or (self.share < min(share, 1.0) and self.seconds - before < 10.0):
            losses.append(self._step())
            self.seconds = before + time.perf_counter() - start
        elapsed, steps = self.seconds - before, len(losses)
        means = tuple(sum(column) / steps for column in zip(*losses, strict=True))
        columns, text = self._progress(means, steps / elapsed)
        journal.log(self.step, {"minutes": self.seconds / 60, **columns})
        bar.update(round(100 * self.share) - bar.n)
        bar.set_postfix_str(f"step {self.step}, {text}")

    def _evaluate(self, journal: Any, bar: Any) -> None:
        """Save, measure the held-out loss and survival, and keep the network when it is the best so far."""
        results = self._held_out()
        last = self.out / "last.safetensors"
        self._ship(last, results)
        self.save()
        if self.survival is not None:
            results |= {name: float(value) for name, value in self.survival(last).items()}
        score = (results.get("survival", 0.0), -results[self.LOSS])
        if better := self.best is None or score > self.best:
            self.best = score
            self._ship(self.out / self.BEST, results)
        self.evaluated = self.share
        self.save()
        row = {name: value for name, value in results.items() if name in self.COLUMNS}
        journal.log(self.step, {"minutes": self.seconds / 60, **row})
        journal.plot(self.out / "learning_curve.png", self.PANELS, x="minutes")
        text = ", ".join(f"{name} {value:.4g}" for name, value in results.items())
        note = " (best)" if better else ""
        bar.write(f"step {self.step}, {self.seconds / 60:.1f} min: {text}{note}", file=sys.stderr)

    # -- files -----------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write `resume.pt`, whole or not at all."""
        import torch

        path = self.out / "resume.pt"
        part = path.with_suffix(".part")
        best = list(self.best) if self.best else []
        run = {"step": self.step, "seconds": self.seconds, "evaluated": self.evaluated, "best": best}
        torch.save({**self._state(), **run, "settings": asdict(self.settings)}, part)
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
        ours = {name: value for name, value in asdict(self.settings).items() if name not in BUDGET}
        # A checkpoint's header states them for the whole run. Those of an older program are not known.
        same(path, "other settings", ours, ours | saved.get("settings", {}))
        self._restore(path, saved)
        self.step, self.seconds = saved["step"], saved["seconds"]
        self.evaluated = min(saved["evaluated"], self.share)  # of another budget, perhaps
        self.best = (saved["best"][0], saved["best"][1]) if saved["best"] else None
        print(f"resumed at step {self.step}, {self.seconds / 60:.1f} minutes", file=sys.stderr)
        return True


def same(path: Path, otherwise: str, ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    """Refuse to resume what was begun `otherwise`, with another config say. Raises ConfigError naming what changed."""
    changed = [f"{key} was {theirs.get(key)}, is {value}" for key, value in ours.items() if theirs.get(key) != value]
    if changed:
        what = "; ".join(changed)
        raise ConfigError(f"{path}: {otherwise} ({what}); use its options, --no-resume or another --out")
