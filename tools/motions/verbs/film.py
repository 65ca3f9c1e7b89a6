"""Film clips from two sides: a film (.mp4, .gif), or a strip of frames (.png).

The robot is told a clip's goals in physics and nothing else; --as-written shows the clip itself. Each clip becomes a
file in the folder --out, called as the clip.
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from servoid.hw.config import ConfigError
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, clip_of, open_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "clips", nargs="*", metavar="CLIP", help="name in the library, or file (default: the whole library)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures")
    parser.add_argument("--kind", choices=("mp4", "gif", "png"), default="png", help="film or strip (default: png)")
    parser.add_argument("--as-written", action="store_true", help="the clip's own motion, without physics")
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    with reporting(args.json) as report:
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {args.out}: cannot be created ({error.strerror})") from None
        from servoid.tools.common.pictures.drawing import choose_drawing

        if any(find_spec(name) is None for name in ("av", "PIL")):
            raise ConfigError("film: this needs the 'video' extra: pip install 'servoid[video]'")
        choose_drawing("film")  # before MuJoCo is imported, which a robot's file does
        from servoid.sim.render import RenderError
        from servoid.tools.motions.film import film

        made = []
        for name in args.clips or open_library(args).names:
            clip, robot = clip_of(name, args)
            path = args.out / f"{clip.name}.{args.kind}"
            try:
                film(clip, robot, path, in_physics=not args.as_written)
            except RenderError as error:
                raise ConfigError(str(error)) from error
            report.line(str(path))
            made.append(path)
        report.result({"files": made})
    return DONE
