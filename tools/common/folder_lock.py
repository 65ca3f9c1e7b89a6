"""One program at a time in an output folder: a second one would delete or mix up what the first one writes."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from servoid.hw.config import ConfigError


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold `folder`, which may not exist yet, for this program. Raises ConfigError naming who holds it.

    The lock is a file beside the folder that the system lets go of when the program ends, however it ends.
    """
    path = folder.parent / f".{folder.name}.lock"
    with _hold(path, folder) as file:
        file.truncate(0)
        file.write(f"`{' '.join([Path(sys.argv[0]).name, *sys.argv[1:]])[:120]}` (process {os.getpid()})\n")
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _hold(path: Path, folder: Path) -> TextIO:
    """The lock's file, held as long as it is open. Raises ConfigError."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        while True:
            file = path.open("a+")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(path.stat(), os.fstat(file.fileno())):
                return file
            file.close()  # whoever held it has deleted it meanwhile
    except BlockingIOError:
        file.seek(0)
        holder = file.read().strip() or "another program"
        file.close()
        raise ConfigError(f"{folder}: {holder} is writing there: wait for it, or choose another folder") from None
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror}): choose another place") from None
