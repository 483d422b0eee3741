"""``tactile plot``: what a skin felt and how a reach went, from a log, as a picture."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_tools.logs.sources import find_series
from tactile_tools.logs.terminal import ToolError, progress

if TYPE_CHECKING:
    from tactile_tools.plots.series import BoardSeries

WHATS = ("reach", "taxels", "forces", "field", "timing")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``plot`` to the umbrella command."""
    parser = subparsers.add_parser(
        "plot",
        help="draw a reach, taxel maps, forces, the field removed or the timing of a log",
        description="Draw a log. reach: the cupboard from above and what happened; taxels: maps of "
        "each side at the strongest moments (circles: normal force, arrows: shear); forces: "
        "features and events over time; field: what compensation removed; timing: clock and "
        "latency. No display is needed.",
    )
    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="MCAP log, whole or cut off; a folder; or the name that the files of a log share",
    )
    parser.add_argument("--out", type=Path, metavar="PNG", help="default: FILE with .png")
    parser.add_argument(
        "--what",
        choices=WHATS,
        help="default: the reach if the log holds one, else an overview of the skin",
    )
    parser.add_argument("--name", help="board to draw (default: the one with the most taxels)")
    parser.add_argument(
        "--at",
        type=float,
        action="append",
        metavar="S",
        help="moment of the taxel maps, s since the first cycle (default: the strongest); may be "
        "repeated",
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Draw; 0 when the picture was written, 2 for a bad argument, 3 for an unreadable log."""
    from tactile_bus.log_records import LogError
    from tactile_tools.plots.series import LogUnreadableError

    try:
        first = find_series(options.files)[0].paths[0]
        out = options.out or first.with_suffix(".png")
        _check_output(out, options.files)
        _draw(options, out)
    except ToolError as error:
        return _complain(str(error), error.code)
    except LogError as error:
        missing = isinstance(error.__cause__, FileNotFoundError)
        return _complain(str(error), 2 if missing else 3)
    except LogUnreadableError as error:
        return _complain(str(error), 3)
    except OSError as error:
        return _complain(f"cannot write {out}: {error.strerror}; name another with --out", 3)
    print(f"wrote {out}")
    return 0


def _complain(text: str, code: int) -> int:
    print(f"tactile plot: {text}", file=sys.stderr)
    return code


def _check_output(out: Path, sources: list[Path]) -> None:
    """Refuse what matplotlib could not write, before the log is read."""
    allowed = (".png", ".pdf", ".svg", ".jpg", ".jpeg")
    if out.suffix.lower() not in allowed:
        raise ToolError(f"--out {out}; allowed: a file that ends in {', '.join(allowed)}")
    if out.is_dir() or any(out == source for source in sources):
        raise ToolError(f"--out {out} is a folder or the log itself: name another file")
    if not out.parent.is_dir():
        raise ToolError(f"--out {out}: there is no folder {out.parent}")


def _draw(options: argparse.Namespace, out: Path) -> None:
    if options.what in (None, "reach") and _drew_reach(options.files, out, options.what == "reach"):
        return
    from tactile_tools.plots.curves import draw_field, draw_forces, draw_timing
    from tactile_tools.plots.series import read_boards
    from tactile_tools.plots.skin import draw, draw_taxels

    with progress("reading") as report:
        boards = read_boards(options.files, report)
    if options.name is not None and options.name not in boards:
        held = ", ".join(sorted(boards))
        raise ToolError(f"no board {options.name!r} in the log; it holds {held}")
    name = options.name or max(boards, key=lambda n: boards[n].force[0].size)
    board: BoardSeries = boards[name]
    for at in options.at or ():
        if not board.first - 1.0 <= at <= board.last + 1.0:
            raise ToolError(
                f"--at {at:g}; the log of {name} goes from {board.first:.2f} to {board.last:.2f} s"
            )
    drawers: dict[str, Callable[[], Any]] = {
        "taxels": lambda: draw_taxels(board, out, at=options.at),
        "forces": lambda: draw_forces(board, out),
        "field": lambda: draw_field(board, out),
        "timing": lambda: draw_timing(board, out),
    }
    if options.what in drawers:
        drawers[options.what]()
    else:
        draw(board, out, at=options.at[0] if options.at else None)


def _drew_reach(paths: list[Path], out: Path, must: bool) -> bool:
    """Draw the reach in a log; False when it holds none, which is an error only if it must."""
    from tactile_tools.plots.reach import draw_reach
    from tactile_tools.plots.series import LogUnreadableError

    try:
        draw_reach(paths, out)
    except LogUnreadableError:
        if must:
            raise
        return False
    return True
