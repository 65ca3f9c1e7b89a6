"""A backend: a body as it is opened, read, driven and closed, and what a simulated one offers beside that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from servoid.hw.contracts.body import Array, Clock, Motors, Sensors
from servoid.hw.contracts.world import Surroundings, Truth


class Backend(Protocol):
    """A body: simulated, virtual or real. `connect` never moves it."""

    name: str
    clock: Clock

    @property
    def simulation(self) -> Simulation | None:
        """What a simulated body offers beside reading and writing. None for hardware, which needs leave to move."""
        ...

    def connect(self) -> tuple[Sensors, Motors]:
        """Open the body. Raises BackendError when it cannot be reached, and leaves nothing open then."""
        ...

    def close(self) -> None:
        """Release the body. Motors are left with torque off."""
        ...


@dataclass(frozen=True)
class Simulation:
    """What a simulated body can do that a real one cannot. Evaluation reads the truth; policies, estimators and tasks
    are shown no more than what `surroundings` lets the robot see."""

    truth: Truth
    push: Callable[[Array], None]  # changes the base's velocity by (2,) m/s, world frame
    surroundings: Surroundings | None = None  # the scene that the body was made with
    teammates: tuple[Backend, ...] = ()  # the scene's other robots; their time goes on with this one's
