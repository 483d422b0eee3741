"""Display of a running daemon."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console
from rich.table import Table

from tactile_core.cli import LiveLines
from tactile_core.log.recorder import Recorder


class Lines(LiveLines):
    ready = False

    def table(self) -> Table | None:
        if not self.ready:
            return None
        table = Table.grid()
        table.add_row("finger streaming")
        return table

    def lines(self) -> list[str]:
        return ["finger: streaming"]


@pytest.fixture
def recorder() -> Recorder:
    stats = SimpleNamespace(
        path="run.mcap",
        bytes_written=2_500_000,
        state="no_space",
        last_error="disk full",
        dropped={"queue": 3},
    )
    return cast(Recorder, SimpleNamespace(stats=stats))


def test_terminal_shows_rows_above_the_log(recorder: Recorder) -> None:
    out = io.StringIO()
    with Lines(Console(file=out, force_terminal=True, width=100), recorder) as lines:
        lines.show()
        assert "streaming" not in out.getvalue()  # nothing to show yet
        lines.ready = True
        lines.show()
    text = out.getvalue()
    shown = text.index("finger streaming")
    assert "run.mcap  2.5 MB  NO_SPACE disk full  dropped queue=3" in text[shown:]


def test_without_terminal_plain_lines_are_printed_periodically(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now: list[float] = [0.0]
    monkeypatch.setattr("tactile_core.cli.monotonic", lambda: now[0])
    out = io.StringIO()
    caplog.set_level("INFO")
    with Lines(Console(file=out), recorder) as lines:
        for step in range(60):
            now[0] = step * 0.2
            lines.show()
    assert (
        caplog.messages
        == [
            "finger: streaming",
            "log run.mcap  2.5 MB  NO_SPACE disk full  dropped queue=3",
        ]
        * 2
    )
    assert out.getvalue().strip() == ""
