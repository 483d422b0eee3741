"""Files of a log and deletion of old ones, except those being written."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import re
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tactile_core.log.reader import check_readable
from tactile_core.log.records import LogError
from tactile_core.types import Instant, monotonic_now, seconds_between, utc_text

log = logging.getLogger(__name__)


@dataclass(slots=True)
class LogSet:
    """Files of one log and of earlier ones of the same name, oldest first by their names.

    ``number``: of the current file. In a directory all files are numbered and dated. A log to a
    named file starts with that name, followed by ``<name>_0001.mcap`` and so on.
    """

    directory: Path
    stem: str
    pattern: re.Pattern[str]
    named: bool
    number: int = 0

    @classmethod
    def at(cls, destination: Path, prefix: str, now_ns: int) -> LogSet:
        """Log set for ``destination``, a ``.mcap`` file or a directory."""
        if destination.suffix == ".mcap":
            stem = destination.name.removesuffix(".mcap")
            pattern = re.compile(re.escape(stem) + r"(_\d{4,})?\.mcap")
            return cls(destination.parent, stem, pattern, True)
        date = utc_text(now_ns, "%Y%m%dT%H%M%SZ")
        pattern = re.compile(re.escape(prefix) + r"_\d{8}T\d{6}Z_\d{4,}\.mcap")
        return cls(destination, f"{prefix}_{date}", pattern, False)

    @property
    def current(self) -> Path:
        """Path of the file being written."""
        if self.named and self.number == 0:
            return self.directory / f"{self.stem}.mcap"
        return self.directory / f"{self.stem}_{self.number:04d}.mcap"

    def advance(self) -> None:
        """Move on to the next file."""
        self.number += 1

    def older(self) -> list[Path]:
        """All files of the set except the current one, oldest first."""
        found = [
            path
            for path in self.directory.iterdir()
            if path != self.current and self.pattern.fullmatch(path.name) and path.is_file()
        ]
        return sorted(found, key=self._age)

    def _age(self, path: Path) -> tuple[str, int]:
        """Sort key of the files of the set, oldest first."""
        name = path.name.removesuffix(".mcap")
        if self.named:
            number = name.removeprefix(self.stem).lstrip("_")
            return "", int(number or 0)
        start, _, number = name.rpartition("_")
        return start, int(number)


def enforce(log_set: LogSet, max_files: int | None, max_bytes: int | None) -> list[Path]:
    """Delete the oldest files of the set above either limit; returns those deleted.

    Nothing is deleted before the newest of the others was verified readable, and never the current
    file or one that another process writes. Errors are logged, never raised.
    """
    if max_files is None and max_bytes is None:
        return []
    deleted: list[Path] = []
    try:
        older = log_set.older()
        if not older:
            return []
        check_readable(older[-1])
        sizes = [path.stat().st_size for path in older]
        total, count = sum(sizes), len(older) + 1
        for path, size in zip(older, sizes, strict=True):
            over = (max_files is not None and count > max_files) or (
                max_bytes is not None and total > max_bytes
            )
            if not over:
                break
            if _in_use(path):
                continue
            path.unlink()
            deleted.append(path)
            total -= size
            count -= 1
    except LogError as error:
        log.error("log: nothing is deleted: the newest file before this is not readable: %s", error)
    except OSError as error:
        log.error("log: cannot delete old files: %s", error)
    return deleted


def _in_use(path: Path) -> bool:
    """Whether a recorder holds the lock of a file."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in (errno.EWOULDBLOCK, errno.EAGAIN)
    finally:
        os.close(fd)
    return False


# Watch on the free space of a log's disk, on a thread that may hang with it.


LOOK_EVERY = 10.0
"""Interval of checks in s."""

SILENT_AFTER = 30.0
"""Time in s without an answer after which a disk is reported as silent."""

LOW_BYTES = 4 << 30
"""Free bytes below which the alarm is raised. Logs stop at 1 GiB, and there must be time to react:
at the 7 MB a minute of one board, seven hours."""


class DiskWatch:
    """Checks the free space of a folder.

    ``free_bytes``: at the last check, None before the first.
    """

    def __init__(
        self,
        folder: Callable[[], Path],
        low_bytes: int = LOW_BYTES,
        usage: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
        every: float = LOOK_EVERY,
    ) -> None:
        self.free_bytes: int | None = None
        self._folder = folder
        self._low = low_bytes
        self._usage = usage
        self._every = every
        self._looked = monotonic_now()
        self._error = ""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="disk-watch", daemon=True)

    def start(self) -> None:
        """Start checking."""
        self._thread.start()

    def stop(self) -> None:
        """Stop without waiting, as the thread may hang in a check."""
        self._stopping.set()

    def alarm(self, now: Instant) -> str | None:
        """Problem with the disk; None if there is none."""
        silent = seconds_between(self._looked, now)
        if silent > self._every + SILENT_AFTER:
            return f"the log's disk has not answered for {silent:.0f} s"
        if self._error:
            return f"the log's disk: {self._error}"
        if self.free_bytes is not None and self.free_bytes < self._low:
            return (
                f"{self.free_bytes / 1e9:.1f} GB free for logs: make room, or lower max_bytes of "
                "[log.recorder]"
            )
        return None

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self.free_bytes = self._usage(self._folder())
                self._error = ""
            except OSError as error:
                self._error = error.strerror or str(error)
            self._looked = monotonic_now()
            self._stopping.wait(self._every)
