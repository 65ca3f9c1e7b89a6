"""Print the papers' tables with this project's column beside the published one.

Episodes that were done are kept under --out and not repeated, as long as checkpoint, settings, task and code are the
same: an evaluation that was interrupted goes on where it was. docs/evaluation.md says what each row means.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import check_seed
from servoid.tools.evaluate.runner import Options, evaluate
from servoid.tools.evaluate.spec import Row, select
from servoid.tools.evaluate.summary import Measured, table
from servoid.tools.evaluate.table import LEFT_OUT, ROWS
from servoid.tools.evaluate.write import HEAD, as_csv, cells, markdown

QUICK_EPISODES = 2
QUICK_MINUTES = 9.0  # one more is for the start and for drawing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="few episodes of the main rows, in under 10 minutes")
    parser.add_argument(
        "--rows",
        nargs="+",
        default=[],
        metavar="NAME",
        help="only these; patterns such as 'uniphys/goal-*' or '*@virtual'",
    )
    parser.add_argument("--list", action="store_true", help="list the names of the rows, and do nothing")
    parser.add_argument("--policy", default="diffusion", help="name or file as in `run` (default: %(default)s)")
    parser.add_argument("--robot", default="op3", help="name or file (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/papers"), help="folder (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one a core)")
    parser.add_argument("--episodes", type=int, help="episodes of each row (default: its own number, 100 for most)")
    parser.add_argument("--seconds", type=float, help="end each episode then, for a try: figures mean little")
    parser.add_argument(
        "--minutes", type=float, help="stop after so many; the same command goes on. 0: print what was done"
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random (default: %(default)s)")
    parser.add_argument("--fresh", action="store_true", help="do all episodes anew")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Evaluate and write; returns 0 when done, whatever the figures. Raises ConfigError."""
    with reporting(args.json) as report:
        _check(args)
        rows = select(ROWS, args.rows, args.quick)
        if args.list:
            report.table(("name", "paper", "row"), [(row.name, row.paper, row.title) for row in rows])
            report.result({"rows": [row.name for row in rows]})
            return 0
        begun = time.monotonic()
        options = Options(
            out=args.out,
            policy=args.policy,
            robot=args.robot,
            seed=args.seed,
            episodes=args.episodes or (QUICK_EPISODES if args.quick else None),
            seconds=args.seconds,
            workers=args.workers,
            minutes=QUICK_MINUTES if args.quick and args.minutes is None else args.minutes,
            quick=args.quick,
            fresh=args.fresh,
        )
        measured = evaluate(rows, options, report.line)
        lines = table(rows, measured)
        encoder = encoder_accuracy() if any(row.run.task == "text" for row in rows) else None
        _print(report, lines, encoder)
        _write(options, rows, measured, lines, encoder, report)
        report.result(
            {
                "policy": args.policy,
                "robot": args.robot,
                "seed": args.seed,
                "quick": args.quick,
                "rows": lines,
                "text_encoder": encoder,
                "left_out": LEFT_OUT,
                "out": args.out,
                "wall_seconds": time.monotonic() - begun,
            }
        )
    return 0


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


def _check(args: argparse.Namespace) -> None:
    for name in ("episodes", "seconds"):
        value = getattr(args, name)
        if value is not None and value <= 0:
            raise ConfigError(f"--{name}: must be positive, not {value:g}")
    if args.minutes is not None and args.minutes < 0:
        raise ConfigError(f"--minutes: must not be negative, not {args.minutes:g}")
    if args.minutes == 0 and args.fresh:
        raise ConfigError("--fresh forgets what --minutes 0 would tell: leave out one of them")
    if args.workers < 0:
        raise ConfigError(f"--workers: {args.workers} is not a number of processes; give 0 for one a core")
    check_seed(args.seed)


def _print(report: Report, lines: Sequence[Mapping[str, Any]], encoder: Mapping[str, Any] | None) -> None:
    report.table(HEAD, [cells(line) for line in lines])
    for text in _below(encoder):
        report.line(text)


def _below(encoder: Mapping[str, Any] | None) -> list[str]:
    if encoder is None:
        return list(LEFT_OUT)
    low, high = encoder["ci95"]
    share = f"{encoder['accuracy']:.3g} ({low:.3g} to {high:.3g})"
    return [f"Text encoder alone: {share} of {encoder['phrasings']} held-out phrasings read rightly.", *LEFT_OUT]


def _write(
    options: Options,
    rows: Sequence[Row],
    measured: Mapping[str, Measured],
    lines: Sequence[Mapping[str, Any]],
    encoder: Mapping[str, Any] | None,
    report: Report,
) -> None:
    """Markdown, CSV and the paths, where anything was measured: an empty page would replace one that is not.

    Raises ConfigError.
    """
    from servoid.stack.control.policies import policy_fingerprint

    if not any(result.records for result in measured.values()):
        report.line(f"nothing was measured: no page is written in {options.out}")
        return
    commits = sorted({str(record["commit"]) for result in measured.values() for record in result.records})
    facts = [
        f"policy: {options.policy}, checkpoint {policy_fingerprint(options.policy)['checkpoint_sha256']}",
        f"robot: {options.robot}; seed: {options.seed}; code: {', '.join(commits) or 'none ran'}",
        "judged by the simulation's truth; intervals: Wilson for shares, bootstrap for means",
    ]
    if options.seconds is not None:
        facts.append(f"episodes were cut to {options.seconds:g} s: for a try, not to be compared")
    if options.quick:
        facts.append("quick: few episodes, so wide intervals; those of velocity control have 7 velocities and not 21")
    pictures = _draw(options.out, rows, measured, report)
    below = [*(f"- {text}" for text in _below(encoder)), "", *(f"![{path.stem}]({path.name})" for path in pictures)]
    for name, text in (("papers.md", markdown("Papers", facts, lines, below)), ("papers.csv", as_csv(lines))):
        path = options.out / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written ({error.strerror}): choose another --out") from None
        report.line(str(path))


def _draw(out: Path, rows: Sequence[Row], measured: Mapping[str, Measured], report: Report) -> list[Path]:
    """A picture of each run that went anywhere, once where rows share it."""
    from servoid.tools.evaluate.plots import draw_paths

    pictures: list[Path] = []
    drawn: list[Measured] = []
    for row in rows:
        records = measured[row.name].records
        if not records or any(measured[row.name] is other for other in drawn):
            continue
        drawn.append(measured[row.name])
        path = out / f"paths-{row.name.replace('/', '-')}.png"
        try:
            draw_paths(records, row.title, path)
        except ModuleNotFoundError as error:
            report.line(f"no pictures: {error}; `pip install 'servoid[video]'` brings what draws them")
            return []
        pictures.append(path)
    return pictures
