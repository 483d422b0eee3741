"""Real processes: a scripted board, a tactiled and a page; and a browser, if there is one."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

import tactile_reach as tr
from tests.support.paths import ROOT
from tests.support.waiting import PATIENCE_S

SLOW_S = PATIENCE_S
CHROMIUM = Path("/usr/bin/chromium")


def wait_until(done: Callable[[], Any], seconds: float = SLOW_S) -> Any:
    end = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)
    return found


class Process:
    """A command with its output in a file."""

    def __init__(self, folder: Path, words: list[str], *, stdin: int | None = None) -> None:
        self.output = folder / f"{Path(words[0]).name}-{time.monotonic_ns()}.txt"
        with self.output.open("wb") as file:
            self.process = subprocess.Popen(
                words, stdout=file, stderr=subprocess.STDOUT, cwd=folder, stdin=stdin
            )

    @property
    def said(self) -> str:
        return self.output.read_text(errors="replace")

    def wait_for(self, text: str) -> str:
        wait_until(lambda: text in self.said or self.process.poll() is not None)
        assert text in self.said, self.said
        return self.said

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


def command(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


class Rig:
    """One fake board at ``pad``, one tactiled that calls it ``pad``, and any number of pages."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = f"unixsock-stream/{folder}/t.sock"
        self.processes: list[Process] = []
        self.board = self.start_board()
        self.daemon = self.start_daemon()

    def start(self, *words: str, stdin: int | None = None) -> Process:
        process = Process(self.folder, list(words), stdin=stdin)
        self.processes.append(process)
        return process

    def start_board(self) -> Process:
        pad = self.folder / "pad"
        board = self.start(sys.executable, str(ROOT / "examples/fake_board.py"), str(pad))
        wait_until(pad.is_symlink)
        return board

    def start_daemon(self, *more: str) -> Process:
        return self.start(
            command("tactiled"), "--port", "pad", "--board", "anyskin", "--name", "pad",
            "--listen", self.endpoint, "--log", "logs", "--wait",
            *more,
        )  # fmt: skip

    def page(self, *words: str) -> str:
        """Start a page; returns its address."""
        view = self.start(
            command("tactile"), "view", "--port", "0", "--connect", self.endpoint, *words
        )
        return view.wait_for("http://").strip().splitlines()[-1]

    def close(self) -> None:
        for process in self.processes:
            process.end()


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("view"))
    yield made
    made.close()


@pytest.fixture
def make_rig(tmp_path: Path) -> Iterator[Callable[[], Rig]]:
    made: list[Rig] = []

    def make() -> Rig:
        made.append(Rig(tmp_path))
        return made[-1]

    yield make
    for each in made:
        each.close()


class Viewer:
    """Does what a browser does: takes frames and reports which it has drawn."""

    def __init__(self, address: str, **options: Any) -> None:
        host = address.removeprefix("http://").partition("/")[0]
        self._stack = ExitStack()
        self.socket: ClientConnection = self._stack.enter_context(
            connect(f"ws://{host}/live", **options)
        )
        self.said: list[dict[str, Any]] = []
        self.layout: dict[str, Any] = {}
        self.hello: dict[str, Any] = {}
        self.draws = True

    def close(self) -> None:
        self._stack.close()

    def next(self, seconds: float = SLOW_S) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self.socket.recv(timeout=seconds))
        self.layout = message.get("layout", self.layout)
        self.hello = message.get("hello", self.hello)
        if "frame" in message and self.draws:
            self.send(ack=message["frame"]["n"])
        return message

    def frame(self, good: Callable[[dict[str, Any]], bool] = lambda _: True) -> dict[str, Any]:
        """The next frame that is ``good``."""
        end = time.monotonic() + SLOW_S
        while time.monotonic() < end:
            frame = self.next().get("frame")
            if frame is not None and good(frame):
                return dict(frame)
        raise AssertionError("no such frame came")

    def ask(self, **words: Any) -> tuple[bool, str]:
        self.send(id=7, **words)
        while (message := self.next()).get("reply") != 7:
            pass
        return message["ok"], message["text"]

    def send(self, **words: Any) -> None:
        self.socket.send(json.dumps(words))


@pytest.fixture
def viewer() -> Iterator[Callable[..., Viewer]]:
    made: list[Viewer] = []

    def open_one(address: str, **options: Any) -> Viewer:
        made.append(Viewer(address, **options))
        return made[-1]

    yield open_one
    for each in made:
        each.close()


def streams(frame: dict[str, Any]) -> bool:
    board = frame["boards"].get("pad")
    return board is not None and board["state"] == "streaming" and board["force"] is not None


@pytest.fixture
def streaming() -> Callable[[dict[str, Any]], bool]:
    return streams


@pytest.fixture
def until() -> Callable[..., Any]:
    return wait_until


@pytest.fixture
def recording_of() -> Callable[[Any], dict[str, Any]]:
    """What a board's daemon says of its recording; asked again while it is starved."""

    def ask(board: Any) -> dict[str, Any]:
        def told() -> dict[str, Any]:
            with suppress(tr.RefusedError, tr.NotThereError):
                return dict(board.status()["recording"])
            return {}

        return dict(wait_until(told))

    return ask


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="no playwright: pip install 'tactile-reach[browser]'"
    )
    if not CHROMIUM.exists():
        pytest.skip(f"no browser at {CHROMIUM}: apt-get install chromium")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        yield found
        found.close()
