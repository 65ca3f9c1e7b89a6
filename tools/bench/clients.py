"""Check other people's clients against the virtual rig: whether it answers each of their verbs as servos do.

The verbs go through the official SDK, as in those clients, and in the rig's own time, so the result does not depend on
how busy this machine is. None of the clients' code is used.
"""

from __future__ import annotations

import argparse
from typing import Any

from servoid.hw.config import ConfigError, nearest
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--client", action="append", metavar="NAME", help="only this client; may be repeated")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    from servoid.tools.bench.client_verbs import CLIENTS

    with reporting(args.json) as report:
        for name in args.client or ():
            if name not in CLIENTS:
                raise ConfigError(f"--client '{name}': {nearest(name, CLIENTS)}")
        rows = measure(report, args.client or list(CLIENTS))
        failed = [row for row in rows if row["problem"] is not None]
        report.table(
            ("client", "verb", "instructions", "result"),
            [[row["client"], row["verb"], row["instructions"], row["problem"] or "passed"] for row in rows],
        )
        report.line(f"{len(rows) - len(failed)} of {len(rows)} verbs pass")
        report.result({"verbs": len(rows), "failed": len(failed), "rows": rows})
    return exit_codes.DONE


def measure(report: Report, names: list[str]) -> list[dict[str, Any]]:
    """A row for each verb, on a rig of its own."""
    from tqdm import tqdm

    from servoid.hw.robot.description import load_robot
    from servoid.tools.bench.client_verbs import CLIENTS
    from servoid.tools.bench.sdk_host import Refused, SdkHost

    robot = load_robot()
    rows = []
    jobs = [(name, *verb) for name in names for verb in CLIENTS[name]]
    for name, verb, factory_state, act in tqdm(jobs, unit="verb", mininterval=2.0):
        host, problem = SdkHost(robot, factory_state), None
        try:
            act(host)
        except Refused as error:
            problem = str(error)
        rows.append(
            {"client": name, "verb": verb, "instructions": host.rig.dispatcher.instructions, "problem": problem}
        )
    return rows
