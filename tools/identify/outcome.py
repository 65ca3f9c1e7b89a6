"""What a fit is told, written and drawn as."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Servo, save_servo
from servoid.tools.common.output import Report
from servoid.tools.identify.excitation import HELD_OUT
from servoid.tools.identify.figures import UNITS, slope
from servoid.tools.identify.fit import DETERMINED, Fit
from servoid.tools.identify.recording import Piece
from servoid.tools.identify.rehearsal import Candidate, Rehearsal

_COLUMNS, _PANEL = 5, (3.4, 2.1)  # of the picture; inches of one


def announce(fit: Fit, report: Report) -> None:
    """Say what was found, and what the data do not determine."""
    rows = []
    for found in fit.found:
        figure = found.figure
        known = "" if found.determined else "not determined"
        spread = f"+-{100 * found.spread:.1f} %"
        label = "slope (back-EMF and damping)" if figure.name == "slope" else figure.name.replace("_", " ")
        rows.append(
            (
                figure.servo or "supply",
                label,
                f"{figure.start:.4g}",
                f"{found.value:.4g}",
                UNITS[figure.name],
                spread,
                known,
            )
        )
    report.table(("servo", "figure", "file", "identified", "unit", "spread", ""), rows)
    report.line(
        f"friction: {fit.model}. Off by {math.degrees(fit.error):.3f} degrees RMS on the motions that it was fitted "
        f"on, {math.degrees(fit.held_out):.3f} on {HELD_OUT} that it was not."
    )
    report.line(
        f"Not determined: spread above {100 * DETERMINED:.0f} %; such a figure stays near its file's. Never determined "
        "by such motions: how the slope divides into back-EMF and damping, which is as in the file, and how the delay "
        "divides into command_delay and position_latency, of which the second is the file's."
    )
    if fit.held_out > math.radians(0.3):
        report.line(
            "More than 0.3 degrees off: is the base held still, do the limbs hang free, are masses and loads right, "
            "has a gear play?"
        )
    limit = fit.figures.robot.limits.joint_speed
    slow = [servo for servo in fit.figures.of_joints(fit.point)[0] if servo.no_load_speed < limit]
    if slow:
        report.line(
            f"limits.joint_speed ({limit:g} rad/s) is more than a joint can: set it to "
            f"{math.floor(100 * min(servo.no_load_speed for servo in slow)) / 100:g} at most"
        )


def write(fit: Fit, pieces: Sequence[Piece], out: Path, report: Report) -> list[Path]:
    """Write each servo's file and the picture. Raises ConfigError where they cannot be written."""
    robot = fit.figures.robot
    files = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, servo in fit.servos.items():
            path = out / f"{name}.yaml"
            save_servo(servo, path, _head(fit, name, servo))
            files.append(path)
            report.line(f"written: {path}; for it to be used, name it as `servo` of the joints in {robot.name}'s file")
        picture = out / "identified.png"
        try:
            _draw(fit, pieces, picture)
        except ModuleNotFoundError:
            report.line("no picture: drawing needs the 'video' extra: pip install 'servoid[video]'")
        else:
            files.append(picture)
            report.line(f"measured against simulated: {picture}")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}): choose another place with --out") from None
    return files


def _head(fit: Fit, name: str, servo: Servo) -> str:
    """Comment lines of a servo's file."""
    unknown = [found.figure.name for found in fit.found if found.figure.servo == name and not found.determined]
    rest = f"Not determined, and near what was there before: {', '.join(unknown)}." if unknown else ""
    text = (
        f"{name}, identified on {fit.figures.robot.name} by `servoid identify`: {math.degrees(fit.held_out):.3f} "
        f"degrees RMS off on motions that it was not fitted on. Torque falls by {slope(servo):.3f} N m s/rad with "
        f"speed, of which damping is a guess. {rest}"
    )
    return "".join(f"# {line}\n" for line in wrap(text, 118))


def _draw(fit: Fit, pieces: Sequence[Piece], path: Path) -> None:
    """Measured and simulated angles of every joint that moved, in the motions that nothing was fitted on."""
    from servoid.tools.common.pictures.panels import PLAN, ROBOT, new_figure, save_figure

    robot = fit.figures.robot
    shown = [piece for piece in pieces if piece.name == HELD_OUT] or list(pieces)
    angles = Rehearsal(robot, shown).angles([Candidate(*fit.figures.of_joints(fit.point))])
    moved = [i for i in range(len(robot.joints)) if any(np.ptp(piece.goal[:, i]) > 0.01 for piece in pieces)]
    rows = -(-len(moved) // _COLUMNS)
    figure, axes = new_figure(rows, _COLUMNS, (_COLUMNS * _PANEL[0], rows * _PANEL[1] + 0.4))
    for ax, i in zip(axes, moved, strict=False):
        # Of a joint that moved alone, the motions in which it did.
        its = [k for k, piece in enumerate(shown) if np.ptp(piece.goal[:, i]) > 0.01]
        begin, off = 0.0, []
        for k in its:
            piece, went = shown[k], angles[k][0][:, i]
            seconds = begin + np.arange(len(went)) * robot.dt
            ax.plot(seconds, piece.goal[:, i], color="0.7", lw=0.8, label="asked" if k == its[0] else None)
            ax.plot(seconds, piece.measured[:, i], color=ROBOT, lw=1.4, label="measured" if k == its[0] else None)
            ax.plot(seconds, went, color=PLAN, lw=0.9, ls="--", label="simulated" if k == its[0] else None)
            off.append(went - piece.measured[:, i])
            begin = float(seconds[-1]) + 0.5
        ax.set_title(f"{robot.names[i]}: {math.degrees(_rms(np.concatenate(off))):.2f} degrees off", fontsize=8)
        ax.tick_params(labelsize=7)
    for ax in axes[len(moved) :]:
        ax.set_axis_off()
    axes[0].legend(fontsize=6)
    figure.suptitle(f"{robot.name}, {HELD_OUT}: rad over s", fontsize=9)
    save_figure(figure, path)


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.nanmean(np.square(errors))))
