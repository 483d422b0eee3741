"""Start our own commands from a tool, and end them in order."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

PORT_WAIT_S = 60.0  # s: a loaded machine needs some seconds to import numpy twice


def busy_text() -> str:
    """Return a sentence if the machine is busy (load above 1.5 times its cores), else ""."""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load < 1.5 * cores:
        return ""
    return f"the machine is busy (load {load:.1f} on {cores} cores): try again when it is not"


def free_port() -> int:
    """Return a TCP port of this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def socket_at(folder: Path, name: str) -> str:
    """Endpoint of a unix socket in ``folder``, so that our own rig does not meet other rigs.

    The folder must have a short path and be closed to other users, as those of `tempfile` are.
    """
    return f"unixsock-stream/{folder.absolute() / name}.sock"


def command(name: str) -> str:
    """Path of one of our commands beside the Python that runs; RuntimeError without it."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        raise RuntimeError(f"the command {name} is not installed beside {sys.executable}")
    return found


@contextlib.contextmanager
def running(words: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command in the background, its output in ``log``; SIGTERM ends it after the block."""
    with log.open("wb") as output:
        process = subprocess.Popen(words, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def wait_for(path: Path, process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait until ``path`` exists. RuntimeError with the program's output when it ends or hangs."""
    deadline = time.monotonic() + PORT_WAIT_S
    while not path.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            said = log.read_text(errors="replace").strip()
            raise RuntimeError(f"{path.name} has not appeared: {said or 'it printed nothing'}")
        time.sleep(0.05)
