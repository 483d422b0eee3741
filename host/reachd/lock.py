"""One reachd per arm: a file lock for each user, named after the arm.

The kernel releases it when its holder dies, however it dies. The lock file and its folder belong to
the user; the file is opened and never written, so whatever exists under its name keeps its
contents. The holder describes itself in a second file. Commanders of different users find each
other on the bus, where every commander of an arm shows itself.
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
"""Environment variable for another folder of locks: simulations side by side, each with its own arm
of the same name, need one each."""

MAX_NOTE = 4096
"""Most bytes read of a holder's note."""


class LockError(Exception):
    """The arm is locked by another process, or the lock is unusable; the text names the remedy."""


def runtime_folder() -> Path:
    """Folder of this user's locks: as given in the environment, else the default."""
    given = os.environ.get(RUNTIME_VARIABLE)
    if given:
        return Path(given)
    # Not a login's folder: a service and a login of one user must find each other's lock.
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
        """File in which the holder describes itself."""
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
        """Release the arm. The lock file stays: deleting it could give two holders of one name."""
        if self._file is not None:
            self.note.unlink(missing_ok=True)
            os.close(self._file)
            self._file = None

    def _open(self) -> int:
        """Open or make the lock file; OSError unless it is plain, this user's, with one name."""
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
        """Write who holds the lock, in a new file that replaces an old one."""
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
        """Text on who holds the lock: from the kernel, with the name from its note."""
        told = self._read_note()
        pid = _holding_process(file) or told.get("pid")
        parts = []
        if isinstance(pid, int):
            parts.append(f"process {pid}")
            with suppress(OSError):  # the process is gone, or this is not Linux
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
    """Make the folder if missing; OSError when the default one belongs to another user.

    In a folder given by the environment only the files are checked.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    owner = folder.lstat().st_uid
    if owner != os.geteuid() and RUNTIME_VARIABLE not in os.environ:
        raise OSError(0, f"its folder belongs to user {_user(owner)}", str(folder))


def _holding_process(file: int) -> int | None:
    """Process that holds a lock on an open file, by Linux's list; None if unknown."""
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
