"""Paths of a run's episodes from above, as a PNG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.tools.common.pictures.panels import GOAL, OBSTACLE, ROBOT, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAILED = "#c1403d"
PANELS = 12  # episodes that are drawn one by one, where each has a scene of its own


def draw_paths(records: Sequence[Mapping[str, Any]], title: str, out: Path) -> None:
    """Draw the paths by the truth: in one frame, or an episode a panel where there are obstacles.

    Raises ConfigError where the file cannot be written, ModuleNotFoundError without matplotlib.
    """
    alone = any(record["pillars"] or record["spheres"] or record.get("others") for record in records)
    groups = [[record] for record in records[:PANELS]] if alone else [list(records)]
    columns = min(len(groups), 4)
    lines = math.ceil(len(groups) / columns)
    figure, all_axes = new_figure(lines, columns, (3.4 * columns, 3.4 * lines) if alone else (6.4, 6.0))
    for axes, group in zip(all_axes, groups, strict=False):
        for record in group:
            _episode(axes, record, bare=len(group) > 1)
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
        if alone:
            axes.set_title(f"seed {group[0]['seed']}: {_verdict(group[0])}", fontsize=8)
    for axes in all_axes[len(groups) :]:
        axes.set_visible(False)
    succeeded = sum(record["success"] for record in records)
    figure.suptitle(f"{title}\n{succeeded} of {len(records)} succeeded (failed: red); m")
    save_figure(figure, out, dpi=100)


def _episode(axes: Axes, record: Mapping[str, Any], bare: bool) -> None:
    from matplotlib.patches import Circle

    for x, y, radius in record["pillars"]:
        axes.add_patch(Circle((x, y), radius, color=OBSTACLE))
    for sphere in record["spheres"]:
        x, y = zip(*sphere["path"], strict=True)
        axes.plot(x, y, color=OBSTACLE, linewidth=0.8, linestyle=":")
        axes.add_patch(Circle((x[-1], y[-1]), sphere["radius"], color=OBSTACLE, alpha=0.5))
    for path in record.get("others", ()):  # an episode that was kept before there were any has none
        axes.plot(*zip(*path, strict=True), color=OBSTACLE, linewidth=0.8)
    if record["path"]:
        x, y = zip(*record["path"], strict=True)
        colour = ROBOT if record["success"] else FAILED
        axes.plot(x, y, color=colour, linewidth=0.8 if bare else 1.4, alpha=0.6 if bare else 1.0)
        axes.plot(x[-1], y[-1], marker="x" if record["fell"] else ".", color=colour, markersize=5)
    if record["goal"] is not None:
        axes.plot(*record["goal"], marker="+", color=GOAL, markersize=8)


def _verdict(record: Mapping[str, Any]) -> str:
    return "succeeded" if record["success"] else "fell" if record["fell"] else "failed"
