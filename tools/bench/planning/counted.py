"""What a plan's network calls take of the processor: counted within plans, where others have filled the caches."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from servoid.policy.diffusion.engines import Engine
from servoid.policy.diffusion.engines.differentiable import Differentiable


class Counted:
    """A function that counts the processor's time of its calls, s."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self.seconds = function, 0.0

    def __call__(self, *inputs: Any, **text: Any) -> Any:
        start = time.process_time()
        found = self._function(*inputs, **text)
        self.seconds += time.process_time() - start
        return found


class CountedEngine:
    """An engine whose calls are counted and, apart from them, the ways back of one that has a gradient."""

    def __init__(self, engine: Engine) -> None:
        self._back: list[Counted] = []
        if isinstance(engine, Differentiable):
            forward, backward = (Counted(each) for each in engine.passes)
            plain = Counted(engine.engine)
            self._calls, self._back = [plain, forward], [backward]
            self.engine: Engine = Differentiable(plain, forward, backward)
        else:
            plain = Counted(engine)
            self._calls, self.engine = [plain], plain

    def clear(self) -> None:
        """Count from here."""
        for counted in (*self._calls, *self._back):
            counted.seconds = 0.0

    @property
    def seconds(self) -> float:
        """Of calls, forward."""
        return sum(counted.seconds for counted in self._calls)

    @property
    def back(self) -> float:
        """Of the way back, s."""
        return sum(counted.seconds for counted in self._back)
