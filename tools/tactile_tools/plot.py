"""``tactile plot``: what a skin felt, from a log, in one picture."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_tools.series import BoardSeries, LogUnreadableError, read_boards

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's palette: told apart in print and by the colour-blind."""

SHEAR_ARROW_MM_PER_N = 4.0
CIRCLE_AREA_PER_N = 320.0  # points², so that 1 N is a circle about as wide as the pitch
SHOWN_FROM_N = 0.1  # noise of a taxel is about 0.03 N


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``plot`` to the umbrella command."""
    parser = subparsers.add_parser(
        "plot",
        help="draw taxel maps, forces and the field removed from a log",
        description="Draw what a board felt: taxel maps at the strongest moment (circles: normal "
        "force, arrows: shear), forces over time, ambient field removed, latency.",
    )
    parser.add_argument("file", type=Path, help="MCAP log of tactiled, whole or cut off")
    parser.add_argument("--out", type=Path, help="PNG to write (default: FILE with .png)")
    parser.add_argument(
        "--what",
        choices=("auto", "taxels", "reach"),
        default="auto",
        help="the skin, or a reach from above (default: a reach if the log holds one)",
    )
    parser.add_argument("--name", help="board to draw (default: the one with the most taxels)")
    parser.add_argument(
        "--at", type=float, metavar="S", help="moment of the taxel maps, s (default: strongest)"
    )
    parser.set_defaults(func=run)


def run(options: argparse.Namespace) -> int:
    """Draw; 0 when the picture was written, 2 for a bad argument, 3 for an unreadable log."""
    out = options.out or options.file.with_suffix(".png")
    try:
        if options.what != "taxels" and _drew_reach(options.file, out, options.what == "reach"):
            print(f"wrote {out}")
            return 0
        boards = read_boards(options.file)
        if options.name is not None and options.name not in boards:
            print(
                f"tactile plot: no board {options.name!r} in {options.file}; "
                f"it holds {', '.join(sorted(boards))}",
                file=sys.stderr,
            )
            return 2
        name = options.name or max(boards, key=lambda n: boards[n].force[0].size)
        draw(boards[name], out, at=options.at)
    except LogUnreadableError as error:
        print(f"tactile plot: {error}", file=sys.stderr)
        return 3
    except OSError as error:
        print(f"tactile plot: cannot write {out}: {error.strerror}", file=sys.stderr)
        return 3
    print(f"wrote {out}")
    return 0


def _drew_reach(path: Path, out: Path, must: bool) -> bool:
    """Draw the reach in a log; False when it holds none, which is an error only if it must."""
    from tactile_tools.plot_reach import draw_reach

    try:
        draw_reach(path, out)
    except LogUnreadableError:
        if must:
            raise
        return False
    return True


def draw(
    board: BoardSeries,
    out: Path,
    *,
    at: float | None = None,
    applied: tuple[Any, Any] | None = None,
) -> None:
    """Write the picture of one board. ``applied``: times (s) and forces (N) known to be true."""
    import matplotlib as mpl  # 0.3 s: not before a picture is really wanted

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    time = np.asarray(board.time)
    contact = board.contact_force()
    felt = np.asarray(board.feature_time)
    if at is None:
        at = float(felt[contact.sum(axis=1).argmax()]) if len(felt) else float(time[0])
    moment = int(np.abs(time - at).argmin())
    arrays = board.array_slices()
    figure = plt.figure(figsize=(13, 11), layout="constrained")
    figure.suptitle(
        f"{board.name}: {len(time)} cycles in {time[-1] - time[0]:.1f} s, "
        f"{board.force[0].shape[0]} taxels",
        fontsize=14,
    )
    rows = figure.add_gridspec(4, 1, height_ratios=(1.35, 1, 1, 0.7))
    maps = rows[0].subgridspec(1, len(arrays))
    for index, (label, taxels) in enumerate(arrays):
        _taxel_map(figure.add_subplot(maps[index]), board, moment, label, taxels)
    forces = figure.add_subplot(rows[1])
    _forces(forces, felt, contact, [n for n, _ in arrays], at, applied)
    _ambient(figure.add_subplot(rows[2], sharex=forces), board, [n for n, _ in arrays])
    _timing(figure.add_subplot(rows[3], sharex=forces), board)
    figure.savefig(out, dpi=110)
    plt.close(figure)


def _taxel_map(axes: Axes, board: BoardSeries, moment: int, label: str, taxels: slice) -> None:
    surface = np.asarray(board.geometry.surface).reshape(-1, 2)[taxels] * 1e3
    force = board.force[moment][taxels]
    healthy = np.isfinite(force).all(axis=1)
    normal = np.where(-force[:, 2] > SHOWN_FROM_N, -force[:, 2], 0.0)
    axes.scatter(surface[healthy, 0], surface[healthy, 1], s=6, color="0.75", zorder=1)
    axes.scatter(surface[~healthy, 0], surface[~healthy, 1], s=40, color="crimson", marker="x")
    axes.scatter(
        surface[healthy, 0],
        surface[healthy, 1],
        s=CIRCLE_AREA_PER_N * normal[healthy],
        color=COLOURS[0],
        alpha=0.45,
        zorder=2,
    )
    strong = healthy & (np.linalg.norm(np.nan_to_num(force[:, :2]), axis=1) > SHOWN_FROM_N)
    if strong.any():
        axes.quiver(
            *surface[strong].T,
            *(force[strong, :2] * SHEAR_ARROW_MM_PER_N).T,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.008,
            color=COLOURS[1],
            zorder=3,
        )
    pad = 10.0
    axes.set_xlim(surface[:, 0].min() - pad, surface[:, 0].max() + pad)
    axes.set_ylim(surface[:, 1].min() - pad, surface[:, 1].max() + pad)
    axes.set_aspect("equal")
    total = float(normal[healthy].sum())
    axes.scatter(
        [surface[:, 0].max() + pad * 0.3],
        [surface[:, 1].min() - pad * 0.4],
        s=CIRCLE_AREA_PER_N,
        facecolors="none",
        edgecolors="0.4",
    )
    axes.annotate(
        "1 N",
        (surface[:, 0].max() + pad * 0.3, surface[:, 1].min() - pad * 0.4),
        ha="center",
        va="center",
        fontsize=7,
        color="0.3",
    )
    axes.set_title(f"{label}: {total:.2f} N at {board.time[moment]:.2f} s", fontsize=10)
    axes.set_xlabel("along the skin, mm")
    axes.set_ylabel("mm")


def _forces(
    axes: Axes,
    time: Any,
    contact: Any,
    labels: list[str],
    moment: float,
    applied: tuple[Any, Any] | None,
) -> None:
    for index, label in enumerate(labels):
        axes.plot(time, contact[:, index], color=COLOURS[index % 6], lw=1.2, label=label)
    if applied is not None:
        axes.plot(*applied, color="black", ls="--", lw=1.0, label="really applied")
    axes.axvline(moment, color="0.6", lw=0.8, ls=":")
    axes.set_ylabel("contact force, N\n(normal, summed)")
    axes.legend(loc="upper right", ncols=5, fontsize=8)
    axes.grid(alpha=0.25)


def _ambient(axes: Axes, board: BoardSeries, labels: list[str]) -> None:
    axes.set_ylabel("ambient removed, µT")
    axes.grid(alpha=0.25)
    if not board.ambient:
        axes.text(0.5, 0.5, "compensation was off", transform=axes.transAxes, ha="center")
        return
    plane = np.stack([np.asarray(m.plane, float).reshape(-1, 3, 3) for m in board.ambient])
    valid = np.stack([np.asarray(m.valid, bool) for m in board.ambient])
    for component, name in enumerate("xyz"):
        for index, label in enumerate(labels):
            axes.plot(
                board.ambient_time,
                np.where(valid[:, index], plane[:, index, component, 0], np.nan),
                color=COLOURS[component],
                ls=("-", "--", ":")[index % 3],
                lw=1.0,
                label=f"{name} {label}",
            )
    axes.legend(loc="upper right", ncols=3, fontsize=7)


def _timing(axes: Axes, board: BoardSeries) -> None:
    axes.plot(board.time, np.asarray(board.latency) * 1e3, color=COLOURS[0], lw=0.8)
    axes.set_ylabel("captured → received, ms", fontsize=8)
    axes.set_xlabel("time, s")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    refused = [t for t, f in zip(board.feature_time, board.features, strict=True) if not f.valid]
    if refused:
        axes.plot(refused, np.zeros(len(refused)), "x", color="crimson", label="features invalid")
        axes.legend(loc="upper right", fontsize=8)
