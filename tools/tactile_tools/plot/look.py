"""Look of pictures: sizes, titles, legends and files.

All text stays inside the picture and off its data, at any size and in any amount: a title is
wrapped, a legend stands above its axes in as many columns as fit.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Palette of Okabe and Ito, distinguishable in print and by colour-blind people."""

FORMATS = ("png", "pdf", "svg")
LEAST_DPI, MOST_DPI = 30, 600
"""A coarser picture cannot be read; a finer one takes a gigabyte."""

ENTRIES = 12
"""Names in one legend; further names are counted."""

HAIR_SPACE = "\u200a"

UNIT = re.compile(r"(?<=\d) (?=(?:s|N|mm|ms|Hz|µT|cycles|taxels|lost)\b)")
"""Space between a number and its unit, where lines are not broken."""


@dataclass(frozen=True, slots=True)
class Look:
    """One size of picture. ``width_in``: inches. ``font_pt``: ordinary text, points.

    ``row_in``: height of one row of curves, inches. ``narrow``: panels stand below one another.
    ``dpi``: dots per inch, unless the user gives another number.
    """

    width_in: float
    font_pt: float
    row_in: float
    narrow: bool
    dpi: int

    @property
    def thin(self) -> float:
        """Factor on line widths."""
        return self.font_pt / 10.0

    @property
    def line_in(self) -> float:
        """Height of a line of text, inches."""
        return 1.45 * self.font_pt / 72.0


LOOKS: Final = {
    "screen": Look(14.0, 10.0, 2.3, False, 100),
    "page": Look(7.1, 7.0, 1.25, False, 300),
    "column": Look(3.5, 6.5, 1.0, True, 300),
}
"""``page`` and ``column``: 180 and 89 mm, the two widths of a paper in two columns."""

SCREEN: Final = LOOKS["screen"]


def plain(text: str) -> str:
    """Return ``text`` with invisible characters replaced."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def width_pt(text: str, size_pt: float) -> float:
    """Width of a line of text, points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    with _quiet():
        width, _, _ = text_to_path.get_text_width_height_descent(
            text, FontProperties(size=size_pt), ismath=False
        )
    return float(width)


def shortened(text: str, room_pt: float, size_pt: float) -> str:
    """Return ``text``, cut with … if it is wider than ``room_pt``."""
    if width_pt(text, size_pt) <= room_pt:
        return text
    low, high = 0, len(text)
    while low < high:
        middle = (low + high + 1) // 2
        if width_pt(text[:middle] + "…", size_pt) <= room_pt:
            low = middle
        else:
            high = middle - 1
    return text[:low].rstrip() + "…"


def wrapped(text: str, room_pt: float, size_pt: float, most: int) -> str:
    """Break ``text`` into at most ``most`` lines no wider than ``room_pt``; the rest becomes …."""
    lines: list[str] = []
    words = text.split(" ")
    while words and len(lines) < most:
        if len(lines) == most - 1:
            lines.append(shortened(" ".join(words), room_pt, size_pt))
            break
        count = 1
        while count < len(words) and width_pt(" ".join(words[: count + 1]), size_pt) <= room_pt:
            count += 1
        lines.append(shortened(" ".join(words[:count]), room_pt, size_pt))
        words = words[count:]
    return "\n".join(lines)


class Sheet:
    """A figure being drawn; `save` adds the legends and writes it."""

    def __init__(self, look: Look, height_in: float, title: str) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.look = look
        size = 1.25 * look.font_pt
        said = wrapped(UNIT.sub("\u00a0", plain(title)), 72.0 * look.width_in * 0.97, size, 3)
        height = height_in + said.count("\n") * look.line_in * 1.3
        self.figure: Any = Figure(figsize=(look.width_in, height), layout="constrained")
        FigureCanvasAgg(self.figure)
        pad = 0.04 * look.font_pt / 10.0
        engine: Any = self.figure.get_layout_engine()
        engine.set(w_pad=pad, h_pad=pad)
        self.figure.suptitle(said, fontsize=size)
        self._legends: list[tuple[Axes, str]] = []
        self._deferred: list[Callable[[], None]] = []
        self._keys: list[tuple[Any, str]] = []

    def legend(self, axes: Axes, title: str = "") -> None:
        """Name the labelled curves of ``axes`` above it, once its width is known."""
        self._legends.append((axes, title))

    def key(self, handle: Any, text: str) -> None:
        """Explain ``handle`` (a patch, a line) below everything else."""
        self._keys.append((handle, text))

    def defer(self, draw: Callable[[], None]) -> None:
        """Call ``draw`` once all sizes are known."""
        self._deferred.append(draw)

    def finish(self) -> Any:
        """Return the figure with everything in place."""
        self._explain()
        engine: Any = self.figure.get_layout_engine()
        with _quiet():
            engine.execute(self.figure)
        for draw in self._deferred:
            draw()
        more = sum(self._place_legend(axes, title) for axes, title in self._legends)
        width, height = self.figure.get_size_inches()
        self.figure.set_size_inches(width, height + more * self.look.line_in)
        self._deferred.clear()
        self._legends.clear()
        return self.figure

    def save(self, out: Path, dpi: int | None = None) -> None:
        """Write the picture in the format of its suffix."""
        self.finish()
        metadata: dict[str, Any] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(
            out.suffix.lower().lstrip("."), {}
        )
        with _quiet():
            self.figure.savefig(out, dpi=dpi or self.look.dpi, metadata=metadata)

    def _explain(self) -> None:
        if not self._keys:
            return
        size = 0.85 * self.look.font_pt
        room = 72.0 * self.look.width_in - 5.0 * size
        handles = [handle for handle, _ in self._keys]
        texts = [wrapped(text, room, size, 2) for _, text in self._keys]
        width, height = self.figure.get_size_inches()
        lines = sum(1 + text.count("\n") for text in texts)
        self.figure.set_size_inches(width, height + lines * self.look.line_in)
        self.figure.legend(
            handles, texts, loc="outside lower left",
            fontsize=size, frameon=False, borderpad=0.1, labelspacing=0.3,
        )  # fmt: skip
        self._keys.clear()

    def _place_legend(self, axes: Axes, title: str) -> int:
        """Draw the legend; returns its lines beyond the first."""
        handles, labels = axes.get_legend_handles_labels()
        if not handles:
            return 0
        size = 0.85 * self.look.font_pt
        more = len(handles) - ENTRIES
        if more > 0:
            handles, labels = handles[:ENTRIES], labels[:ENTRIES]
            title = f"{title} and {more} more".strip()
        room = axes.get_window_extent().width * 72.0 / self.figure.dpi
        around = 4.0 * size  # a line, and the gap between two entries
        labels = [shortened(label, room - around, size) for label in labels]
        widest = max(width_pt(label, size) for label in labels)
        columns = max(1, min(len(labels), int(room / (widest + around))))
        axes.legend(
            handles, labels, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns,
            fontsize=size, frameon=False, borderaxespad=0.2, borderpad=0.1, handlelength=1.8,
            handletextpad=0.5, columnspacing=1.2, labelspacing=0.25, title=title or None,
            title_fontsize=size, alignment="left",
        )  # fmt: skip
        return (len(labels) - 1) // columns + bool(title)


def named(name: str) -> str:
    """Return ``name`` as a label: matplotlib leaves out one that begins with an underscore."""
    text = plain(name)
    return HAIR_SPACE + text if text.startswith("_") else text


@contextmanager
def styled(look: Look) -> Iterator[None]:
    """Draw with the sizes of ``look`` inside the block, and show text literally."""
    import matplotlib as mpl  # takes 0.3 s: import it only when a picture is wanted

    thin = look.thin
    settings: Any = {
        "font.size": look.font_pt,
        "axes.titlesize": look.font_pt,
        "axes.labelsize": 0.95 * look.font_pt,
        "xtick.labelsize": 0.9 * look.font_pt,
        "ytick.labelsize": 0.9 * look.font_pt,
        "legend.fontsize": 0.85 * look.font_pt,
        "axes.linewidth": 0.8 * thin,
        "grid.linewidth": 0.8 * thin,
        "grid.alpha": 0.25,
        "lines.linewidth": 1.1 * thin,
        "patch.linewidth": 0.9 * thin,
        **{f"{a}tick.major.size": 3.5 * thin for a in "xy"},
        **{f"{a}tick.major.width": 0.8 * thin for a in "xy"},
        **{f"{a}tick.major.pad": 3.5 * thin for a in "xy"},
        "text.hinting": "none",  # as wide as measured, at any size
        "text.parse_math": False,  # a name may hold a dollar
        "pdf.fonttype": 42,
        "svg.hashsalt": "tactile",
    }
    with mpl.rc_context(settings):
        yield


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings about letters that the font lacks: they appear as boxes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def plain_ticks(axis: Any, low: float, high: float) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10 …, fewer where there are many decades."""
    import math

    low, high = max(low, 1e-6), max(high, 1e-5)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if len(decades) <= 3 else (1,)
    ticks = [s * 10.0**d for d in decades for s in steps if low <= s * 10.0**d <= high]
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def show_text(axes: Axes, text: str) -> None:
    """Write ``text`` in the middle of ``axes``, which are otherwise empty."""
    axes.set_yticks([])
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color="0.4")


def of_several(what: str, which: str, names: Sequence[str], most: int = 6) -> str:
    """Return "board left (of 2: left, right)", or "board left" if there is only one."""
    if len(names) < 2:
        return f"{what} {which}"
    told = ", ".join(names[:most]) + (", …" if len(names) > most else "")
    return f"{what} {which} (of {len(names)}: {told})"
