"""A disk that is full, fails or hangs on demand."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

from tactile_core.log.mcap_file import DiskStorage


class FragileDisk(DiskStorage):
    """A disk that takes ``room`` more bytes (None: all), fails with ``error``, or hangs."""

    def __init__(self) -> None:
        self.room: int | None = None
        self.error = errno.ENOSPC
        self.free_bytes = 1 << 40
        self.moving = threading.Event()
        self.moving.set()
        self.syncs = 0

    def open(self, path: Path) -> int:
        self.moving.wait()
        if self.room == 0:
            raise OSError(self.error, os.strerror(self.error))
        return super().open(path)

    def write(self, fd: int, data: bytes | memoryview) -> int:
        self.moving.wait()
        if self.room is None:
            return super().write(fd, data)
        taken = min(len(data), self.room)
        if taken == 0:
            raise OSError(self.error, os.strerror(self.error))
        self.room -= taken
        return super().write(fd, data[:taken])

    def sync(self, fd: int) -> None:
        self.moving.wait()
        self.syncs += 1
        super().sync(fd)

    def free(self, directory: Path) -> int:
        return self.free_bytes
