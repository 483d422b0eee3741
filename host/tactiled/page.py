"""The live page (``--view``): a separate process that ends with the daemon.

It joins the bus like any tool, so the page takes no time from the pipeline.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from tactile_core.bus.session import BusConfig

END_S = 3.0
"""Time for the page to end by itself."""


class PageError(Exception):
    """The page cannot be opened; the text names the remedy."""


class PageProcess:
    """``tactile view`` on the bus of this daemon; `PageError` when the command is not installed.

    The page ends when its standard input closes, so also when this process is killed.
    """

    def __init__(self, port: int, bus: BusConfig) -> None:
        beside = Path(sys.executable).with_name("tactile")
        command = str(beside) if beside.exists() else shutil.which("tactile")
        if command is None:
            raise PageError("--view needs the command `tactile`: install the whole package")
        words = [command, "view", "--port", str(port), "--until-stdin-ends"]
        # Also a tool's default endpoints: the page shows arm and reach as well.
        default = BusConfig(role="tool", keys=bus.keys, tls=bus.tls, insecure=bus.insecure)
        endpoints = [*bus.listen_endpoints(), *(bus.connect or default.connect_endpoints())]
        for endpoint in dict.fromkeys(endpoints):
            words += ["--connect", endpoint]
        if bus.keys is not None:
            words += ["--keys", bus.keys]
        if bus.insecure:
            words.append("--insecure")
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE)

    def close(self) -> None:
        """End the page."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
