"""Steering by hand: a virtual gamepad, and keys typed into a terminal."""

from __future__ import annotations

import ctypes
import os
import pickle
import pty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import type_in

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Episode
from servoid.hw.contracts.world import Percept
from servoid.stack.control.operator import Controls, Gamepad, Keyboard, open_steering
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.stack.tasks.steer import SteeredAgain
from servoid.tools.commands import replay

NOTHING = Percept("task", 0.0)
# Axes of the virtual gamepad, as on one whose left trigger is axis 3.
LEFT, FORWARD, TURN, TRIGGER = 0, 1, 2, 3
END = 1
MAPPING = "leftx:a0,lefty:a1,rightx:a2,lefttrigger:a3,righttrigger:a4,righty:a5,a:b0,b:b1,x:b2,y:b3,platform:Linux"


# --- keys


@pytest.fixture
def terminal() -> Iterator[tuple[Keyboard, Callable[[str], None], int]]:
    """A keyboard, what types on it, and its terminal."""
    person, program = pty.openpty()
    keyboard = Keyboard(program)

    def press(text: str) -> None:
        type_in(person, program, text.encode())

    yield keyboard, press, program
    keyboard.close()
    os.close(person)
    os.close(program)


def test_keys_add_up_and_space_stops(terminal: tuple[Keyboard, Callable[[str], None], int]) -> None:
    keyboard, press, _ = terminal
    assert keyboard.read().way.tolist() == [0, 0, 0]
    press("wwa")
    np.testing.assert_allclose(keyboard.read().way, [0.4, 0.0, 0.2])
    np.testing.assert_allclose(keyboard.read().way, [0.4, 0.0, 0.2])  # nobody has to keep a key down
    press("\x1b[B\x1b[Ceee")
    np.testing.assert_allclose(keyboard.read().way, [0.2, -0.6, 0.0], atol=1e-12)
    press("w" * 20)
    assert keyboard.read().way[0] == 1.0
    press(" ")
    assert keyboard.read().way.tolist() == [0, 0, 0]
    assert not keyboard.read().ends
    press("x")
    assert keyboard.read().ends


def test_who_steers_by_keys_is_told_which(
    capsys: pytest.CaptureFixture[str], terminal: tuple[Keyboard, Callable[[str], None], int]
) -> None:
    assert "x ends" in capsys.readouterr().err


def test_the_terminal_is_left_as_it_was(terminal: tuple[Keyboard, Callable[[str], None], int]) -> None:
    import termios

    keyboard, _, fd = terminal
    assert not termios.tcgetattr(fd)[3] & termios.ECHO
    keyboard.close()
    keyboard.close()
    assert termios.tcgetattr(fd)[3] & termios.ECHO


def test_no_device_is_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    with pytest.raises(ConfigError, match="only be read in a terminal"):
        Keyboard(read)
    os.close(read)
    os.close(write)
    pytest.importorskip("pygame")
    with pytest.raises(ConfigError, match="no gamepad is connected: plug one in, or steer by keys"):
        open_steering("gamepad")


# --- a virtual gamepad


class VirtualPad:
    """A gamepad of SDL's own making, in the very library that pygame has loaded."""

    def __init__(self) -> None:
        import pygame

        os.environ["SDL_VIDEODRIVER"] = "dummy"
        os.environ["SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"] = "1"
        pygame.display.init()
        pygame.joystick.init()
        self._sdl = _loaded_sdl()
        self.index = self._sdl.SDL_JoystickAttachVirtual(1, 6, 4, 0)  # a game controller: 6 axes, 4 buttons
        assert self.index >= 0, "this SDL has no virtual joysticks: the one that comes with pygame's wheel has"
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self._pad = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(self.index))
        guid = pygame.joystick.Joystick(self.index).get_guid()
        self._sdl.SDL_GameControllerAddMapping(f"{guid},virtual,{MAPPING}".encode())
        self.push(TRIGGER, -1.0)  # where a trigger rests
        self.push(5, 0.0)  # which SDL's own kind of pad has as a trigger

    def push(self, axis: int, value: float) -> None:
        self._sdl.SDL_JoystickSetVirtualAxis(self._pad, axis, ctypes.c_int16(round(32767 * value)))

    def press(self, button: int) -> None:
        self._sdl.SDL_JoystickSetVirtualButton(self._pad, button, ctypes.c_uint8(1))

    def unplug(self) -> None:
        self._sdl.SDL_JoystickDetachVirtual(self.index)


def _loaded_sdl() -> Any:
    """The SDL in this process. Another copy of the library would have joysticks of its own."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        if "libSDL2-2" in line:
            return ctypes.CDLL(line.split(maxsplit=5)[5])
    raise AssertionError("pygame's SDL is not a library of its own here, as it is in pygame's wheel")


@pytest.fixture
def pad() -> Iterator[VirtualPad]:
    pygame = pytest.importorskip("pygame")
    yield VirtualPad()
    pygame.quit()


def test_sticks_walk_and_turn_and_a_button_ends(pad: VirtualPad) -> None:
    device = Gamepad()
    assert device.read().way.tolist() == [0, 0, 0]
    pad.push(FORWARD, -1.0)  # up is negative
    pad.push(LEFT, 0.05)  # within the dead zone
    pad.push(TURN, 0.55)
    way = device.read().way
    np.testing.assert_allclose(way, [1.0, 0.0, -0.5], atol=1e-3)
    assert not device.read().ends
    pad.press(END)
    assert device.read().ends
    device.close()


def test_a_gamepad_that_is_unplugged_asks_to_stand(pad: VirtualPad) -> None:
    """Its last stick would otherwise walk the robot on for ever."""
    device = Gamepad()
    device.read()  # with its sticks in the middle
    pad.push(FORWARD, -1.0)
    assert device.read().way[0] == pytest.approx(1.0, abs=1e-3)
    pad.unplug()
    device.read()
    assert device.read().way.tolist() == [0, 0, 0]
    device.close()


def test_a_trigger_at_rest_turns_nothing(pad: VirtualPad) -> None:
    """By its number it was the stick that turns: the robot turned untouched."""
    device = Gamepad()
    for _ in range(3):
        assert device.read().way.tolist() == [0, 0, 0]
    device.close()


def test_sticks_count_once_they_have_been_in_the_middle(pad: VirtualPad, capsys: pytest.CaptureFixture[str]) -> None:
    pad.push(FORWARD, -1.0)
    device = Gamepad()
    for _ in range(3):
        assert device.read().way.tolist() == [0, 0, 0]
    assert capsys.readouterr().err.count("let go of the gamepad's sticks") == 1
    pad.push(FORWARD, 0.0)
    assert device.read().way.tolist() == [0, 0, 0]
    pad.push(FORWARD, -1.0)
    assert device.read().way[0] == pytest.approx(1.0, abs=1e-3)
    device.close()


def test_other_sticks_and_buttons_may_be_chosen(pad: VirtualPad) -> None:
    device = Gamepad(Controls(forward="righty", turn="leftx", left="rightx", end="x"))
    device.read()
    pad.push(5, -1.0)
    pad.push(LEFT, -0.55)
    np.testing.assert_allclose(device.read().way, [1.0, 0.0, 0.5], atol=1e-3)
    pad.press(END)
    assert not device.read().ends
    pad.press(2)
    assert device.read().ends
    device.close()
    task = load_task("steer", {"turning_stick": "leftx", "end_button": "x"})
    assert (task.settings.turning_stick, task.settings.end_button) == ("leftx", "x")


@pytest.mark.slow
def test_a_run_is_steered_by_the_gamepad_and_can_be_replayed(pad: VirtualPad, tmp_path: Path) -> None:
    def steer(record: Any) -> None:
        if record.proposal.instruction is not None:
            ticks.append(record.tick)
            pad.push(FORWARD, -0.8 if len(ticks) > 25 else 0.0)
            if len(ticks) == 150:
                pad.press(END)

    ticks: list[int] = []
    settings = RunSettings("steer", policy="gait", set={"device": "gamepad"}, record=tmp_path / "steer.mcap")
    result = run(settings, on_tick=steer)
    assert result.outcome == "succeeded"
    assert result.ticks == 151
    assert result.trace.displacement[-1, 0] > 0.1
    asked = result.trace.command[:, 0]
    assert asked[10] == 0.0
    assert asked[100] == pytest.approx(0.25 * 0.7 / 0.9, rel=1e-3)
    assert replay.replay(read_log(tmp_path / "steer.mcap"))[1] is None


# --- the task


def test_recorded_steering_ends_as_the_person_did() -> None:
    ways = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    for ended in (True, False):
        again = SteeredAgain(ways, ended)
        for tick, (forward, done) in enumerate([(0.1, False), (0.2, ended), (0.0, ended)]):
            assert again.instruct(tick, None, NOTHING).velocity[0] == forward  # type: ignore[arg-type]
            assert again.done(None) == done  # type: ignore[arg-type]


def test_steering_is_held_as_the_log_holds_it(terminal: tuple[Keyboard, Callable[[str], None], int]) -> None:
    keyboard, press, _ = terminal
    task = load_task("steer", {"forward": "0.3"})
    steered = task.steered_behaviour(Episode(), keyboard.read)
    press("www")
    velocity = steered.instruct(0, None, NOTHING).velocity  # type: ignore[arg-type]
    assert velocity[0] == float(np.float32(0.18))
    press("ssssss")
    assert steered.instruct(1, None, NOTHING).velocity[0] == float(np.float32(-0.06))  # type: ignore[arg-type]
    pickle.loads(pickle.dumps(task.objective))  # for a planner's process, which gets no terminal
