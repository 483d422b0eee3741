"""The live page beside the daemon (``--view``): a process of its own, which ends with it.

It joins the bus as any tool does, so whatever the page costs is not taken from the pipeline.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from tactile_core.bus.session import BusConfig

END_S = 3.0
"""For the page to end in order."""


class PageError(Exception):
    """The page cannot be opened; the text names the remedy."""


class PageProcess:
    """``tactile view`` on the bus of this daemon; `PageError` when the command is not there.

    The page ends when its standard input does: also when this process is killed.
    """

    def __init__(self, port: int, bus: BusConfig) -> None:
        beside = Path(sys.executable).with_name("tactile")
        command = str(beside) if beside.exists() else shutil.which("tactile")
        if command is None:
            raise PageError("--view needs the command `tactile`: install the whole package")
        words = [command, "view", "--port", str(port), "--until-stdin-ends"]
        # Also those whom a tool meets by itself: the page shows arm and reach, too.
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
