"""The rows of `servoid evaluate papers`: what UniPhys and Diffuse-CLoC publish, and the same tasks here.

Lengths are scaled by 0.275, times and speeds by 0.524. docs/evaluation.md says how each row compares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from tools.evaluate.rows import Beside, Metric, Network, Row, Run

UNIPHYS, CLOC, OURS = "UniPhys", "Diffuse-CLoC", "Servoid"

SUCCESS = Metric("success", share=True)
FALLS = Metric("fell", share=True, lower=True)
LENGTH = Metric("ticks", "ticks")

# How plans are sampled, by the papers' names: settings of the diffusion policy.
_STABLE = {"stabilise": "3"}
FULL: Mapping[str, str] = {"schedule": "full_sequence", **_STABLE}
AUTOREGRESSIVE: Mapping[str, str] = {"schedule": "autoregressive", **_STABLE}
UNSTABLE: Mapping[str, str] = {"schedule": "autoregressive", "stabilise": "0"}
GRADUAL: Mapping[str, str] = {"schedule": "gradual", **_STABLE}
# As in configs/policies/diffuse_cloc.yaml; a level of 20, pure noise, is no rolling.
ROLLING: Mapping[str, str] = {"schedule": "rolling", "steps": "3", "delay": "1", "replan": "1"}


def _survive(name: str, title: str, plan: Mapping[str, str], published: float, figure: float | None) -> Row:
    run = Run("survive", plan=plan)
    return Row(f"uniphys/{name}", UNIPHYS, title, run, LENGTH, published, "of 3000 frames", figure)


def _trained(row: Row, train: str | None, name: str | None = None) -> Row:
    """The row with a network of its own, trained for 45 minutes, as the reference that it is compared with."""
    network = Network(
        name or row.name.replace("/", "-"), None if train is None else f"--minutes 45 --width 128 {train}"
    )
    return replace(row, run=replace(row.run, network=network), quick=False)


def _forest(name: str, title: str, published: float, train: str, plan: Mapping[str, str] | None = None) -> Row:
    run = Run("forest", plan=plan or {})
    return _trained(Row(f"cloc/{name}", CLOC, f"Forest, {title}: success", run, SUCCESS, published), train)


_FOREST = Run("forest")
_INBETWEEN = Run("inbetween", clips=6)
_TEXT = Run("text")
_TEXT_EXPERT = Run("text", policy="expert")

_MAIN: tuple[Row, ...] = (
    _survive("length", "Episode length, unconditional: autoregressive + stabilisation", AUTOREGRESSIVE, 2320.3, 2850),
    Row("uniphys/goal-near", UNIPHYS, "Goal, near: success", Run("goal-near"), SUCCESS, 1.0, figure=1.0),
    Row("uniphys/goal-far", UNIPHYS, "Goal, far: success", Run("goal-far"), SUCCESS, 0.95, figure=0.95),
    Row(
        "uniphys/velocity", UNIPHYS, "Velocity control: error", Run("velocity", quick_seconds=61.0),
        Metric("metrics.velocity_error_mps", "m/s", lower=True), 0.07, figure=0.04,
    ),
    Row(
        "uniphys/obstacle", UNIPHYS, "Dynamic obstacle: success", Run("obstacle", episodes=50), SUCCESS, 0.94,
        figure=0.94,
    ),
    Row("cloc/perturb", CLOC, "Walk + perturb: falls", Run("perturb"), FALLS, 0.16, figure=0.16),
    Row("cloc/forest", CLOC, "Forest: success", _FOREST, SUCCESS, 0.96, figure=0.96),
    Row("cloc/inbetween", CLOC, "In-betweening: falls", _INBETWEEN, FALLS, 0.31, figure=0.31),
)  # fmt: skip

_BESIDE: tuple[Row, ...] = (
    Row(
        "cloc/perturb-expert", CLOC, "Walk + perturb: falls, the expert", Run("perturb", policy="expert"), FALLS,
        note="beside the policy",
    ),
    Row(
        "cloc/forest-seconds", CLOC, "Forest: time", _FOREST,
        Metric("metrics.seconds_to_goal", "s", lower=True), 13.23, "s of a human", 6.9, note="of those that got there",
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
    *(
        Row(
            f"uniphys/monte-carlo-{n}", UNIPHYS, f"Monte-Carlo guidance, N = {n}: success",
            Run("goal-far", plan={"guidance.samples": str(n)}), SUCCESS, share,
        )
        for n, share in ((1, 0.26), (3, 0.82), (5, 0.98))
    ),
    *(
        Row(
            f"uniphys/best-of-{n}", UNIPHYS, f"Guidance, the best of N = {n}: success",
            Run("goal-far", plan={"guidance.samples": str(n), "guidance.choose": "best"}), SUCCESS,
            quick=False, note="not in the paper's table",
        )
        for n in (3, 5)
    ),
    *(
        Row(
            f"cloc/rolling-{name}", CLOC, f"Forest, rolling of {title}: success",
            Run("forest", plan={**ROLLING, **plan}), SUCCESS, share,
        )
        for name, title, plan, share in (
            ("both", "states and actions", {}, 0.96),
            ("states", "states only", {"rolling.action_level": "20"}, 0.79),
            ("actions", "actions only", {"rolling.state_level": "20"}, 0.96),
            ("none", "neither", {"rolling.state_level": "20", "rolling.action_level": "20"}, 0.95),
        )
    ),
    *(
        Row(
            f"cloc/executed-{n}", CLOC, f"Forest, actions executed of a plan: {n}",
            Run("forest", plan={"delay": "0", "replan": str(n)}), SUCCESS, quick=False,
            note="not in the paper's table",
        )
        for n in (1, 4, 8, 16)
    ),
    Row("cloc/horizon-16", CLOC, "Forest, horizon 16: success", Run("forest", plan={"horizon": "16"}), SUCCESS, 0.0),
)  # fmt: skip

_SHORT = "--horizon 32 --near-actions 16 --far-actions 0"  # Diffuse-CLoC's: 32 states ahead and 16 actions
_ONE = {"delay": "0", "replan": "1"}  # the first action of each plan, the only one that all of them have

_TRAINED: tuple[Row, ...] = (
    _forest("reference", "the reference of the rows below, horizon 32 and 16 actions", 0.96, _SHORT),
    _forest("horizon-64", "horizon 64 and 16 actions", 0.19, _SHORT.replace("32", "64")),
    *(
        _forest(f"actions-{n}", f"horizon 32 and {n} actions", share, _SHORT.replace("16", str(n)), _ONE)
        for n, share in ((1, 0.57), (4, 0.84), (8, 0.80), (16, 0.96))
    ),
    _forest("attention-full", "full attention", 0.58, f"{_SHORT} --mask full"),
    _forest("attention-diffuser", "Diffuser's attention", 0.0, f"{_SHORT} --mask diffuser_local"),
    _trained(
        _survive("raw-action", "Episode length, causal attention, raw action", AUTOREGRESSIVE, 238.2, None),
        "--horizon 32 --mask causal",
    ),
    _trained(
        _survive("raw-action-unstable", "Episode length, raw action, without stabilisation", UNSTABLE, 58.0, None),
        "--horizon 32 --mask causal",
        "uniphys-raw-action",
    ),
    _trained(_survive("latent-action", "Episode length, latent action", AUTOREGRESSIVE, 2320.3, None), None),
)

_TEXTS: tuple[Row, ...] = (
    Row(
        "text/followed", OURS, "Text, held-out phrasings: instructions followed", _TEXT,
        Metric("metrics.followed_share"), figure=0.95,
    ),
    Row("text/falls", OURS, "Text, held-out phrasings: falls", _TEXT, FALLS, figure=0.05),
)  # fmt: skip

_MOTION: tuple[Row, ...] = tuple(
    row
    for name, title, of, unit, published, theirs in (
        ("floating", "Floating", "motion.floating_mm", "mm", 16.6, "mm of a human"),
        ("jerk", "Jerk", "motion.jerk_mps3", "m/s3", 1.2, "mm/s3, as printed"),
        ("foot-slip", "Foot slip", "motion.foot_slip_mmps", "mm/s", None, None),
    )
    for row in (
        Row(
            f"motion/{name}", UNIPHYS, f"{title}, told in words", _TEXT, Metric(of, unit, lower=True), published,
            theirs, Beside(f"motion/{name}-expert", 1.2),
        ),
        Row(
            f"motion/{name}-expert", UNIPHYS, f"{title}, the expert", _TEXT_EXPERT, Metric(of, unit, lower=True),
            note="beside the policy",
        ),
    )
)  # fmt: skip


def _elsewhere(row: Row, where: str, run: Run) -> Row:
    """The same row on another body, where no figure was set."""
    return replace(row, name=f"{row.name}@{where}", title=f"{row.title} ({where})", run=run, figure=None, quick=False)


ON_VIRTUAL = ("uniphys/length", "uniphys/goal-near", "cloc/perturb", "cloc/forest")

ROWS: tuple[Row, ...] = (
    *_MAIN,
    *_BESIDE,
    *_SAMPLING,
    *_TRAINED,
    *_TEXTS,
    *_MOTION,
    *(_elsewhere(row, "randomised", replace(row.run, randomise=True)) for row in _MAIN),
    *(_elsewhere(row, "virtual", replace(row.run, backend="virtual")) for row in _MAIN if row.name in ON_VIRTUAL),
)

LEFT_OUT = (
    "Diffuse-CLoC: Jump (71 %) is left out: jumping is beyond the torque of these servos.",
    "Diffuse-CLoC: FID (0.074) is left out: it compares with motion capture, of which there is none here.",
    "UniPhys: user studies and jogging are left out: nobody was asked, and these servos do not run.",
)
