"""List the clips of a library: length, first and last pose, and licence."""

from __future__ import annotations

import argparse

from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, open_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        library = open_library(args)
        clips = [library[name] for name in library.names]
        rows = [
            (
                clip.name,
                f"{clip.ticks * library.robot.dt:.1f} s",
                clip.about.begins + ("" if clip.about.ends == clip.about.begins else f" -> {clip.about.ends}"),
                clip.about.licence,
                clip.about.captions[0],
            )
            for clip in clips
        ]
        report.table(("clip", "length", "pose", "licence", "caption"), rows)
        report.result(
            {
                "library": library.folder,
                "clips": [
                    {
                        "name": clip.name,
                        "seconds": clip.ticks * library.robot.dt,
                        "begins": clip.about.begins,
                        "ends": clip.about.ends,
                        "loop": clip.about.loop,
                        "captions": list(clip.about.captions),
                        "licence": clip.about.licence,
                        "source": clip.about.source,
                        "mirror": clip.about.mirror,
                    }
                    for clip in clips
                ],
            }
        )
    return DONE
