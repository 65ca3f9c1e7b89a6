"""Writes the flight log, beside the loop: the loop hands over and never waits for a disk."""

from __future__ import annotations

import json
import queue
import threading
import time
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from servoid.hw.config import ConfigError
from servoid.stack.log.format import PROFILE, SCHEMAS, event_message, messages, plain
from servoid.stack.log.foxglove import VIEWS, line, views
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.event import Event

# A tick is about 7 kB before compression, so a chunk closes, and is on its way to the disk, about every sixth tick:
# what a kill loses is a fraction of a second. MCAP readers take any number of chunks.
CHUNK_BYTES = 40_000
BACKLOG = 1500  # items waiting for the disk, half a minute at 50 Hz
PATIENCE = 30.0  # s that closing waits for the disk

Item = tuple[int, list[tuple[str, dict[str, Any]]] | TickRecord]


class Recorder:
    """One flight log. Call it with each tick's record, then `close` it with the result.

    With `wait` a full backlog holds up the caller: for runs that nobody watches, which may outrun any disk. Otherwise
    it counts as a failure: a log with holes repeats nothing. Messages have wall time: that of the start, and what the
    body's clock says since. After a failure `error` says what happened and what
    to do, and everything that follows is dropped; the file stays readable up to its last complete chunk.
    """

    def __init__(
        self, file: BinaryIO, header: dict[str, Any], *, wait: bool = False, name: str = "the flight log"
    ) -> None:
        self.error: str | None = None
        self._file, self._name, self._wait = file, name, wait
        self._items: queue.Queue[Item | None] = queue.Queue(BACKLOG)
        self._closing = False  # the last item, None, was taken
        self._begun = time.time_ns()
        self._first: int | None = None  # time of the first tick by the body's clock
        self._time = self._begun
        self._thread = threading.Thread(target=self._work, args=(plain(header),), name="recorder", daemon=True)
        self._thread.start()

    @classmethod
    def create(cls, path: Path, header: dict[str, Any], *, wait: bool = False) -> Recorder:
        """Record to a new file. Raises ConfigError if it cannot be made; an existing file is never overwritten."""
        return cls(_make(path), header, wait=wait, name=str(path))

    def __call__(self, record: TickRecord) -> None:
        if self._first is None:
            self._first = record.observation.time_ns
        self._time = self._begun + record.observation.time_ns - self._first
        self._put((self._time, record))

    def events(self, events: tuple[Event, ...]) -> None:
        """Record events that came after the last tick."""
        if events:
            lines = [line(event, self._time) for event in events]
            self._put((self._time, [*(("/event", event_message(event)) for event in events), *lines]))

    def close(self, result: dict[str, Any]) -> None:
        """Write the result and finish the file. Returns within seconds even if the disk does not answer."""
        self._put((self._time, [("/result", plain(result))]))
        try:
            self._items.put(None, timeout=PATIENCE)
        except queue.Full:
            self._fail("the disk does not answer")
        self._thread.join(PATIENCE)
        if self._thread.is_alive():
            self._fail("the disk does not answer")

    def _put(self, item: Item) -> None:
        if self.error is not None:
            return
        try:
            self._items.put(item, block=self._wait)
        except queue.Full:
            self._fail("the disk is slower than the run")

    def _fail(self, why: str) -> None:
        if self.error is None:
            self.error = f"{self._name}: {why}: free some space or record elsewhere with --record"

    def _work(self, header: dict[str, Any]) -> None:
        try:
            self._write(header)
        except OSError as error:
            self._fail(error.strerror or str(error))
        except Exception as error:  # reported as the run's own event; a thread's exception would be lost
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            try:
                self._file.close()
            except OSError as error:  # what was buffered does not fit either
                self._fail(error.strerror or str(error))
        while self.error is not None and not self._closing:
            self._take()  # drop what comes, so that nobody waits for room

    def _take(self) -> Item | None:
        item = self._items.get()
        self._closing = item is None
        return item

    def _write(self, header: dict[str, Any]) -> None:
        stream = _Flushed(self._file)
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        writer.start(profile=PROFILE)
        channels = {}
        for topic, schema in SCHEMAS.items():
            number = writer.register_schema(
                PROFILE + topic.replace("/", "."), "jsonschema", json.dumps(schema).encode()
            )
            channels[topic] = writer.register_channel(topic, "json", number)
        for topic, (name, schema) in VIEWS.items():
            number = writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            channels[topic] = writer.register_channel(topic, "json", number)
        names = [joint["name"] for joint in header["robot"]["joints"]]
        sequence = 0

        def add(time_ns: int, topic: str, message: dict[str, Any]) -> None:
            nonlocal sequence
            sequence += 1
            data = json.dumps(message, separators=(",", ":")).encode()
            writer.add_message(channels[topic], time_ns, data, time_ns, sequence)

        # Larger than a chunk on purpose, with its padding of blanks, so that the header reaches the disk at once.
        start = self._begun
        writer.add_message(channels["/run"], start, json.dumps(header).encode().ljust(CHUNK_BYTES), start, 0)
        while (item := self._take()) is not None:
            at, what = item
            told = [*messages(what), *views(what, names, at)] if isinstance(what, TickRecord) else what
            for topic, message in told:
                add(at, topic, message)
        writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()


def free_name(task: str, folder: Path) -> Path:
    """A name for a log that is free: DATE-TASK.mcap, numbered when two runs start in one second."""
    stem = f"{datetime.now():%Y%m%d-%H%M%S}-{task}"
    names = (folder / f"{stem}{end}.mcap" for end in ("", *(f"-{i}" for i in range(2, 1000))))
    return next(name for name in names if not name.exists())


def check_new(path: Path) -> None:
    """Raise ConfigError where `Recorder.create` would; leaves no file."""
    _make(path).close()
    path.unlink()


def _make(path: Path) -> BinaryIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except FileExistsError:
        raise ConfigError(
            f"{path}: already exists, and a log is never overwritten: choose another name, or delete it"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}): choose another place") from None


class _Flushed:
    """A file whose writes reach the operating system at once, so that they outlive a kill of this process."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._count = file, 0

    def write(self, data: bytes) -> int:
        self._file.write(data)
        self._file.flush()
        self._count += len(data)
        return len(data)

    def tell(self) -> int:
        return self._count
