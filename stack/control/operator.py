"""What a person steers with at this machine: a gamepad, or the keys of a terminal. Neither needs a display."""

from __future__ import annotations

import atexit
import contextlib
import os
import select
import sys
import termios
import tty
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.operator import CommandSource, Intent

DEAD_ZONE = 0.1  # of a stick's way: worn ones do not come back to the middle
FULL = 32767  # of a stick's way; up and left are negative
KEYS_HELP = "keys: w/s forward/back, a/d turn, q/e sideways, space stops, x ends"
_STEP = 0.2  # of the whole way, by which a key changes the wish
_KEYS = {
    "w": (0, _STEP), "s": (0, -_STEP), "q": (1, _STEP), "e": (1, -_STEP), "a": (2, _STEP), "d": (2, -_STEP),
    "\x1b[A": (0, _STEP), "\x1b[B": (0, -_STEP), "\x1b[D": (2, _STEP), "\x1b[C": (2, -_STEP),
}  # fmt: skip


@dataclass(frozen=True)
class Controls:
    """Which stick walks and which turns, by SDL's names of a controller's parts: leftx, lefty, rightx, righty; a, b ...

    SDL knows where they are on each kind of pad. By its number an axis may be a stick on one, and on another a trigger,
    which rests at its end.
    """

    forward: str = "lefty"
    left: str = "leftx"
    turn: str = "rightx"
    end: str = "b"


class Gamepad:
    """The first gamepad. Its sticks count once they have been in the middle, all at the same time: one that is held, or
    broken, moves nothing. A gamepad that is unplugged asks to stand, until it is back."""

    def __init__(self, controls: Controls | None = None) -> None:
        """Raises ConfigError without pygame, without a gamepad, and for one whose parts SDL has no names for."""
        # A robot's PC has no display, and a pad shall be heard although no window has the focus.
        if not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
            os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
            from pygame._sdl2 import controller
        except ModuleNotFoundError:
            raise ConfigError("a gamepad needs the 'steer' extra: pip install 'servoid[steer]'") from None
        self._pygame, self._sdl = pygame, controller
        controls = controls or Controls()
        named = (controls.forward, controls.left, controls.turn)
        self._axes = [getattr(pygame, f"CONTROLLER_AXIS_{name.upper()}") for name in named]
        self._end = getattr(pygame, f"CONTROLLER_BUTTON_{controls.end.upper()}")
        pygame.display.init()
        pygame.joystick.init()
        controller.init()
        self._pad: Any = None
        self._centred = self._told = False
        self._find()
        if self._pad is None and pygame.joystick.get_count():
            name = pygame.joystick.Joystick(0).get_name()
            raise ConfigError(
                f"the gamepad '{name}' is unknown to SDL: describe it in the environment variable "
                "SDL_GAMECONTROLLERCONFIG, or steer by keys with --set device=keyboard"
            )
        if self._pad is None:
            raise ConfigError("no gamepad is connected: plug one in, or steer by keys with --set device=keyboard")

    def read(self) -> Intent:
        self._pygame.event.get()  # lets SDL look at its devices
        if self._pad is not None and not self._pad.attached():
            self._pad = None
        if self._pad is None:
            self._find()
        if self._pad is None:
            return Intent()
        way = np.array([self._stick(axis) for axis in self._axes])
        self._centred = self._centred or not way.any()
        if not self._centred:
            if not self._told:
                print("let go of the gamepad's sticks: they count once they are in the middle", file=sys.stderr)
            self._told, way = True, np.zeros(3)
        return Intent(way=way, ends=bool(self._pad.get_button(self._end)))

    def close(self) -> None:
        self._pad = None
        self._sdl.quit()
        self._pygame.joystick.quit()
        self._pygame.display.quit()

    def _find(self) -> None:
        numbers = [i for i in range(self._sdl.get_count()) if self._sdl.is_controller(i)]
        if numbers:
            self._pad, self._centred, self._told = self._sdl.Controller(numbers[0]), False, False

    def _stick(self, axis: int) -> float:
        """Where a stick is in -1..1, up and left being positive, beyond its dead zone."""
        value = -float(self._pad.get_axis(axis)) / FULL
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

    def read(self) -> Intent:
        while select.select([self._fd], [], [], 0.0)[0]:
            try:
                pressed = os.read(self._fd, 64).decode("ascii", "ignore")
            except OSError:  # a terminal that was closed
                pressed = ""
            if not pressed:  # nobody steers any more
                self._way, self._ends = np.zeros(3), True
                break
            self._press(pressed)
        return Intent(way=self._way.copy(), ends=self._ends)

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


def open_steering(device: str, controls: Controls | None = None) -> CommandSource:
    """The device of that kind: gamepad, with its `controls`, keyboard, or auto for the first that is there. Raises
    ConfigError."""
    if device == "keyboard":
        return Keyboard()
    try:
        return Gamepad(controls)
    except ConfigError:
        if device == "auto" and sys.stdin.isatty():
            return Keyboard()
        raise
