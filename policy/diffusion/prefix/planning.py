"""How plans are made and when, as settings. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned

HIGHEST = 2.2  # of the base's height at home: no hand of an OP3 comes higher than that, however its joints are


@dataclass(frozen=True, kw_only=True)
class Planning:
    """How plans are made. Frames are 25 a second, ticks those of the control loop."""

    frames: int = 40  # from one plan to the next: a shorter or longer loop than the network's own is 20 or 80
    delay: int = 4  # ticks from a request to the adoption of its plan
    feedback: bool = True  # plans go on from what was executed; False: from the plan before (open loop)
    steps: int = 0  # of denoising; 0: as many as the network has noise levels
    text_weight: float = 2.5  # of classifier-free guidance by the sentence; 0: unread, 1: as trained
    text_nearest: bool = True  # a sentence is read as the nearest one of the training; False: word by word
    reach: float = 0.33  # m that a goal is asked for ahead at most, within one plan
    turn: float = 1.2  # rad that a heading is asked for away at most, within one plan

    def __post_init__(self) -> None:
        if self.frames < 1 or self.delay < 0 or self.steps < 0:
            raise ValueError("frames must be at least 1, and delay and steps must not be negative")
        if self.text_weight < 0 or min(self.reach, self.turn) <= 0:
            raise ValueError("text_weight must not be negative, and reach and turn must be positive")


def led(velocity: Array, seconds: float) -> tuple[Array, Array]:
    """Where velocities `(..., 3)` m/s, m/s and rad/s lead to in so many seconds, along an arc: places `(..., 2)` m in
    the heading frame of the beginning, and turns `(...,)` rad."""
    angle = velocity[..., 2] * seconds
    chord = velocity[..., :2] * (seconds * np.sinc(angle / (2 * np.pi)))[..., None]
    return turned(chord, angle / 2), angle


def history_ticks(prefix: int, stride: int) -> int:
    """Ticks of states that hold so many frames, of `stride` ticks each, and the one before them."""
    return prefix * stride + 1


def check(planning: Planning, stride: int, levels: int) -> list[str]:
    """What is wrong with settings, for frames of `stride` ticks and a network of so many noise levels, in words."""
    wrong, most = [], planning.frames * stride
    if planning.delay % stride:
        wrong.append(f"delay must be a multiple of the {stride} ticks of a frame, not {planning.delay}")
    if planning.delay > most:
        wrong.append(f"delay must be at most the {most} ticks from one plan to the next, not {planning.delay}")
    if planning.steps > levels:
        wrong.append(f"steps must be at most the network's {levels} noise levels, not {planning.steps}")
    return wrong
