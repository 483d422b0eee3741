"""Runtime folder: where the processes of one rig on one machine find each other.

It holds their sockets and a secret. Only its owner and group can read it, so the kernel keeps all
others out. The secret (`token_file`) gives the same protection on a loopback TCP port, which any
user may open. It belongs to the user rather than the rig: rigs of one user side by side have
folders of their own but share one secret.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import secrets
import socket
import stat
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

RUNTIME_VARIABLE = "TACTILE_RUNTIME_DIR"
"""Environment variable with another runtime folder: rigs side by side need one each."""

SYSTEMD_VARIABLE = "RUNTIME_DIRECTORY"
"""Variable that systemd sets for a service with ``RuntimeDirectory=``; the first of several folders
is used."""

SERVICE_FOLDER = Path("/run/tactile")
"""Runtime folder of installed services; members of their group join them there."""

BUS = "bus"
"""Folder of the sockets, inside the runtime folder."""

TOKEN = "token"
"""File of the secret, inside the runtime folder: one line ``USER:SECRET``."""

USER = "rig"
"""User name that goes with the secret; it carries no rights, as all users here have the same."""

MAX_SOCKET_PATH = 107
"""Longest path of a unix socket on Linux, in bytes (108 with its closing zero)."""

ODD = re.compile(r"[?#;\s]")
"""Characters with a special meaning in a zenoh endpoint or configuration."""

UNIX = "unixsock-stream/"
"""Prefix of a unix socket's endpoint in zenoh."""


class RuntimeFolderError(Exception):
    """The folder cannot be used; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class Runtime:
    """A runtime folder. ``shared``: its group may join, as with the services' group."""

    folder: Path
    shared: bool = False

    @property
    def bus(self) -> Path:
        """Folder of the sockets."""
        return self.folder / BUS

    def endpoint(self, role: str) -> str:
        """Zenoh endpoint of ``role``. Raises `RuntimeFolderError` if no socket is possible here."""
        check_socket_path(self.bus / f"{role}.sock")
        return f"{UNIX}{self.bus / role}.sock"


def find_runtime() -> Runtime:
    """Runtime folder: the one named by the environment, or `home`."""
    given = os.environ.get(RUNTIME_VARIABLE)
    return Runtime(Path(given).absolute()) if given else home()


def home() -> Runtime:
    """Folder of this service, of the installed services (for their group), or of the user."""
    from_systemd = os.environ.get(SYSTEMD_VARIABLE, "").partition(":")[0]
    if from_systemd:
        return Runtime(Path(from_systemd).absolute(), shared=True)
    if os.access(SERVICE_FOLDER / BUS, os.X_OK) and os.access(SERVICE_FOLDER / TOKEN, os.R_OK):
        return Runtime(SERVICE_FOLDER, shared=True)
    # The variable alone is not enough: cron does not set it, but its jobs must meet the desktop's.
    for own in (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{os.getuid()}"):
        if own and os.access(own, os.W_OK | os.X_OK):
            return Runtime(Path(own).absolute() / "tactile")
    return Runtime(Path(tempfile.gettempdir()) / f"tactile-{os.getuid()}")


def _variable(runtime: Runtime) -> str:
    """Environment variable that selects this folder; the secret stays in the user's home folder."""
    given = os.environ.get(RUNTIME_VARIABLE)
    here = given is not None and runtime.folder == Path(given).absolute()
    return RUNTIME_VARIABLE if here else "XDG_RUNTIME_DIR"


def prepare(runtime: Runtime) -> None:
    """Create the folder of the sockets with mode 0750, or reject one that others can enter.

    Raises `RuntimeFolderError` if it belongs to another user or cannot be created.
    """
    for folder in (runtime.folder, runtime.bus):
        _prepare_folder(folder, runtime)
    if runtime.bus.stat().st_mode & 0o007:
        raise RuntimeFolderError(
            f"{runtime.bus} is open to every user of this machine: chmod 0750 {runtime.bus}"
        )


def _prepare_folder(folder: Path, runtime: Runtime) -> None:
    try:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o750, parents=True)
            folder.chmod(0o750)  # regardless of the umask
        itself, found = folder.lstat(), folder.stat()
    except OSError as error:
        raise RuntimeFolderError(
            f"{folder}: {error.strerror}; name a folder of your own in {_variable(runtime)}"
        ) from error
    if not stat.S_ISDIR(found.st_mode):
        raise RuntimeFolderError(
            f"{folder} is not a folder: delete it, or name another in {_variable(runtime)}"
        )
    foreign = {itself.st_uid, found.st_uid} - {os.getuid(), 0}
    if foreign and not runtime.shared:
        raise RuntimeFolderError(
            f"{folder} belongs to another user, who could listen in: name a folder of your "
            f"own in {_variable(runtime)}"
        )
    if found.st_mode & stat.S_IWOTH and not found.st_mode & stat.S_ISVTX:
        raise RuntimeFolderError(
            f"every user of this machine may write to {folder}: chmod o-w {folder}"
        )


def token_file(runtime: Runtime) -> tuple[Path, str]:
    """Return the file of the secret and the secret, creating it if there is none.

    Raises `RuntimeFolderError` if it cannot be read, belongs to another user, or others can read
    it.
    """
    path = runtime.folder / TOKEN
    if not path.exists():
        _prepare_folder(runtime.folder, runtime)
    try:
        if not path.exists():
            _make_token(path, 0o640 if runtime.shared else 0o600)
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        with open(file, encoding="ascii") as stream:
            about = os.fstat(file)
            text = stream.read(4096)
    except OSError as error:
        raise RuntimeFolderError(
            f"the secret of this rig, {path}, cannot be read ({error.strerror}): ask for the group "
            f"that owns it, or name a folder of your own in {_variable(runtime)}"
        ) from error
    except UnicodeDecodeError as error:
        raise RuntimeFolderError(f"{path} does not hold a secret: delete it") from error
    if about.st_mode & 0o007 or (not runtime.shared and about.st_uid not in (os.getuid(), 0)):
        raise RuntimeFolderError(
            f"{path} can be read by others or belongs to them: delete it, a new one is made"
        )
    user, _, secret = text.strip().partition(":")
    if user != USER or len(secret) < 32 or ODD.search(secret):
        raise RuntimeFolderError(f"{path} does not hold a secret: delete it, a new one is made")
    return path, secret


def _make_token(path: Path, mode: int) -> None:
    """Create the secret atomically: a process that comes second uses the first one's."""
    new = path.with_name(f".{TOKEN}-{os.getpid()}-{secrets.token_hex(4)}")
    file = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        os.fchmod(file, mode)
        os.write(file, f"{USER}:{secrets.token_hex(32)}\n".encode())
        os.close(file)
        with contextlib.suppress(FileExistsError):
            os.link(new, path)
    finally:
        new.unlink()


def socket_path(endpoint: str) -> Path | None:
    """Path of a unix socket's endpoint; None for any other endpoint."""
    if not endpoint.startswith(UNIX):
        return None
    return Path(endpoint.removeprefix(UNIX).partition("#")[0].partition("?")[0])


def check_socket_path(path: Path) -> None:
    """Raise `RuntimeFolderError` if no socket is possible at ``path``."""
    length = len(os.fsencode(path))
    if length > MAX_SOCKET_PATH:
        raise RuntimeFolderError(
            f"{path} has {length} bytes; a unix socket may have {MAX_SOCKET_PATH}: name a folder "
            f"with a shorter path in {RUNTIME_VARIABLE}"
        )
    if ODD.search(str(path)):
        raise RuntimeFolderError(
            f"{path}: no space and none of ? # ; in the path of a socket: name another folder in "
            f"{RUNTIME_VARIABLE}"
        )
    if not path.is_absolute():
        raise RuntimeFolderError(f"{path}: give the whole path of a socket, from /")


class SocketLock:
    """Lock held while a process listens at a socket, until its session has closed completely.

    zenoh releases its own lock before it deletes the socket, so that a process starting in between
    would listen at a deleted file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(path.name + ".held")
        self._file: int | None = None

    def acquire(self) -> bool:
        """Acquire the lock; False if another process holds it.

        Raises OSError if the folder forbids it.
        """
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            return False
        self._file = file
        return True

    def release(self) -> None:
        """Release the lock.

        The file stays: deleting it would let two processes hold locks of one name.
        """
        if self._file is not None:
            os.close(self._file)
            self._file = None


def listener_of(path: Path) -> int | None:
    """Process id of the listener at a unix socket; None if there is none or it is unknown."""
    if not hasattr(socket, "SO_PEERCRED"):
        return None
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(1.0)
            probe.connect(str(path))
            size = struct.calcsize("3i")
            answer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    except OSError:
        return None
    pid, _, _ = struct.unpack("3i", answer)
    return int(pid) or None
