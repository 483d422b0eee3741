"""Draw the structure of the code from its imports, for ``docs/architecture.md``.

``python -m tactile_tools.dev.architecture docs/pictures`` writes ``floors.svg`` (packages, their
subpackages and who imports whom), ``sample.svg`` and ``twist.svg`` (the files that a taxel sample
and a twist pass through). It refuses a file there that does not exist or that nothing imports.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = {
    "sensor_proto": "sensor_proto",
    "tactile_core": "host/tactile_core",
    "tactiled": "host/tactiled",
    "reachd": "host/reachd",
    "armd": "host/armd",
    "sim_device": "sim_device",
    "tactile_reach": "host/tactile_reach",
    "tactile_tools": "tools/tactile_tools",
}
"""Every package that may exist, with its folder."""

SAMPLE = (
    ("tactiled.transports.serial_port", "bytes of a read"),
    ("tactiled.reader", "stamps a chunk, queues it"),
    ("tactiled.port", "one port: line, boards, log"),
    ("tactiled.boards.line", "which board on the port"),
    ("sensor_proto.framing", "frames from bytes"),
    ("sensor_proto.packets", "messages from frames"),
    ("tactiled.boards.board", "sequence, scale to µT"),
    ("tactiled.boards.clock", "board ticks to host time"),
    ("tactiled.board_session", "pipeline and counts of a board"),
    ("tactiled.sensing.pipeline", "one cycle of all arrays"),
    ("tactiled.sensing.health", "which taxels to trust"),
    ("tactiled.sensing.rest", "subtracts the rest field"),
    ("tactiled.sensing.consensus", "removes the ambient field"),
    ("tactiled.sensing.features", "forces to features"),
    ("tactiled.publisher", "to the bus and the log"),
)
"""Files that a taxel sample on a serial port passes through, in order."""

TWIST = (
    ("reachd.strategies.builtin", "wants a twist"),
    ("reachd.strategies.runner", "asks safely, catches faults"),
    ("reachd.trial", "homing, reaching, resetting"),
    ("reachd.control", "one cycle, one command"),
    ("reachd.gate.gate", "final check"),
    ("reachd.arms.bus_arm", "signs and sends to the arm"),
)
"""Files that a twist passes through from a strategy to the arm, in order."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Modules with their number of lines, and imports between modules."""

    lines: dict[str, int]
    imports: dict[str, frozenset[str]]


def read_structure(root: Path = ROOT) -> Structure:
    """Parse every module of every package below ``root``."""
    paths = {}
    for package, folder in PACKAGES.items():
        base = root / folder
        for path in sorted(base.rglob("*.py")):
            name = ".".join((package, *path.relative_to(base).with_suffix("").parts))
            paths[name.removesuffix(".__init__")] = path
    lines, imports = {}, {}
    for name, path in paths.items():
        text = path.read_text(encoding="utf-8")
        lines[name] = text.count("\n")
        imports[name] = frozenset(_imported(ast.parse(text), paths))
    return Structure(lines, imports)


def _imported(tree: ast.AST, known: Iterable[str]) -> Iterable[str]:
    names = set(known)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if whole in names:
                    yield whole
                elif node.module in names:
                    yield node.module


def room(module: str, structure: Structure) -> tuple[str, str]:
    """Package and room of a module; the room is "" for files directly in the package."""
    parts = module.split(".")
    if len(parts) > 1:
        inside = ".".join(parts[:2])
        if len(parts) > 2 or any(m.startswith(inside + ".") for m in structure.lines):
            return parts[0], parts[1]
    return parts[0], ""


def check_way(way: Sequence[tuple[str, str]], structure: Structure) -> None:
    """Check that every file of a way exists and that some module imports it.

    ValueError names the first that fails.
    """
    names = [name for name, _ in way]
    for name in names:
        if name not in structure.lines:
            raise ValueError(f"{name} does not exist")
        users = [m for m, used in structure.imports.items() if name in used]
        if not users:
            raise ValueError(f"nothing imports {name}")


STYLE = (
    "text{font-family:system-ui,sans-serif;font-size:13px;fill:#1d2733}"
    ".t{font-weight:600}.s{font-size:11px;fill:#5a6878}"
    ".p{fill:#eef2f6;stroke:#b8c4d0}.r{fill:#fff;stroke:#8aa0b4}"
    ".a{stroke:#4a6b8a;stroke-width:1.5;fill:none;marker-end:url(#m)}"
)
HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" role="img">'
    "<title>{title}</title><style>{style}</style>"
    '<defs><marker id="m" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
    'orient="auto"><path d="M0 0 8 4 0 8z" fill="#4a6b8a"/></marker></defs>'
    '<rect width="{w}" height="{h}" fill="#fff"/>'
)

FLOORS = (
    ("tactile_tools",),
    ("tactiled", "reachd", "sim_device", "tactile_reach"),
    ("armd",),
    ("tactile_core",),
    ("sensor_proto",),
)
WIDTH = 1120
MARGIN = 16
GAP = 14
FLOOR_GAP = 46
ROOM_HEIGHT = 24


def floors_svg(structure: Structure) -> str:
    """Packages on their floors, rooms with lines, an arrow for each import between packages."""
    rooms: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for module, count in structure.lines.items():
        package, inside = room(module, structure)
        rooms[package][inside] += count
    parts: list[str] = []
    boxes: dict[str, tuple[float, float, float, float]] = {}
    y = float(MARGIN)
    for floor in FLOORS:
        present = [p for p in floor if p in rooms]
        width = (WIDTH - 2 * MARGIN - GAP * (len(present) - 1)) / max(1, len(present))
        columns = max(1, int(width // 150))
        height = 34 + ROOM_HEIGHT * max(-(-len(rooms[p]) // columns) for p in present) + 8
        for index, package in enumerate(present):
            x = MARGIN + index * (width + GAP)
            boxes[package] = (x, y, width, height)
            total = sum(rooms[package].values())
            parts.append(f'<rect class="p" x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" ')
            parts.append(f'height="{height:.0f}" rx="6"/>')
            parts.append(
                f'<text class="t" x="{x + 10:.0f}" y="{y + 20:.0f}">{package} '
                f'<tspan class="s">{total:,} lines</tspan></text>'
            )
            cell = (width - 16) / columns
            for number, (name, count) in enumerate(sorted(rooms[package].items())):
                left = x + 8 + (number % columns) * cell
                top = y + 30 + (number // columns) * ROOM_HEIGHT
                parts.append(
                    f'<rect class="r" x="{left:.0f}" y="{top:.0f}" width="{cell - 6:.0f}" '
                    f'height="{ROOM_HEIGHT - 5}" rx="4"/>'
                    f'<text class="s" x="{left + 6:.0f}" y="{top + 13:.0f}">'
                    f"{escape(name or '(files)')} · {count:,}</text>"
                )
        y += height + FLOOR_GAP
    uses = {
        (room(a, structure)[0], room(b, structure)[0])
        for a, used in structure.imports.items()
        for b in used
    }
    incoming: dict[str, int] = defaultdict(int)
    for above, below in sorted(uses):
        if above == below:
            continue
        ax, ay, aw, ah = boxes[above]
        bx, by, bw, _ = boxes[below]
        if by <= ay:
            raise ValueError(f"{above} imports {below}, which is not below it")
        if by - (ay + ah) > FLOOR_GAP + 1:
            continue  # arrows past a whole floor would only hide the nearer ones
        start = min(max(ax + aw / 2, bx + 20), bx + bw - 20) if aw > bw else ax + aw / 2
        end = min(max(start, bx + 20), bx + bw - 20)
        incoming[below] += 1
        parts.append(f'<path class="a" d="M{start:.0f} {ay + ah:.0f} L{end:.0f} {by - 2:.0f}"/>')
    whole = round(y - FLOOR_GAP + MARGIN)
    title = "Packages, their rooms and what imports what"
    return HEAD.format(w=WIDTH, h=whole, title=title, style=STYLE) + "".join(parts) + "</svg>\n"


def way_svg(way: Sequence[tuple[str, str]], title: str) -> str:
    """Files of a way from left to right, row by row."""
    columns, width, height = 4, 262, 58
    parts = []
    for number, (name, job) in enumerate(way):
        row, column = divmod(number, columns)
        x, y = MARGIN + column * (width + GAP), MARGIN + row * (height + 26)
        package, _, rest = name.partition(".")
        parts.append(
            f'<rect class="r" x="{x}" y="{y}" width="{width}" height="{height}" rx="6"/>'
            f'<text class="t" x="{x + 10}" y="{y + 22}">{number + 1}. {escape(rest)} '
            f'<tspan class="s">{package}</tspan></text>'
            f'<text class="s" x="{x + 10}" y="{y + 43}">{escape(job)}</text>'
        )
        if number + 1 < len(way):
            if column + 1 < columns:
                parts.append(f'<path class="a" d="M{x + width} {y + height // 2} h{GAP - 1}"/>')
            else:
                below = y + height + 13
                parts.append(
                    f'<path class="a" d="M{x + width // 2} {y + height} V{below} '
                    f'H{MARGIN + width // 2} V{y + height + 25}"/>'
                )
    rows = -(-len(way) // columns)
    size = MARGIN * 2 + columns * width + (columns - 1) * GAP
    head = HEAD.format(w=size, h=MARGIN * 2 + rows * (height + 26) - 26, title=title, style=STYLE)
    return head + "".join(parts) + "</svg>\n"


def pictures(structure: Structure) -> dict[str, str]:
    """Pictures as SVG, by file name."""
    for way in (SAMPLE, TWIST):
        check_way(way, structure)
    return {
        "floors.svg": floors_svg(structure),
        "sample.svg": way_svg(SAMPLE, "The way of a taxel sample"),
        "twist.svg": way_svg(TWIST, "The way of a twist"),
    }


def main(argv: Sequence[str]) -> int:
    """Write the pictures into a folder."""
    if len(argv) != 1:
        print("usage: python -m tactile_tools.dev.architecture FOLDER", file=sys.stderr)
        return 2
    folder = Path(argv[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, svg in pictures(read_structure()).items():
        (folder / name).write_text(svg, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
