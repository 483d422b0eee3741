"""Run our commands as processes with their output in a file; always ended after the test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.support.waiting import PATIENCE_S, wait_until


def command(name: str) -> str:
    """Return the path of one of our commands, installed beside this Python."""
    return str(Path(sys.executable).with_name(name))


class Program:
    """A process that runs in ``folder`` with its output in a file there."""

    def __init__(self, folder: Path, words: Sequence[str], **environment: str) -> None:
        self.words = tuple(words)
        self.output = folder / f"{time.monotonic_ns()}.txt"
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                list(words),
                stdout=file, stderr=subprocess.STDOUT, cwd=folder,
                env=os.environ | {"COLUMNS": "200"} | environment,
            )  # fmt: skip

    @property
    def said(self) -> str:
        return self.output.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        return self.process.wait(timeout_s)

    def wait_for_text(self, text: str) -> None:
        wait_until(lambda: text in self.said or not self.running)
        assert text in self.said, self.said

    def wait_for_file(self, path: Path) -> None:
        wait_until(lambda: path.exists() or not self.running)
        assert self.running, self.said

    def end(self) -> None:
        if self.running:
            self.process.kill()
        self.process.wait()
