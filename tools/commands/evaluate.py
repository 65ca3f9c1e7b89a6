"""Measure a policy as papers do, and print its figures beside theirs.

EVALUATION is `papers`, the tables of UniPhys and Diffuse-CLoC, or your own YAML file. Finished episodes are kept under
--out and not repeated while checkpoint, settings, task and code are the same, so an interrupted evaluation continues
where it stopped. docs/evaluation.md explains every row, and how to write an evaluation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError, available
from servoid.tools.common.cluster import add_ray_argument
from servoid.tools.common.exit_codes import exit_code, explain
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import check_seed
from servoid.tools.evaluate.report import HEAD, Measured, as_csv, cells, markdown, table
from servoid.tools.evaluate.runner import Interrupted, Options, evaluate
from servoid.tools.evaluate.spec import Evaluation, Row, load_evaluation, select

QUICK_EPISODES = 2
QUICK_MINUTES = 9.0  # one more is for the start and for drawing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    names = ", ".join(available("evaluation"))
    parser.add_argument("evaluation", metavar="EVALUATION", help=f"{names}, or your own YAML file")
    parser.add_argument("--quick", action="store_true", help="only the main rows and few episodes, in under 10 minutes")
    parser.add_argument(
        "--rows",
        nargs="+",
        default=[],
        metavar="NAME",
        help="only these rows; patterns such as 'uniphys/goal-*' or '*@virtual'",
    )
    parser.add_argument("--list", action="store_true", help="list the names of the rows and stop")
    parser.add_argument(
        "--policy",
        default="diffusion",
        metavar="NAME|FILE",
        help="controller, as in `servoid run` (default: diffusion)",
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (default: runs/EVALUATION)")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: one per core)")
    add_ray_argument(parser)
    parser.add_argument(
        "--episodes", type=int, metavar="N", help="episodes of each row (default: the row's own, mostly 100)"
    )
    parser.add_argument(
        "--seconds", type=float, metavar="S", help="cut each episode short, to try it out: the figures mean little"
    )
    parser.add_argument(
        "--minutes",
        type=float,
        metavar="M",
        help="time limit; the same command continues; 0: print what is done so far",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument("--fresh", action="store_true", help="repeat all episodes")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Evaluate and write; returns 0 when done, whatever the figures. Raises ConfigError."""
    with reporting(args.json) as report:
        _check(args)
        evaluation = load_evaluation(args.evaluation)
        rows = select(evaluation.rows, args.rows, args.quick)
        if args.list:
            report.table(("name", "paper", "row"), [(row.name, row.paper, row.title) for row in rows])
            report.result({"rows": [row.name for row in rows]})
            return 0
        begun, options = time.monotonic(), options_of(args, evaluation)
        measured: Mapping[str, Measured]
        interrupt: Interrupted | None = None
        try:
            with locked(options.out):
                measured = evaluate(rows, options, report.line)
        except Interrupted as error:
            measured, interrupt = error.measured, error  # raised below, when what was done is told
        page = _Page(evaluation, options, rows, measured)
        page.print(report)
        page.write(report)
        result = page.result() | {"wall_seconds": time.monotonic() - begun}
        if interrupt is not None:
            result |= {"error": explain(interrupt), "exit_code": exit_code(interrupt)}
        report.result(result)
        if interrupt is not None:
            raise interrupt
    return 0


def options_of(args: argparse.Namespace, evaluation: Evaluation) -> Options:
    """How to evaluate, as the command line says."""
    return Options(
        out=args.out or Path("runs") / evaluation.name,
        policy=args.policy,
        robot=args.robot,
        seed=args.seed,
        episodes=args.episodes or (QUICK_EPISODES if args.quick else None),
        seconds=args.seconds,
        workers=args.workers,
        ray=args.ray,
        minutes=QUICK_MINUTES if args.quick and args.minutes is None else args.minutes,
        quick=args.quick,
        fresh=args.fresh,
    )


def _check(args: argparse.Namespace) -> None:
    for name, value in (("episodes", args.episodes), ("seconds", args.seconds)):
        if value is not None and value <= 0:
            raise ConfigError(f"--{name} must be positive, not {value:g}")
    if args.minutes is not None and args.minutes < 0:
        raise ConfigError(f"--minutes must not be negative, not {args.minutes:g}")
    if args.minutes == 0 and args.fresh:
        raise ConfigError("--fresh discards what --minutes 0 would print: drop one of them")
    if args.workers < 0:
        raise ConfigError(f"--workers must not be negative, not {args.workers}; 0 is one per core")
    check_seed(args.seed)


def encoder_accuracy() -> dict[str, Any]:
    """Share of the held-out phrasings whose nearest training phrasing names the same motion: no robot in it."""
    from servoid.policy.text.captions import MOTIONS
    from servoid.policy.text.encoder import load_encoder
    from servoid.policy.text.nearest_phrase import Phrasebook
    from servoid.tools.common.confidence import wilson

    pairs = [(number, text) for number, motion in enumerate(MOTIONS) for text in motion.held_out]
    read = Phrasebook(load_encoder()).nearest([text for _, text in pairs])
    right = sum(int(number == found) for (number, _), found in zip(pairs, read, strict=True))
    return {"accuracy": right / len(pairs), "ci95": wilson(right, len(pairs)), "phrasings": len(pairs)}


class _Page:
    """What an evaluation came to, for the terminal, for files and as JSON."""

    def __init__(
        self, evaluation: Evaluation, options: Options, rows: Sequence[Row], measured: Mapping[str, Measured]
    ) -> None:
        self._evaluation, self._options, self._rows, self._measured = evaluation, options, rows, measured
        self._lines = table(rows, measured)
        self._encoder = encoder_accuracy() if any(row.experiment.task == "text" for row in rows) else None

    def result(self) -> dict[str, Any]:
        """What `--json` prints."""
        return {
            "policy": self._options.policy,
            "robot": self._options.robot,
            "seed": self._options.seed,
            "quick": self._options.quick,
            "rows": self._lines,
            "text_encoder": self._encoder,
            "left_out": self._evaluation.left_out,
            "out": self._options.out,
        }

    def print(self, report: Report) -> None:
        report.table(HEAD, [cells(line) for line in self._lines])
        for text in self._below():
            report.line(text)

    def write(self, report: Report) -> None:
        """Markdown, CSV and the paths, where anything was measured: an empty page would replace one that is not.

        Raises ConfigError.
        """
        out = self._options.out
        if not any(result.records for result in self._measured.values()):
            report.line(f"nothing was measured: no page is written in {out}")
            return
        pictures = self._draw(report)
        below = [*(f"- {text}" for text in self._below()), "", *(f"![{path.stem}]({path.name})" for path in pictures)]
        page = markdown(self._evaluation.title, self._facts(), self._lines, below)
        for ending, text in (("md", page), ("csv", as_csv(self._lines))):
            path = out / f"{self._evaluation.name}.{ending}"
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
            except OSError as error:
                raise ConfigError(f"{path}: cannot be written ({error.strerror}): choose another --out") from None
            report.line(str(path))

    def _below(self) -> list[str]:
        if self._encoder is None:
            return list(self._evaluation.left_out)
        low, high = self._encoder["ci95"]
        share = f"{self._encoder['accuracy']:.3g} ({low:.3g} to {high:.3g})"
        read = f"Text encoder alone: {share} of {self._encoder['phrasings']} held-out phrasings read rightly."
        return [read, *self._evaluation.left_out]

    def _facts(self) -> list[str]:
        from servoid.stack.control.policies import policy_fingerprint

        options = self._options
        commits = sorted({str(record["commit"]) for result in self._measured.values() for record in result.records})
        facts = [
            f"policy: {options.policy}, checkpoint {policy_fingerprint(options.policy)['checkpoint_sha256']}",
            f"robot: {options.robot}; seed: {options.seed}; code: {', '.join(commits) or 'none ran'}",
            "judged by the simulation's truth; intervals: Wilson for shares, bootstrap for means",
        ]
        if options.seconds is not None:
            facts.append(f"episodes were cut to {options.seconds:g} s: for a try, not to be compared")
        if options.quick:
            note = self._evaluation.quick_note
            facts.append("quick: few episodes, so wide intervals" + (f"; {note}" if note else ""))
        return facts

    def _draw(self, report: Report) -> list[Path]:
        """A picture of each experiment that went anywhere, once where rows share it."""
        from servoid.tools.evaluate.plots import draw_paths

        pictures: list[Path] = []
        drawn: list[Measured] = []
        for row in self._rows:
            measured = self._measured[row.name]
            if not measured.records or any(measured is other for other in drawn):
                continue
            drawn.append(measured)
            path = self._options.out / f"paths-{row.name.replace('/', '-')}.png"
            try:
                draw_paths(measured.records, row.title, path)
            except ModuleNotFoundError as error:
                report.line(f"no pictures: {error}; `pip install 'servoid[video]'` brings what draws them")
                return []
            pictures.append(path)
        return pictures
