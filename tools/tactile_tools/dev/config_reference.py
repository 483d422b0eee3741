"""Write docs/configuration.md, the reference of every configuration file, from the schemas."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from armd.config import ArmConfig
from reachd.gate.workspace import Region
from reachd.settings import ConfigFile as ReachFile
from reachd.strategies.parameters import SETS
from sim_device.skin.indenter import ScriptFile
from tactile_core.bus.keys import RolesFile
from tactile_core.calibration.file import CalibrationFile
from tactile_core.config import Key, Section, describe, written
from tactile_tools.train.settings import Settings as TrainFile
from tactiled.settings import ConfigFile as SkinFile

HEAD = """# Configuration

*Made from the code by `make docs-reference`; change the schemas, not this page.*

Every file is TOML. A file that cannot be used is refused before anything is opened: the command \
prints one sentence with file, line, key, what was found and what is allowed, and ends with 2. \
Numbers are finite; a whole number may stand where a number is asked for. Flags win over the file. \
Files of version 0.1 are read as they are.
""".replace(" \\\n", " ")

FILES: tuple[tuple[str, str, type], ...] = (
    (
        "tactiled",
        "`tactiled --config FILE`; as a service `/etc/tactile/tactiled.toml`. "
        "`tactile log reprocess --config FILE` takes `[sensing]` and `[compensation]` from it.",
        SkinFile,
    ),
    (
        "reachd",
        "`reachd --config FILE`; as a service `/etc/tactile/reachd.toml`. Defaults in "
        f"`[parameters]` are those of the sets {' / '.join(SETS)}; the reason for each is beside "
        "it in `host/reachd/strategies/parameters.py`.",
        ReachFile,
    ),
    (
        "armd",
        "`armd --config FILE`, and `simdevice ur --config FILE`; see [arm.md](arm.md).",
        ArmConfig,
    ),
    (
        "Folder of keys",
        "`roles.toml`, which `tactile bus keys` writes; see [security.md](security.md).",
        RolesFile,
    ),
    (
        "Training",
        "`tactile train --config FILE`; see [learned.md](learned.md).",
        TrainFile,
    ),
    (
        "Press script",
        "`simdevice boards --press FILE`; examples are [press.toml](press.toml) and "
        "[press-anyskin.toml](press-anyskin.toml).",
        ScriptFile,
    ),
    (
        "Calibration",
        "`*.cal.toml`, written by `tactile calibrate fit` and `simdevice calibration`; numbers are "
        "exact decimals, so a file gives back the very numbers saved. What the models are: "
        "[calibration.md](calibration.md). Places are in m, fields in µT, forces in N.",
        CalibrationFile,
    ),
)

COLUMNS = ("Key", "Type", "Unit", "Range", "Default", "Meaning")


def render() -> str:
    """Text of the whole page."""
    parts = [HEAD, "\n".join(f"- [{t}](#{_anchor(t)})" for t, _, _ in FILES) + "\n"]
    seen: dict[Section, str] = {}
    for title, intro, schema in FILES:
        parts.append(f"## {title}\n\n{intro}\n")
        for section in describe(schema):
            if section in seen:
                first = seen[section]
                parts.append(f"### `{section.header}`\n\nAs for [{first}](#{_anchor(first)}).\n")
            else:
                parts.append(_section(section))
                seen[section] = title
    return "\n".join(parts)


def _anchor(title: str) -> str:
    return title.lower().replace(" ", "-")


def _section(section: Section) -> str:
    keys = [_with_sets(section.header, key) for key in section.keys]
    lines = []
    if section.header:
        meaning = re.sub(r"^``[^`]+``(?: of a model)?: ", "", section.meaning).replace("``", "`")
        meaning = re.sub(r"\b([a-z]+\.md)\b", r"[\1](\1)", meaning)
        lines += [f"### `{section.header}`", "", meaning[:1].upper() + meaning[1:], ""]
    if keys:
        lines += [_row(COLUMNS), _row(["---"] * len(COLUMNS))]
        lines += [_row(_cells(key)) for key in keys]
    return "\n".join(lines) + "\n"


def _cells(key: Key) -> list[str]:
    default = "**required**" if key.default is None else key.default and f"`{key.default}`"
    name = f"`{key.name}`"
    return [name, key.type, key.unit, _escaped(key.range), default, _escaped(key.meaning)]


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _with_sets(header: str, key: Key) -> Key:
    """``key`` with the defaults of the parameter sets, if it is one of theirs."""
    if not header.startswith("[parameters"):
        return key
    sets = [s.safety if header.endswith("safety]") else s for s in SETS.values()]
    values = [getattr(one, key.name) for one in sets]
    return replace(key, default=" / ".join(dict.fromkeys(map(_file_form, values))))


def _file_form(value: object) -> str:
    """Value of a parameter set as a file writes it."""
    if isinstance(value, Region):
        return written(value.corners)
    return written(sorted(map(str, value)) if isinstance(value, frozenset) else value)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page; with ``--check``, return 1 if it is out of date."""
    parser = argparse.ArgumentParser(prog="config_reference", description=__doc__)
    parser.add_argument("page", type=Path, help="docs/configuration.md")
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 if stale")
    options = parser.parse_args(argv)
    page: Path = options.page
    text = render()
    if options.check:
        if page.is_file() and page.read_text(encoding="utf-8") == text:
            return 0
        print(f"{page} is out of date: run make docs-reference", file=sys.stderr)
        return 1
    page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
