"""Draw the denoising matrices of docs/diffusion.md: `python -m servoid.tools.commands.draw_schedules [FOLDER]`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.schedule import DenoisingMatrix
from servoid.policy.diffusion.settings import Autoregressive, DiffusionSettings, Pyramid
from servoid.tools.common.pictures.panels import PLAN, new_figure, save_figure

NETWORK = DenoiserConfig(108, 20)  # 4 past and 16 future states, 20 noise levels
FOLDER = Path("docs/schedules")

# Picture to settings; with the rolling schedule one frame is new.
PICTURES = {
    "full_sequence": DiffusionSettings(steps=5, lead=1),
    "autoregressive": DiffusionSettings(schedule="autoregressive", steps=5, autoregressive=Autoregressive(block=4)),
    "pyramid": DiffusionSettings(schedule="pyramid", steps=5, pyramid=Pyramid(spread=5)),
    "trapezoid": DiffusionSettings(schedule="pyramid", steps=5, pyramid=Pyramid(spread=5, shape="trapezoid")),
    "rolling": DiffusionSettings(schedule="rolling", steps=3, execution_horizon=1, delay=1),
}


def matrix(name: str) -> DenoisingMatrix:
    """The matrix of a picture, with past states and past and committed actions held clean."""
    drawn = PICTURES[name].matrix(NETWORK, fresh=1)
    return drawn.hold(NETWORK.state_ticks <= 0, NETWORK.action_ticks < PICTURES[name].delay)


def draw(name: str, out: Path) -> None:
    """One picture: network calls from top to bottom, ticks from left to right, dark where there is noise."""
    rows = matrix(name)
    figure, both = new_figure(1, 2, (8.4, 0.9 + 0.16 * rows.calls))
    image: Any = None
    parts = (("states", rows.states, NETWORK.state_ticks), ("actions", rows.actions, NETWORK.action_ticks))
    for axes, (title, levels, ticks) in zip(both, parts, strict=True):
        box = (ticks[0] - 0.5, ticks[-1] + 0.5, rows.calls + 0.5, -0.5)
        image = axes.imshow(levels, cmap="Blues", vmin=0, vmax=NETWORK.levels, extent=box, aspect="auto")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("tick from now", fontsize=8)
        axes.set_xticks(np.arange(ticks[0], ticks[-1] + 1, 4))
        axes.tick_params(labelsize=7)
        known = 0.5 if title == "states" else PICTURES[name].delay - 0.5  # what is known lies to the left
        axes.axvline(known, color=PLAN, lw=1.0)
    figure.axes[0].set_ylabel("network calls", fontsize=8)
    figure.colorbar(image, ax=figure.axes, label="noise level").ax.tick_params(labelsize=7)
    save_figure(figure, out, dpi=80)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    for picture in PICTURES:
        draw(picture, folder / f"{picture}.png")
