"""A run that is shown on the page, and may be stopped or steered from there."""

from __future__ import annotations

from dataclasses import replace

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Assignment
from servoid.hw.robot.description import load_robot
from servoid.stack.log.tick import Listener, TickRecord
from servoid.stack.runtime.operator import Operator
from servoid.stack.runtime.result import Result
from servoid.stack.runtime.run import Confirm, RunSettings, prepare, run
from servoid.stack.skills.skill import load_skills
from servoid.stack.tasks import find
from servoid.tools.common.exit_codes import explain
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.snapshot import RunInfo

_OUTCOMES = {
    "succeeded": "The task succeeded.",
    "failed": "The task failed.",
    "fell": "The robot fell.",
    "timed_out": "The time is over, and the task has not succeeded.",
    "stopped": "The guard stopped the run.",
    "interrupted": "A person stopped the run.",
}


def watched_run(
    link: PageLink,
    settings: RunSettings,
    *,
    on_tick: Listener | None = None,
    confirm: Confirm | None = None,
    held: bool | None = None,
) -> Result:
    """Do one run, shown on the page. `held`: somebody has to be heard there all the time; by default where the page
    steers. Raises what `run` raises; the page is told of it."""
    steered = check_steered(settings)
    try:
        assignment, body = prepare(settings)
        simulated = body.simulation is not None
        held = steered if held is None else held
        info = replace(_info(settings, assignment, simulated), steers=steered or held)
        link.begin(info, body.simulation.truth if body.simulation else None)

        def show(record: TickRecord) -> None:
            link(record)
            if on_tick is not None:
                on_tick(record)

        operator = Operator(link, held=held)
        result = run(settings, backend=body if simulated else None, on_tick=show, confirm=confirm, operator=operator)
    except BaseException as error:
        link.end("error", explain(error))
        raise
    link.end(result.outcome, _told(result))
    return result


def check_steered(settings: RunSettings) -> bool:
    """Whether the page steers a run's task. Raises ConfigError where something else shall, too."""
    steered = find(settings.task).cls.steered
    if steered and settings.set.get("device", "auto") != "auto":
        raise ConfigError(f"--set device={settings.set['device']}: with --view the page steers: leave one of them out")
    return steered


def _info(settings: RunSettings, assignment: Assignment, simulated: bool) -> RunInfo:
    episode, task = assignment.episode, assignment.task
    skills = load_skills(load_robot(settings.robot)) if task.steered and task.performs else {}
    scene = episode.scene
    return RunInfo(
        robot=settings.robot,
        title=task.name,
        backend=settings.backend,
        policy=settings.policy,
        simulated=simulated,
        goal=episode.goal,
        reach=episode.reach,
        path=episode.path,
        skills=tuple(skills),
        pillars=None if scene is None else len(scene.pillars),
    )


def _told(result: Result) -> str:
    """How a run went, in a line: with the criteria that were not met, and why it was stopped."""
    missed = "; ".join(str(criterion) for criterion in result.criteria if not criterion.met)
    causes = [event.text for event in result.events if event.kind not in ("phase", "plan", "derated", "system", "task")]
    why = missed if result.outcome in ("failed", "timed_out") else causes[0] if causes and not result.success else ""
    return _OUTCOMES[result.outcome] + (f" {why[0].upper()}{why[1:]}." if why else "")
