"""List the skills, or explain one: what it does, the words that ask for it, and what must be true after it.

`servoid run skill --set name=SKILL` performs one.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from servoid.hw.robot.description import load_robot
from servoid.stack.skills.skill import Skill, chosen, load_skills
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("skill", nargs="?", metavar="SKILL", help="skill to explain")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError for an unknown skill, or one whose file is wrong."""
    with reporting(args.json) as report:
        skills = load_skills(load_robot(args.robot))
        if args.skill is not None:
            skills = {args.skill: chosen(args.skill, skills)}
            report.table(("what", "value"), _explained(skills[args.skill]))
        else:
            rows = [(name, f"{skill.seconds:.1f} s", _poses(skill), skill.about) for name, skill in skills.items()]
            report.table(("skill", "length", "pose", "what it does"), rows)
            report.line("servoid skills SKILL explains one; servoid run skill --set name=SKILL performs it")
        report.result({"skills": [asdict(skill) for skill in skills.values()]})
    return DONE


def _poses(skill: Skill) -> str:
    return skill.entry if skill.entry == skill.end else f"{skill.entry} -> {skill.end}"


def _explained(skill: Skill) -> list[tuple[str, str]]:
    after = skill.after
    return [
        ("skill", f"{skill.name}: {skill.about}"),
        ("length", f"{skill.seconds:.1f} s"),
        ("pose", _poses(skill)),
        ("performed by", f"{skill.policy} '{skill.clip}'"),
        ("interrupted by", skill.interrupted_by),
        ("may touch the ground", ", ".join(skill.contacts)),
        ("asked for by", "; ".join(skill.phrases)),
        ("must be true after it", f"{skill.end}, at rest, moved by at most {after.moved:g} m and {after.turned:g} rad"),
        ("", f"its joints at most {after.joints:g} rad off the motion, root mean square"),
    ]
