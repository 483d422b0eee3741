"""Where the processes of one rig meet on one machine: a folder, sockets in it, and a secret.

The folder is readable by its owner and group alone, so the kernel keeps everybody else out. The
secret (`token_file`) proves the same over a loopback TCP port, which any user may open. It is the
user's, not the rig's: rigs of one user side by side have folders of their own and one secret.
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
"""Environment variable that names another folder to meet in: rigs side by side need one each."""

SYSTEMD_VARIABLE = "RUNTIME_DIRECTORY"
"""What systemd sets for a service with ``RuntimeDirectory=``; the first of several counts."""

SERVICE_FOLDER = Path("/run/tactile")
"""Folder of installed services; whoever is in their group meets them there."""

BUS = "bus"
"""Folder of the sockets, below the runtime folder."""

TOKEN = "token"
"""File of the secret, below the runtime folder: one line ``USER:SECRET``."""

USER = "rig"
"""Name that goes with the secret; it says nothing about rights, for here all have the same."""

MAX_SOCKET_PATH = 107
"""Bytes a unix socket's path may have in Linux (108 with its closing zero)."""

ODD = re.compile(r"[?#;\s]")
"""Characters that mean something else in a zenoh endpoint, or in its configuration."""

UNIX = "unixsock-stream/"
"""What the endpoint of a unix socket begins with in zenoh."""


class RuntimeFolderError(Exception):
    """The folder cannot be used; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class Runtime:
    """A runtime folder. ``shared``: its group may join, as the services' own group may."""

    folder: Path
    shared: bool = False

    @property
    def bus(self) -> Path:
        """Folder of the sockets."""
        return self.folder / BUS

    def endpoint(self, role: str) -> str:
        """The zenoh endpoint of ``role``; `RuntimeFolderError` when no socket can be had here."""
        check_socket_path(self.bus / f"{role}.sock")
        return f"{UNIX}{self.bus / role}.sock"


def find_runtime() -> Runtime:
    """Where to meet: the folder that the environment names, or `home`."""
    given = os.environ.get(RUNTIME_VARIABLE)
    return Runtime(Path(given).absolute()) if given else home()


def home() -> Runtime:
    """The folder of a service, of the installed services for those in their group, or one's own."""
    from_systemd = os.environ.get(SYSTEMD_VARIABLE, "").partition(":")[0]
    if from_systemd:
        return Runtime(Path(from_systemd).absolute(), shared=True)
    if os.access(SERVICE_FOLDER / BUS, os.X_OK) and os.access(SERVICE_FOLDER / TOKEN, os.R_OK):
        return Runtime(SERVICE_FOLDER, shared=True)
    # Not by the variable alone: what cron starts, which has none, must meet what a desktop starts.
    for own in (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{os.getuid()}"):
        if own and os.access(own, os.W_OK | os.X_OK):
            return Runtime(Path(own).absolute() / "tactile")
    return Runtime(Path(tempfile.gettempdir()) / f"tactile-{os.getuid()}")


def _variable(runtime: Runtime) -> str:
    """Environment variable that moves this folder: the secret stays where the user's home is."""
    given = os.environ.get(RUNTIME_VARIABLE)
    here = given is not None and runtime.folder == Path(given).absolute()
    return RUNTIME_VARIABLE if here else "XDG_RUNTIME_DIR"


def prepare(runtime: Runtime) -> None:
    """Make the folder of the sockets, mode 0750, or refuse one that others can get into.

    `RuntimeFolderError` when it belongs to somebody else or cannot be made.
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
            folder.chmod(0o750)  # whatever the umask
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
    """The secret in this folder, made when there is none: its file, and the secret itself.

    `RuntimeFolderError` when it cannot be read, belongs to somebody else, or others can read it.
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
    """Write a new secret at once: whoever comes at the same time gets the first one's."""
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
    """File of a unix socket's endpoint, None for one of another kind."""
    if not endpoint.startswith(UNIX):
        return None
    return Path(endpoint.removeprefix(UNIX).partition("#")[0].partition("?")[0])


def check_socket_path(path: Path) -> None:
    """`RuntimeFolderError` when no socket can be had at ``path``."""
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
    """Held while a process listens at a socket, until its session has closed for good.

    zenoh's own lock is let go before its socket is deleted, so that a process which comes between
    would listen at a file that is gone.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(path.name + ".held")
        self._file: int | None = None

    def acquire(self) -> bool:
        """Take it; False when another process has it. OSError when the folder does not allow it."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            return False
        self._file = file
        return True

    def release(self) -> None:
        """Let it go. The file stays: to delete it would let two hold locks of one name."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def listener_of(path: Path) -> int | None:
    """Process that listens at a unix socket, None when nobody does or the system does not say."""
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
