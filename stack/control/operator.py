"""What a person steers with: a gamepad, or the keys of a terminal. Neither needs a display."""

from __future__ import annotations

import atexit
import contextlib
import os
import select
import sys
import termios
import tty
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array

DEAD_ZONE = 0.1  # of a stick's way: worn ones do not come back to the middle
FORWARD_AXIS, LEFT_AXIS, TURN_AXIS = 1, 0, 3  # of the usual two-stick pads; up and left are negative
END_BUTTON = 1
KEYS_HELP = "keys: w/s forward/back, a/d turn, q/e sideways, space stops, x ends"
_STEP = 0.2  # of the whole way, by which a key changes the wish
_KEYS = {
    "w": (0, _STEP), "s": (0, -_STEP), "q": (1, _STEP), "e": (1, -_STEP), "a": (2, _STEP), "d": (2, -_STEP),
    "\x1b[A": (0, _STEP), "\x1b[B": (0, -_STEP), "\x1b[D": (2, _STEP), "\x1b[C": (2, -_STEP),
}  # fmt: skip


@dataclass(frozen=True)
class SteeringInput:
    """What the person wants now. `way` is `(3,)` in -1..1: forward, to the left, turning left."""

    way: Array
    ends: bool = False


class Steering(Protocol):
    """A device to steer with."""

    def read(self) -> SteeringInput:
        """Never waits."""
        ...

    def close(self) -> None: ...


class Gamepad:
    """The first gamepad. One that is unplugged asks to stand, until it is back."""

    def __init__(self) -> None:
        """Raises ConfigError without pygame or without a gamepad."""
        # A robot's PC has no display, and a pad shall be heard although no window has the focus.
        if not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
            os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ModuleNotFoundError:
            raise ConfigError("a gamepad needs the 'steer' extra: pip install 'servoid[steer]'") from None
        self._pygame = pygame
        pygame.display.init()
        pygame.joystick.init()
        self._pad: Any = None
        self._find()
        if self._pad is None:
            raise ConfigError("no gamepad is connected: plug one in, or steer by keys with --set device=keyboard")

    def read(self) -> SteeringInput:
        for event in self._pygame.event.get():
            if event.type == self._pygame.JOYDEVICEREMOVED and self._pad is not None:
                self._pad = None
            elif event.type == self._pygame.JOYDEVICEADDED:
                self._find()
        if self._pad is None:
            return SteeringInput(np.zeros(3))
        return SteeringInput(
            np.array([self._axis(FORWARD_AXIS), self._axis(LEFT_AXIS), self._axis(TURN_AXIS)]),
            self._pad.get_numbuttons() > END_BUTTON and bool(self._pad.get_button(END_BUTTON)),
        )

    def close(self) -> None:
        self._pad = None
        self._pygame.joystick.quit()
        self._pygame.display.quit()

    def _find(self) -> None:
        if self._pad is None and self._pygame.joystick.get_count():
            self._pad = self._pygame.joystick.Joystick(0)

    def _axis(self, number: int) -> float:
        """Where a stick is, forward and left being positive, beyond its dead zone."""
        if number >= self._pad.get_numaxes():
            return 0.0
        value = -float(self._pad.get_axis(number))
        beyond = max(abs(value) - DEAD_ZONE, 0.0) / (1.0 - DEAD_ZONE)
        return float(np.copysign(min(beyond, 1.0), value))


class Keyboard:
    """The keys of a terminal. What was pressed stays wished for, until space."""

    def __init__(self, fd: int | None = None) -> None:
        """`fd` is the terminal, standard input by default. Tells the keys. Raises ConfigError where it is none."""
        self._fd = sys.stdin.fileno() if fd is None else fd
        if not os.isatty(self._fd):
            raise ConfigError("the keyboard can only be read in a terminal: start the command in one, or use a gamepad")
        self._before: Any = termios.tcgetattr(self._fd)
        atexit.register(self.close)  # however the program ends: a terminal that does not echo is a nuisance
        tty.setcbreak(self._fd)  # Ctrl-C still interrupts
        termios.tcflush(self._fd, termios.TCIFLUSH)  # keys that were meant for something else
        self._way, self._ends = np.zeros(3), False
        print(KEYS_HELP, file=sys.stderr, flush=True)

    def read(self) -> SteeringInput:
        while select.select([self._fd], [], [], 0.0)[0]:
            try:
                pressed = os.read(self._fd, 64).decode("ascii", "ignore")
            except OSError:  # a terminal that was closed
                pressed = ""
            if not pressed:  # nobody steers any more
                self._way, self._ends = np.zeros(3), True
                break
            self._press(pressed)
        return SteeringInput(self._way.copy(), self._ends)

    def close(self) -> None:
        """Leave the terminal as it was. May be called twice."""
        if self._before is not None:
            with contextlib.suppress(termios.error):  # the terminal is gone, and needs nothing any more
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._before = None

    def _press(self, pressed: str) -> None:
        while pressed:
            key = pressed[:3] if pressed.startswith("\x1b[") else pressed[0]
            pressed = pressed[len(key) :]
            if key == " ":
                self._way = np.zeros(3)
            elif key == "x":
                self._ends = True
            elif key in _KEYS:
                part, change = _KEYS[key]
                self._way[part] = np.clip(self._way[part] + change, -1.0, 1.0)


def open_steering(device: str) -> Steering:
    """The device of that kind: gamepad, keyboard, or auto for the first that is there. Raises ConfigError."""
    if device == "keyboard":
        return Keyboard()
    try:
        return Gamepad()
    except ConfigError:
        if device == "auto" and sys.stdin.isatty():
            return Keyboard()
        raise
