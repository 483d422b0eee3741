"""How long the disk of a log will do, looked at from a thread that may hang with it."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from pathlib import Path

from tactile_bus.instant import Instant, monotonic_now, seconds_between

LOOK_EVERY = 10.0
"""s between looks."""

SILENT_AFTER = 30.0
"""s without an answer after which a disk is called silent."""

LOW_BYTES = 4 << 30
"""Free bytes at which the alarm goes off: logs stop at 1 GiB, and somebody must have time to come.
At the 7 MB a minute of one board that is seven hours before."""


class DiskWatch:
    """Looks at the free space of a folder. ``free_bytes``: of the last look, None before it."""

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
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """End without waiting: the thread may hang in a look."""
        self._stopping.set()

    def alarm(self, now: Instant) -> str | None:
        """What is wrong with the disk, None: nothing."""
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
