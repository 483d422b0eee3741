"""``tactile plot``: draw from a log what a skin felt and how a reach went."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_core.cli import progress, require, working
from tactile_tools.log.sources import find_series
from tactile_tools.log.terminal import ToolError

if TYPE_CHECKING:
    from tactile_tools.plot.series import BoardSeries

WHATS = ("reach", "taxels", "forces", "field", "timing")


def run(options: argparse.Namespace) -> int:
    """Draw. Exit status 0: the picture was written; 2: bad argument; 3: unreadable log."""
    from tactile_core.log.records import LogError
    from tactile_tools.plot.series import LogUnreadableError

    require("matplotlib", "scipy", extra="plot")
    try:
        first = find_series(options.files)[0].paths[0]
        out = options.out or first.with_suffix(f".{options.format or 'png'}")
        _check_output(out, options)
        remark = _draw(options, out)
    except ToolError as error:
        return _complain(str(error), error.code)
    except LogError as error:
        missing = isinstance(error.__cause__, FileNotFoundError)
        return _complain(str(error), 2 if missing else 3)
    except LogUnreadableError as error:
        return _complain(str(error), 3)
    except OSError as error:
        return _complain(f"cannot write {out}: {error.strerror}; name another with --out", 3)
    if remark:
        print(remark)
    print(f"wrote {out}")
    return 0


def _complain(text: str, code: int) -> int:
    print(f"tactile plot: {text}", file=sys.stderr)
    return code


def _check_output(out: Path, options: argparse.Namespace) -> None:
    """Refuse an output that matplotlib could not write, before the log is read."""
    from tactile_tools.plot.look import LEAST_DPI, MOST_DPI

    allowed = (".png", ".pdf", ".svg", ".jpg", ".jpeg")
    suffix = out.suffix.lower()
    if suffix not in allowed:
        raise ToolError(f"--out {out}; allowed: a file that ends in {', '.join(allowed)}")
    if options.format is not None and suffix != f".{options.format}":
        raise ToolError(f"--format {options.format} and --out {out} say two things; give one")
    if options.dpi is not None and not LEAST_DPI <= options.dpi <= MOST_DPI:
        raise ToolError(f"--dpi {options.dpi}; allowed: {LEAST_DPI} to {MOST_DPI}")
    if out.is_dir() or any(out == source for source in options.files):
        raise ToolError(f"--out {out} is a folder or the log itself: name another file")
    if not out.parent.is_dir():
        raise ToolError(f"--out {out}: no such folder: {out.parent}")


def _draw(options: argparse.Namespace, out: Path) -> str:
    """Draw; returns what else could have been chosen, in words, or ""."""
    of_reach = options.reach is not None or options.arm is not None
    if of_reach and options.what not in (None, "reach"):
        raise ToolError(f"--reach and --arm are of a reach: leave them out with {options.what}")
    if options.what in (None, "reach"):
        remark = _draw_reach(options, out, must=of_reach or options.what == "reach")
        if remark is not None:
            return remark
    return _draw_skin(options, out)


def _draw_skin(options: argparse.Namespace, out: Path) -> str:
    from tactile_tools.plot.curves import draw_field, draw_forces, draw_timing
    from tactile_tools.plot.look import LOOKS, of_several
    from tactile_tools.plot.series import read_boards
    from tactile_tools.plot.skin import draw, draw_taxels

    with progress("reading") as report:
        boards = read_boards(options.files, report)
    held = sorted(boards)
    if options.board is not None and options.board not in boards:
        raise ToolError(f"no board {options.board!r} in the log; it holds {', '.join(held)}")
    name = options.board or max(held, key=lambda n: boards[n].force[0].size)
    board: BoardSeries = boards[name]
    for at in options.at or ():
        if not board.first - 1.0 <= at <= board.last + 1.0:
            raise ToolError(
                f"--at {at:g}; the log of {name} goes from {board.first:.2f} to {board.last:.2f} s"
            )
    look = LOOKS[options.width]
    title = of_several("board", name, held) if len(held) > 1 else ""
    style: dict[str, Any] = {"look": look, "dpi": options.dpi, "title": title}
    drawers: dict[str, Callable[[], Any]] = {
        "taxels": lambda: draw_taxels(board, out, at=options.at, **style),
        "forces": lambda: draw_forces(board, out, **style),
        "field": lambda: draw_field(board, out, **style),
        "timing": lambda: draw_timing(board, out, **style),
    }
    with working("drawing"):
        if options.what in drawers:
            drawers[options.what]()
        else:
            draw(board, out, at=options.at[0] if options.at else None, **style)
    if len(held) == 1 or options.board is not None:
        return ""
    return f"drawn: {of_several('board', name, held, most=len(held))}; choose with --board"


def _draw_reach(options: argparse.Namespace, out: Path, *, must: bool) -> str | None:
    """Draw a reach. Returns None when the log holds none, which is an error only with ``must``."""
    from tactile_tools.plot.look import LOOKS, of_several
    from tactile_tools.plot.reach import draw
    from tactile_tools.plot.reach_series import listed, read_reach
    from tactile_tools.plot.series import LogUnreadableError

    try:
        with working("reading"):
            reach = read_reach(options.files, options.reach, options.board, options.arm)
    except LogUnreadableError:
        if must:
            raise
        return None
    with working("drawing"):
        draw(reach, out, LOOKS[options.width], options.dpi)
    said = []
    if len(reach.all_reaches) > 1 and options.reach is None:
        said.append(
            f"drawn: reach {reach.number} of {len(reach.all_reaches)}; choose with --reach\n"
            + listed(reach.all_reaches)
        )
    for what, flag, asked, name, held in (
        ("board", "--board", options.board, reach.board_name, reach.boards),
        ("arm", "--arm", options.arm, reach.arm_name, reach.arms),
    ):
        if len(held) > 1 and asked is None:
            names = sorted(held)
            said.append(f"drawn: {of_several(what, name, names, len(names))}; choose with {flag}")
    return "\n".join(said)
