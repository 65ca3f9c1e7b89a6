"""Check clips: joint ranges and speeds, and whether feet that carry the robot float, sink in or slide."""

from __future__ import annotations

import argparse

from servoid.tools.common.exit_codes import DONE, FAILED
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, clip_of, open_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "clips", nargs="*", metavar="CLIP", help="name in the library, or file (default: the whole library)"
    )
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    from servoid.tools.motions.checks import LIMITS, check

    with reporting(args.json) as report:
        names = args.clips or open_library(args).names
        found = []
        for name in names:
            clip, robot = clip_of(name, args)
            found.append({"clip": clip.name, **check(clip, robot)})
        keys = list(LIMITS)
        report.table(
            ("clip", *keys, "wrong"),
            [(row["clip"], *(f"{row[key]:.3g}" for key in keys), ", ".join(row["wrong"]) or "-") for row in found],
        )
        report.result({"clips": found})
    return FAILED if any(row["wrong"] for row in found) else DONE
