"""One reachd an arm: a file lock for its user, named after the arm.

The kernel lets go of it when its holder dies, however it dies. The lock is of a file that is its
user's own, in a folder that is; the file is opened and never written, so whatever lies under its
name keeps its contents. What the holder says of itself stands in a file beside it. That two users
do not command one arm is seen to on the bus, where every commander of an arm shows itself.
"""

from __future__ import annotations

import fcntl
import json
import os
import pwd
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from tactile_core.config import printable

RUNTIME_VARIABLE = "TACTILE_RUNTIME_DIR"
"""Environment variable that names another folder for locks: simulations side by side, each with
its own arm of the same name, need one each."""

MAX_NOTE = 4096
"""Bytes read of what a holder wrote about itself."""


class LockError(Exception):
    """The arm is taken, or the lock cannot be had; the message names the remedy."""


def runtime_folder() -> Path:
    """Folder of this user's locks: as given, or one that is made for them."""
    given = os.environ.get(RUNTIME_VARIABLE)
    if given:
        return Path(given)
    # Not the folder of a login: a service and a login of one user must find each other's lock.
    common = Path("/run/lock")
    if not (common.is_dir() and os.access(common, os.W_OK)):
        common = Path(tempfile.gettempdir())
    return common / f"tactile-reach-{os.geteuid()}"


class ArmLock:
    """Holds an arm from `acquire` to `release`."""

    def __init__(self, arm: str, folder: Path | None = None) -> None:
        self.arm = arm
        self.path = (folder or runtime_folder()) / f"tactile-reach-arm-{arm}.lock"
        self._file: int | None = None

    @property
    def note(self) -> Path:
        """File in which the holder says who it is."""
        return self.path.with_suffix(".holder")

    def acquire(self, name: str) -> None:
        """Take the lock as reach ``name``; `LockError` when another holds it."""
        try:
            _make_folder(self.path.parent)
            file = self._open()
        except OSError as error:
            raise LockError(
                f"cannot open the lock {self.path}: {error.strerror}; make it your own, or name "
                f"another folder in {RUNTIME_VARIABLE}"
            ) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = self._holder(file)
            os.close(file)
            raise LockError(
                f"arm {self.arm!r} is commanded by another reachd{holder}: stop that one, or name "
                "another --arm"
            ) from error
        self._file = file
        try:
            self._write_note(name)
        except OSError as error:
            self.release()
            raise LockError(
                f"cannot write {self.note}: {error.strerror}; make the folder writable, or name "
                f"another one in {RUNTIME_VARIABLE}"
            ) from error

    def release(self) -> None:
        """Let the arm go. The file stays: to delete it would let two hold locks of one name."""
        if self._file is not None:
            self.note.unlink(missing_ok=True)
            os.close(self._file)
            self._file = None

    def _open(self) -> int:
        """The lock's file: plain, this user's, under no other name; made when missing."""
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            file = os.open(self.path, flags | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            file = os.open(self.path, flags)
        try:
            status = os.fstat(file)
            if not stat.S_ISREG(status.st_mode):
                raise OSError(0, "it is not a plain file", str(self.path))
            if status.st_uid != os.geteuid():
                owner = f"it belongs to user {_user(status.st_uid)}{self._holder(file)}"
                raise OSError(0, owner, str(self.path))
            if status.st_nlink != 1:
                raise OSError(0, "it has a second name, so it is another file", str(self.path))
        except OSError:
            os.close(file)
            raise
        return file

    def _write_note(self, name: str) -> None:
        """Say who holds it, in a new file that takes the place of an old one."""
        note = json.dumps({"pid": os.getpid(), "reach": name}).encode()
        fresh = self.note.with_suffix(f".{os.getpid()}")
        fresh.unlink(missing_ok=True)
        file = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            os.write(file, note)
        finally:
            os.close(file)
        os.replace(fresh, self.note)

    def _holder(self, file: int) -> str:
        """Who holds the lock, in words: as the kernel says, with the name it gave itself."""
        told = self._read_note()
        pid = _holding_process(file) or told.get("pid")
        parts = []
        if isinstance(pid, int):
            parts.append(f"process {pid}")
            with suppress(OSError):  # it is gone, or this is not Linux
                parts.append(f"user {_user(Path(f'/proc/{pid}').stat().st_uid)}")
        if "reach" in told and told.get("pid") == pid:
            parts.append(f"reach {printable(str(told['reach']))!r}")
        return f" ({', '.join(parts)})" if parts else ""

    def _read_note(self) -> dict[str, object]:
        try:
            file = os.open(self.note, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError:
            return {}
        try:
            note = json.loads(os.read(file, MAX_NOTE))
        except (OSError, ValueError, RecursionError):
            return {}
        finally:
            os.close(file)
        return note if isinstance(note, dict) else {}


def _make_folder(folder: Path) -> None:
    """Make the folder when missing; OSError for the usual one where it is somebody else's.

    Of a folder that was given, the files are judged one by one.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    owner = folder.lstat().st_uid
    if owner != os.geteuid() and RUNTIME_VARIABLE not in os.environ:
        raise OSError(0, f"its folder belongs to user {_user(owner)}", str(folder))


def _holding_process(file: int) -> int | None:
    """Process that holds a lock on an open file, as Linux says; None where it does not."""
    try:
        status = os.fstat(file)
        place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
        for line in Path("/proc/locks").read_text().splitlines():
            # 1: FLOCK  ADVISORY  WRITE 708 00:14:5 0 EOF
            words = line.split()
            if len(words) >= 6 and words[1] == "FLOCK" and words[5] == place:
                pid = int(words[4])
                return pid if pid > 0 else None
    except (OSError, ValueError):
        pass
    return None


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)
