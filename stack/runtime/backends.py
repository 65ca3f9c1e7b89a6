"""Backends by name, imported when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.task import Episode
from servoid.hw.robot.checks import check_bus_port
from servoid.hw.robot.description import Robot


@dataclass(frozen=True)
class Kind:
    """A kind of body. A simulated one takes a seed and has a clock that a run drives as fast as it can; another one is
    reached by a port. `several` says whether a scene may hold other robots. `options` are for its constructor."""

    module: str
    attribute: str
    simulated: bool
    several: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)


BACKENDS = {
    "sim": Kind("servoid.sim.backend", "SimBackend", simulated=True, several=True),
    "virtual": Kind("servoid.sim.rig.process.backend", "VirtualBackend", simulated=True),
    "dynamixel": Kind("servoid.hw.dynamixel.backend", "DynamixelBackend", simulated=False, options={"exact": True}),
}


def backend_kind(name: str) -> Kind:
    """Raises ConfigError with the nearest name."""
    if name not in BACKENDS:
        raise ConfigError(f"unknown backend '{name}': {nearest(name, BACKENDS)}")
    return BACKENDS[name]


def make_backend(
    name: str, robot: Robot, *, seed: int, randomise: bool, port: str | None, episode: Episode | None = None
) -> Backend:
    """A body, not yet connected. A simulated one begins, and has a scene around it, as `episode` says: who runs a real
    robot puts up what that asks for.

    Raises ConfigError for an unknown name or a setting that it does not take.
    """
    kind, episode = backend_kind(name), episode or Episode()
    scene = episode.scene
    if scene is not None and scene.robots is not None and not kind.several:
        able = ", ".join(f"--backend {other}" for other, its in BACKENDS.items() if its.several)
        raise ConfigError(f"backend '{name}' has one robot, but the task needs {len(scene.robots) + 1}: use {able}")
    if kind.simulated and port is not None:
        raise ConfigError(f"backend '{name}' has no port: drop --port, or choose --backend dynamixel")
    if port == "virtual":
        raise ConfigError("--port virtual belongs to servoid bringup: for a run use --backend virtual, without --port")
    if not kind.simulated and port is None:
        raise ConfigError(f"backend '{name}' needs a port: give --port PATH (`servoid bringup find-port` finds it)")
    if port is not None:
        check_bus_port(robot, port)
    if not kind.simulated and randomise:
        raise ConfigError(f"backend '{name}': real hardware cannot be randomised: drop --randomise")
    make = getattr(import_module(kind.module), kind.attribute)
    simulated = {"seed": seed, "randomise": randomise, "scene": scene, "start": episode.start}
    chosen = simulated if kind.simulated else {"port": port}
    backend: Backend = make(robot, **chosen, **kind.options)
    return backend
