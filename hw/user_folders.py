"""The user's own folders, as the XDG base directories say. A service, a container or a user ID without a name may have
none."""

from __future__ import annotations

import os
from pathlib import Path


def user_folder(variable: str, beside_home: str) -> Path | None:
    """The `servoid` folder in `$variable`, or in `beside_home` of the home folder; None for a user without either."""
    given = os.environ.get(variable, "")
    if os.path.isabs(given):  # a relative one is to be ignored
        return Path(given) / "servoid"
    home = os.path.expanduser("~")
    return Path(home) / beside_home / "servoid" if os.path.isabs(home) else None
