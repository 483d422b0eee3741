"""``tactile calibrate record``: the wizard on a running tactiled, or on a port of its own."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from tactile_core.bus.session import BusConfig, BusError, close_session, open_session
from tactile_core.cli import REFUSED
from tactile_core.log.recorder import Recorder, RecorderError, RecorderSettings
from tactile_core.options import BusTable, bus_config
from tactile_tools.calibrate.actions import ActionError
from tactile_tools.calibrate.live import LiveBoard, refuse_existing
from tactile_tools.calibrate.wizard import Timing, Wizard, WizardError
from tactile_tools.processes import command, running, socket_at


def record(options: argparse.Namespace) -> None:
    """Ask, record and write; `ActionError` when nothing was recorded that `fit` could use."""
    out: Path = options.out
    trouble = refuse_existing(out)
    if trouble is not None:
        raise ActionError(trouble)
    with contextlib.ExitStack() as stack:
        bus, ended = stack.enter_context(_bus(options))
        try:
            session = open_session(bus)
        except BusError as error:
            raise ActionError(str(error), REFUSED) from error
        stack.callback(close_session, session)
        try:
            recorder = Recorder(out, RecorderSettings())
        except RecorderError as error:
            raise ActionError(str(error), REFUSED) from error
        try:
            presses = _record(options, LiveBoard(session, recorder, options.board), ended)
        except WizardError as error:
            raise ActionError(str(error), REFUSED) from error
        except EOFError as error:
            raise ActionError("the answers ended before the recording did", REFUSED) from error
        finally:
            recorder.close(10.0)
        if recorder.stats.dropped:
            raise ActionError(f"the log is not whole: {recorder.stats.dropped}", REFUSED)
    pressed = "1 press" if presses == 1 else f"{presses} presses"
    print(f"wrote {out}: {pressed}; next: tactile calibrate fit {out} --out FILE.cal.toml")


def _record(options: argparse.Namespace, board: LiveBoard, ended: Callable[[], bool]) -> int:
    try:
        board.wait(ended)
        board.attach(board.calibration(options.calibration))
        timing = Timing(options.rest, options.hold, options.turn)
        width = shutil.get_terminal_size().columns
        wizard = Wizard(board, board.label, _ask, print, timing, width)
        return wizard.run()
    finally:
        board.close()


def _ask(question: str) -> str:
    """Ask and return what was typed. Questions are flushed for a program at the other end."""
    print(question, end="", flush=True)
    line = sys.stdin.readline()
    if not line:
        print()
        raise EOFError
    return line.rstrip("\n")


@contextlib.contextmanager
def _bus(options: argparse.Namespace) -> Iterator[tuple[BusConfig, Callable[[], bool]]]:
    """Yield the bus to listen on and a function that tells whether its tactiled has ended.

    With --port, tactiled is started here.
    """
    if options.port is None:
        yield bus_config(options, BusTable(), "tool"), lambda: False
        return
    with tempfile.TemporaryDirectory(prefix="tactile-record-") as folder:
        endpoint = socket_at(Path(folder), "tactiled")
        words = [command("tactiled"), "--port", options.port, "--name", options.board, "--no-log"]
        words += ["--kind", options.kind, "--listen", endpoint]
        if options.calibration is not None:
            words += ["--calibration", str(options.calibration)]
        said = Path(folder) / "tactiled"
        with running(words, said) as process:
            try:
                yield (
                    BusConfig(role="tool", connect=(endpoint,)),
                    lambda: process.poll() is not None,
                )
            except ActionError as error:
                if process.poll() is None:
                    raise
                last = said.read_text(errors="replace").strip().rpartition("\n")[2]
                raise ActionError(f"tactiled ended: {last}", REFUSED) from error
