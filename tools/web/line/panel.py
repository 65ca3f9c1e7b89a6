"""What a program puts on the page beside the robot for a person to press, slide and fill in: data, drawn by panel.js.

Each item names what it asks for (`do`); the page answers with a request of kind "do", which has that name and a value.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Paragraph:
    text: str


@dataclass(frozen=True)
class Table:
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Button:
    do: str
    label: str
    value: str = ""
    on: bool = False  # shown as chosen


@dataclass(frozen=True)
class Buttons:
    """In a row."""

    buttons: tuple[Button, ...]


@dataclass(frozen=True)
class Slider:
    """Asks with its number. One that `springs` is at 0 where nobody holds it, and asks by the heartbeat's way forward
    in place of a request of its own: who is not heard pushes nothing."""

    do: str
    label: str
    low: float
    high: float
    value: float
    springs: bool = False


@dataclass(frozen=True)
class Entry:
    """A text or a number to be filled in."""

    do: str
    label: str
    value: str


@dataclass(frozen=True)
class Choice:
    do: str
    label: str
    options: tuple[str, ...]
    value: str


@dataclass(frozen=True)
class Question:
    """Answered with "yes" or "no" and its number, so that no answer is one to another question."""

    number: int
    text: str


Item = Paragraph | Table | Buttons | Slider | Entry | Choice | Question


@dataclass(frozen=True)
class Panel:
    title: str
    items: tuple[Item, ...]

    def plain(self) -> dict[str, Any]:
        """As JSON values."""
        items = [{"is": type(item).__name__.lower(), **asdict(item)} for item in self.items]
        return {"kind": "panel", "title": self.title, "items": items}
