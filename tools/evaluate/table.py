"""The rows of `servoid evaluate papers`: what UniPhys and Diffuse-CLoC publish, and the same tasks here.

Lengths are scaled by 0.275, times and speeds by 0.524. docs/evaluation.md says how each row compares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from servoid.tools.evaluate.spec import Beside, Metric, Network, Row, Run

UNIPHYS, CLOC, OURS = "UniPhys", "Diffuse-CLoC", "Servoid"

SUCCESS = Metric("success", share=True)
FALLS = Metric("fell", share=True, cut_short=True, lower=True)  # a robot that cannot go on has not stayed up
LENGTH = Metric("ticks", "ticks", unfinished="whole")
ERROR = Metric("metrics.velocity_error_mps", "m/s", lower=True, unfinished="whole")
SECONDS = Metric("metrics.seconds_to_goal", "s", lower=True, unfinished="left out")

# How plans are sampled, by the papers' names: settings of the diffusion policy.
# UniPhys stabilises with level 3 of 50, where noise has a deviation of 0.105 by the cosine schedule: level 1 of 20 has
# 0.089 and level 3 of 20 has 0.243. That is for text; under guidance it takes more, and does not say how much.
_STABLE = {"stabilization_level": "1"}
_CHUNKS = {"steps": "5", "execution_horizon": "4", "delay": "2"}  # as in configs/policies/uniphys.yaml
_AT_ONCE = {"lead": "0"}  # state and action of a frame, which are one token in UniPhys
FULL: Mapping[str, str] = {"schedule": "full_sequence", **_CHUNKS, **_AT_ONCE, **_STABLE}
AUTOREGRESSIVE: Mapping[str, str] = {"schedule": "autoregressive", **_CHUNKS, **_AT_ONCE, **_STABLE}
UNSTABLE: Mapping[str, str] = {"schedule": "autoregressive", **_CHUNKS, **_AT_ONCE, "stabilization_level": "0"}
GRADUAL: Mapping[str, str] = {"schedule": "pyramid", **_CHUNKS, **_AT_ONCE, **_STABLE}
# Actions come after the states that guidance moved.
GUIDED: Mapping[str, str] = {"schedule": "pyramid", **_CHUNKS, **_STABLE}
# As in configs/policies/diffuse_cloc.yaml; at a level of 20 nothing but a frame's noise goes over to the next plan.
_EVERY_TICK = {"delay": "1", "execution_horizon": "1"}
ROLLING: Mapping[str, str] = {"schedule": "rolling", "steps": "3", **_EVERY_TICK}
# No rolling: from pure noise, in steps about as long as the 3 that rolling needs for 14 of 20 levels.
ANEW: Mapping[str, str] = {"schedule": "full_sequence", "steps": "5", **_EVERY_TICK}


def _survive(name: str, title: str, plan: Mapping[str, str], published: float, figure: float | None) -> Row:
    run = Run("survive", plan=plan)
    return Row(f"uniphys/{name}", UNIPHYS, title, run, LENGTH, published, "of 3000 frames", figure)


# As many as 45 minutes allow on one busy core. Networks are compared after equal steps, whatever the machine had to do.
_STEPS = "--steps 15000"


def _trained(row: Row, train: str, name: str | None = None, latents: bool = False) -> Row:
    """The row with a network of its own, trained for as many steps as the reference that it is compared with."""
    network = Network(name or row.name.replace("/", "-"), f"{_STEPS} --width 128 {train}", latents)
    return replace(row, run=replace(row.run, network=network), quick=False)


def _forest(name: str, title: str, run: Run, success: float, seconds: float | None, note: str = "") -> tuple[Row, Row]:
    """Success in the forest, and the time of those that succeeded, with Diffuse-CLoC's (its table 2) of a human."""
    row = Row(f"cloc/{name}", CLOC, f"Forest, {title}: success", run, SUCCESS, success, quick=False, note=note)
    timed = replace(
        row, name=f"{row.name}-seconds", title=f"Forest, {title}: time", metric=SECONDS, published=seconds,
        published_unit="s of a human", note="of those that succeeded",
    )  # fmt: skip
    return row, timed


def _network(
    name: str, title: str, success: float, seconds: float | None, train: str, network: str | None = None
) -> tuple[Row, ...]:
    """The forest, and a walk of unknown robots under pushes, by one network of its own.

    As in the paper all of these roll states and actions, and execute the first action of each plan.
    """
    plan, network = {**ROLLING, "delay": "0"}, network or f"cloc-{name}"
    note = "the way is scripted, so that networks differ less than in the paper"
    perturb = Row(
        f"cloc/{name}-perturb", CLOC, f"Walk + perturb, {title}: fell or broken off (randomised)",
        Run("perturb", plan=plan, randomise=True), FALLS,
        note="not in the paper's table",
    )  # fmt: skip
    rows = *_forest(name, title, Run("forest", plan=plan), success, seconds, note), perturb
    return tuple(_trained(row, train, network) for row in rows)


def _scripted(alone: str) -> str:
    return f"a script asks for the velocity; {alone} goes without"


_FAR = Run("goal-far")
_VELOCITY = Run("velocity", quick_seconds=61.0)
# Guided by places, velocities or obstacles alone: by no twist that a script works out, and by no sentence.
_UNSCRIPTED = dict.fromkeys(("cost.velocity", "cost.yaw_rate", "cost.displacement", "cost.yaw", "cost.stand"), "0")
_ALONE = {**_UNSCRIPTED, "cost.goal": "1", "cost.facing": "0.5"}  # UniPhys, eq. 5
# Pillars and goal balance 0.35 m from a pillar: nearer, its arms touch them, and further off it finds no way between.
_AMONG_PILLARS = {**_UNSCRIPTED, "cost.goal": "1", "cost.repulsion": "2", "cost.sharpness": "8"}
# The gradient goes through the network, as in the papers: taken on the predicted states it moves the places alone,
# which the next call takes for noise, and the robot stands.
_UNTOLD = {"engine": "torch", "text_weight": "0", "guidance.gradient": "network", "guidance.weight": "3000"}

_FOREST = Run("forest")
_INBETWEEN = Run("inbetween", clips=6)
_TEXT = Run("text")

_MAIN: tuple[Row, ...] = (
    _survive("length", "Episode length, unconditional: autoregressive + stabilisation", AUTOREGRESSIVE, 2320.3, 2850),
    Row(
        "uniphys/goal-near", UNIPHYS, "Goal, near: success", Run("goal-near"), SUCCESS, 1.0, figure=1.0,
        note=_scripted("uniphys/goal-near-alone"),
    ),
    Row(
        "uniphys/goal-far", UNIPHYS, "Goal, far: success", _FAR, SUCCESS, 0.95, figure=0.95,
        note=_scripted("uniphys/monte-carlo-1"),
    ),
    Row(
        "uniphys/velocity", UNIPHYS, "Velocity control: error", _VELOCITY, ERROR, 0.07, figure=0.04,
        note="a script turns it to face the velocity; uniphys/velocity-alone goes without",
    ),
    Row(
        "uniphys/obstacle", UNIPHYS, "Dynamic obstacle: success", Run("obstacle", episodes=50), SUCCESS, 0.94,
        figure=0.94, note=_scripted("uniphys/obstacle-alone"),
    ),
    Row("cloc/perturb", CLOC, "Walk + perturb: fell or broken off", Run("perturb"), FALLS, 0.16, figure=0.16),
    Row(
        "cloc/forest", CLOC, "Forest: success", _FOREST, SUCCESS, 0.96, figure=0.96,
        note=_scripted("cloc/forest-alone"),
    ),
    Row("cloc/inbetween", CLOC, "In-betweening: fell or broken off", _INBETWEEN, FALLS, 0.31, figure=0.31),
)  # fmt: skip

_BESIDE: tuple[Row, ...] = (
    Row(
        "uniphys/length-distance", UNIPHYS, "Episode length, unconditional: distance walked", _MAIN[0].run,
        Metric("metrics.distance_m", "m"), note="a robot that stands lasts long too",
    ),
    Row(
        "cloc/perturb-expert", CLOC, "Walk + perturb: fell or broken off, the expert",
        Run("perturb", policy="expert"), FALLS, note="beside the policy",
    ),
    Row(
        "cloc/forest-seconds", CLOC, "Forest: time", _FOREST, SECONDS, 13.23, "s of a human", 6.9,
        note="of those that succeeded; 6.9 s would take 0.46 m/s, and the expert's top speed is 0.44",
    ),
    Row(
        "cloc/inbetween-mjpe", CLOC, "In-betweening: joints", _INBETWEEN,
        Metric("metrics.mjpe_m", "m", lower=True), 0.116, figure=0.032,
    ),
    Row(
        "cloc/inbetween-mrpe", CLOC, "In-betweening: base", _INBETWEEN,
        Metric("metrics.mrpe_m", "m", lower=True), 0.322, figure=0.089,
    ),
    Row(
        "cloc/cross", CLOC, "Three robots cross: success", Run("cross", episodes=50), SUCCESS, quick=False,
        note="the paper shows characters that avoid each other, and gives no figure",
    ),
)  # fmt: skip

_SAMPLING: tuple[Row, ...] = (
    _survive("length-gradual", "Episode length: gradual", GRADUAL, 1817.6, None),
    _survive("length-full-sequence", "Episode length: full-sequence", FULL, 231.6, None),
    _survive("length-unstable", "Episode length: autoregressive, without stabilisation", UNSTABLE, 148.2, None),
    Row(
        "uniphys/goal-near-alone", UNIPHYS, "Goal, near, by its distance alone: success",
        Run("goal-near", set=_ALONE, plan={**GUIDED, **_UNTOLD}), SUCCESS, 1.0, figure=1.0, quick=False,
    ),
    Row(
        "uniphys/velocity-alone", UNIPHYS, "Velocity control, by eq. 6 alone: error",
        replace(
            _VELOCITY, set={**_UNSCRIPTED, "cost.speed": "1", "cost.steering": "0.05", "cost.heading": "0.1"},
            plan={**GUIDED, **_UNTOLD},
        ),
        ERROR, 0.07, figure=0.04, quick=False,
    ),
    Row(
        "uniphys/obstacle-alone", UNIPHYS, "Dynamic obstacle, by eq. 7 alone: success",
        Run("obstacle", set={**_UNSCRIPTED, "cost.avoidance": "1"}, plan={**GUIDED, **_UNTOLD}, episodes=50),
        SUCCESS, 0.94, figure=0.94, quick=False,
    ),
    *(
        Row(
            f"uniphys/monte-carlo-{n}", UNIPHYS, f"Goal, far, by its distance alone, Monte-Carlo N = {n}: success",
            Run("goal-far", set=_ALONE, plan={**GUIDED, **_UNTOLD, "guidance.samples": str(n)}), SUCCESS, share,
        )
        for n, share in ((1, 0.26), (3, 0.82), (5, 0.98))
    ),
    *(
        Row(
            f"uniphys/best-of-{n}", UNIPHYS, f"The same, the best of N = {n}: success",
            Run(
                "goal-far", set=_ALONE,
                plan={**GUIDED, **_UNTOLD, "guidance.samples": str(n), "guidance.choose": "best"},
            ),
            SUCCESS, quick=False, note="not in the paper's table",
        )
        for n in (3, 5)
    ),
    Row(
        "cloc/forest-alone", CLOC, "Forest, by goal and pillars alone, rolling: success",
        Run("forest", set=_AMONG_PILLARS, plan={**ROLLING, **_STABLE, **_UNTOLD}), SUCCESS, 0.96, figure=0.96,
        quick=False,
    ),
    *(
        replace(row, quick=True)
        for name, title, plan, success, seconds, note in (
            ("both", "states and actions", ROLLING, 0.96, 13.23, ""),
            ("states", "states only", {**ROLLING, "rolling.action_level": "20"}, 0.79, 14.75, ""),
            ("actions", "actions only", {**ROLLING, "rolling.state_level": "20"}, 0.96, 10.62, ""),
            ("none", "neither", ANEW, 0.95, 10.72, "each plan from noise of its own, in 6 calls; the others take 4"),
        )
        for row in _forest(
            f"rolling-{name}", f"rolling of {title}", Run("forest", plan=plan), success, seconds, note
        )
    ),
    *(
        Row(
            f"cloc/executed-{n}", CLOC, f"Forest, actions executed of a plan: {n}",
            Run("forest", plan={"delay": "0", "execution_horizon": str(n)}), SUCCESS, quick=False,
            note="not in the paper's table",
        )
        for n in (1, 4, 8, 16)
    ),
)  # fmt: skip

# Diffuse-CLoC's: 32 states ahead and 16 actions, which all weigh the same. They run at no delay.
_SHORT = "--horizon 32 --actions 16 --near-actions 16 --committed 0"

# UniPhys's: windows of 32 frames, 4 of them past; all levels independent in training; no emphasis.
_CAUSAL = "--history 4 --horizon 28 --mask causal --forcing 1 --monotone 0 --emphasis 0"

_TRAINED: tuple[Row, ...] = (
    *_network("reference", "the reference of the rows below, horizon 32 and 16 actions", 0.96, 13.23, _SHORT),
    *_network("horizon-16", "horizon 16 and 16 actions", 0.0, None, _SHORT.replace("32", "16")),
    *_network("horizon-64", "horizon 64 and 16 actions", 0.19, 27.84, _SHORT.replace("32", "64")),
    *(
        row
        for n, success, seconds in ((1, 0.57, 21.83), (4, 0.84, 14.30), (8, 0.80, 13.14))
        for row in _network(
            f"actions-{n}", f"horizon 32 and {n} actions", success, seconds, _SHORT.replace("16", str(n))
        )
    ),
    *_network("actions-16", "horizon 32 and 16 actions", 0.96, 13.23, _SHORT, "cloc-reference"),
    *_network("attention-full", "full attention", 0.58, 15.08, f"{_SHORT} --mask full"),
    *_network("attention-diffuser", "Diffuser's attention", 0.0, None, f"{_SHORT} --mask diffuser_local"),
    _trained(
        _survive("raw-action", "Episode length, causal attention, raw action", AUTOREGRESSIVE, 238.2, None),
        _CAUSAL,
    ),
    _trained(
        _survive("raw-action-unstable", "Episode length, raw action, without stabilisation", UNSTABLE, 58.0, None),
        _CAUSAL,
        "uniphys-raw-action",
    ),
    _trained(
        _survive("latent-action", "Episode length, causal attention, latent action", AUTOREGRESSIVE, 2320.3, None),
        _CAUSAL,
        latents=True,
    ),
    _trained(
        _survive(
            "latent-action-unstable", "Episode length, latent action, without stabilisation", UNSTABLE, 148.2, None
        ),
        _CAUSAL,
        "uniphys-latent-action",
        latents=True,
    ),
)

_TEXTS: tuple[Row, ...] = (
    Row(
        "text/followed", OURS, "Text, held-out phrasings: instructions followed", _TEXT,
        Metric("metrics.followed_share", unfinished="whole"), figure=0.95,
    ),
    Row("text/falls", OURS, "Text, held-out phrasings: fell or broken off", _TEXT, FALLS, figure=0.05),
)  # fmt: skip


def _motion(name: str, title: str, run: Run, metric: Metric, published: float | None, unit: str | None) -> list[Row]:
    """How a run's motion was made, and beside it how the expert's was."""
    expert, quick, metric = replace(run, policy="expert"), run is _TEXT, replace(metric, lower=True)
    reach, note = Beside(f"motion/{name}-expert", 1.2), "beside the policy"
    return [
        Row(f"motion/{name}", UNIPHYS, title, run, metric, published, unit, reach, quick),
        Row(f"motion/{name}-expert", UNIPHYS, f"{title}, the expert", expert, metric, quick=quick, note=note),
    ]


_MOTION: tuple[Row, ...] = tuple(
    row
    for name, title, metric, published, theirs in (
        (
            "floating",
            "Floating",
            Metric("motion.floating_mm", "mm", resolution=0.001),
            (16.6, 16.78, 19.04),
            "mm of a human",
        ),
        ("jerk", "Jerk", Metric("motion.jerk_mps3", "m/s3"), (1.2, 1.5, 2.0), "mm/s3, as printed"),
        ("foot-slip", "Foot slip", Metric("motion.foot_slip_mmps", "mm/s"), (None,) * 3, None),
    )
    for row in (
        *_motion(name, f"{title}, told in words", _TEXT, metric, published[0], theirs),
        *_motion(f"{name}-goal-far", f"{title}, far goal", _FAR, metric, published[1], theirs),
        *_motion(f"{name}-velocity", f"{title}, velocity control", _VELOCITY, metric, published[2], theirs),
    )
)


def _elsewhere(row: Row, where: str, run: Run) -> Row:
    """The same row on another body or without the planner's delay, where no figure was set."""
    return replace(row, name=f"{row.name}@{where}", title=f"{row.title} ({where})", run=run, figure=None, quick=False)


_PUSHED = Run("perturb", randomise=True)  # the nominal robot seldom falls, whatever plans it

# What fewer or more network calls a plan come to, by what the robot does. One more call finishes the actions (`lead`).
_CALLS: tuple[Row, ...] = tuple(
    Row(
        f"calls/{name}-{steps + 1}", OURS, f"{title}, {steps + 1} network calls a plan",
        replace(run, plan={"schedule": "full_sequence", "lead": "1", "steps": str(steps)}), metric, quick=False,
    )
    for name, title, run, metric in (
        ("goal-far", "Goal, far: success", _FAR, SUCCESS),
        ("perturb", "Walk + perturb: fell or broken off (randomised)", _PUSHED, FALLS),
    )
    for steps in (1, 2, 3, 5, 10)
)  # fmt: skip

# And how often plans are made, how long after what they were made from they are adopted, and whether they are made of
# the plan that runs.
_PACE: tuple[Row, ...] = tuple(
    Row(
        f"pace/{name}", OURS, f"Walk + perturb: fell or broken off (randomised), {title}",
        replace(_PUSHED, plan=plan), FALLS, quick=False,
    )
    for name, title, plan in (
        *(
            (
                f"{replan}-{delay}", f"plans {replan} ticks apart and adopted after {delay}",
                {"execution_horizon": str(replan), "delay": str(delay)},
            )
            for replan, delay in ((4, 2), (4, 1), (4, 0), (2, 2), (2, 1), (1, 1))
        ),
        ("rolling", "rolling of states and actions", ROLLING),
    )
)  # fmt: skip

ON_VIRTUAL = ("uniphys/length", "uniphys/goal-near", "cloc/perturb", "cloc/forest")

ROWS: tuple[Row, ...] = (
    *_MAIN,
    *_BESIDE,
    *_SAMPLING,
    *_TRAINED,
    *_TEXTS,
    *_MOTION,
    *_CALLS,
    *_PACE,
    *(_elsewhere(row, "no-delay", replace(row.run, plan={**row.run.plan, "delay": "0"})) for row in _MAIN),
    *(_elsewhere(row, "randomised", replace(row.run, randomise=True)) for row in _MAIN),
    *(_elsewhere(row, "virtual", replace(row.run, backend="virtual")) for row in _MAIN if row.name in ON_VIRTUAL),
)

LEFT_OUT = (
    "The other methods of the papers' tables (CLoSD, MaskedMimic, Kin+PHC) are left out: they are not built here.",
    "Frames and plans per second are in `servoid bench policy`.",
    "UniPhys: maximal episode lengths (table 4) are left out: of runs that all end at 3000 they say nothing.",
    "Diffuse-CLoC: 1, 4 and 8 actions at horizons 16 and 64 (table 2) are left out: six networks more.",
    "Diffuse-CLoC: reaching, platforms and crawling are left out: no demonstration reaches, climbs or crawls.",
    "Diffuse-CLoC: Jump (71 %) is left out: jumping is beyond the torque of these servos.",
    "Diffuse-CLoC: FID (0.074) is left out: it compares with motion capture, of which there is none here.",
    "UniPhys: user studies and jogging are left out: nobody was asked, and these servos do not run.",
)
