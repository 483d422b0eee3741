"""One reachd an arm: a file lock for this machine, named after the arm.

The kernel lets go of it when its holder dies, however it dies.
"""

from __future__ import annotations

import fcntl
import json
import os
import stat
import tempfile
from pathlib import Path

RUNTIME_VARIABLE = "TACTILE_RUNTIME_DIR"
"""Environment variable that names another folder for locks: simulations side by side, each with
its own arm of the same name, need one each."""

MAX_NOTE = 4096
"""Bytes read of what a holder wrote about itself."""


class LockError(Exception):
    """The arm is taken, or the lock cannot be had; the message names the remedy."""


def runtime_folder() -> Path:
    """Folder of the locks: one for all users, or two of them could hold one arm."""
    given = os.environ.get(RUNTIME_VARIABLE)
    if given:
        return Path(given)
    common = Path("/run/lock")
    return common if common.is_dir() and os.access(common, os.W_OK) else Path(tempfile.gettempdir())


class ArmLock:
    """Holds an arm from `acquire` to `release`."""

    def __init__(self, arm: str, folder: Path | None = None) -> None:
        self.arm = arm
        self.path = (folder or runtime_folder()) / f"tactile-reach-arm-{arm}.lock"
        self._file: int | None = None

    def acquire(self, name: str) -> None:
        """Take the lock as reach ``name``; `LockError` when another holds it."""
        try:
            file = self._open()
        except OSError as error:
            raise LockError(
                f"cannot open the lock {self.path}: {error.strerror}; make it writable, or name "
                f"another folder in {RUNTIME_VARIABLE}"
            ) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = _read_note(file)
            os.close(file)
            raise LockError(
                f"arm {self.arm!r} is commanded by another reachd{holder}: stop that one, or name "
                "another --arm"
            ) from error
        note = json.dumps({"pid": os.getpid(), "reach": name}).encode()
        os.ftruncate(file, 0)
        os.pwrite(file, note, 0)
        self._file = file

    def release(self) -> None:
        """Let the arm go. The file stays: to delete it would let two hold locks of one name."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
        try:
            # Without O_CREAT first: Linux refuses it for another user's file in a sticky folder.
            file = os.open(self.path, flags)
        except FileNotFoundError:
            file = os.open(self.path, flags | os.O_CREAT, 0o666)
            os.fchmod(file, 0o666)  # whatever the umask: other users must find the arm taken, too
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(0, "it is no plain file", str(self.path))
        return file


def _read_note(file: int) -> str:
    """What the holder wrote about itself, in words."""
    try:
        note = json.loads(os.pread(file, MAX_NOTE, 0))
        return f" (process {int(note['pid'])}, reach {str(note['reach'])!r})"
    except (ValueError, KeyError, TypeError):
        return ""
