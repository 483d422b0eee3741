"""What daemons say to people: log lines, and a few figures put the same way everywhere."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from rich.console import Console
from rich.logging import RichHandler

from tactile_bus.recorder import Recorder


def set_up_logging(console: Console, *, verbose: bool) -> None:
    """Log above the live lines of a terminal, or plain lines with their time elsewhere."""
    level = logging.DEBUG if verbose else logging.INFO
    if console.is_terminal:
        handler: logging.Handler = RichHandler(
            console=console, show_path=False, rich_tracebacks=False, markup=False
        )
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


def drops_text(drops: Mapping[str, int]) -> str:
    """Counts by reason, the largest first."""
    if not drops:
        return "0"
    ordered = sorted(drops.items(), key=lambda item: -item[1])
    shown = " ".join(f"{reason}={n}" for reason, n in ordered[:4])
    return f"{shown} …" if len(ordered) > 4 else shown


def describe_log(recorder: Recorder) -> str:
    """State of the log in one line."""
    stats = recorder.stats
    text = f"{stats.path}  {stats.bytes_written / 1e6:.1f} MB"
    if stats.state != "recording":
        text += f"  {stats.state.upper()} {stats.last_error}"
    if stats.dropped:
        text += f"  dropped {drops_text(stats.dropped)}"
    return text
