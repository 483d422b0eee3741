"""Find the logs that the user means: files, folders, or the name that files of one log share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tactile_core.log.reader import LogReader
from tactile_core.log.records import Block, LogError, MetadataRecord
from tactile_tools.log.terminal import ToolError, complain

FILE = "file"
"""Metadata record of our logs that says which file of which set this is."""


@dataclass(frozen=True, slots=True)
class Series:
    """Files of one log, in order. ``identity``: of the set, empty if unknown."""

    paths: tuple[Path, ...]
    identity: str = ""
    first: int = 0

    @property
    def name(self) -> str:
        """Name of the log for the user."""
        more = f" and {len(self.paths) - 1} more" if len(self.paths) > 1 else ""
        return f"{self.paths[0]}{more}"

    @property
    def size(self) -> int:
        """Size of all files, bytes."""
        return sum(path.stat().st_size for path in self.paths)


@dataclass(frozen=True, slots=True)
class _Place:
    path: Path
    identity: str
    number: int


def find_series(given: Sequence[Path]) -> list[Series]:
    """Find the logs that the arguments name; files of one log are put together in order.

    `ToolError` for a folder without logs, `LogError` for a file that is not a log.
    """
    places: list[_Place] = []
    for argument in given:
        if argument.is_dir():
            places += _folder(argument)
        elif argument.exists() or argument.is_symlink():
            places.append(_place(argument))
        else:
            places += [_place(path) for path in _by_name(argument)]
    seen: set[Path] = set()
    sets: dict[str, list[_Place]] = {}
    alone: list[Series] = []
    for place in places:
        real = place.path.resolve()
        if real in seen:
            continue
        seen.add(real)
        mates = sets.setdefault(place.identity, [])
        if not place.identity or any(mate.number == place.number for mate in mates):
            # The set is unknown, or this is another copy, such as a recovered one.
            alone.append(Series((place.path,), place.identity, place.number))
        else:
            mates.append(place)
    out = []
    for identity, mates in sets.items():
        ordered = sorted(mates, key=lambda place: place.number)
        if ordered:
            paths = tuple(place.path for place in ordered)
            out.append(Series(paths, identity, ordered[0].number))
    return sorted([*out, *alone], key=lambda series: given_order(given, series))


def given_order(given: Sequence[Path], series: Series) -> tuple[int, str]:
    """Sort key of logs: the order of the arguments, then the names."""
    path = series.paths[0]
    for index, argument in enumerate(given):
        if path == argument or path.parent == argument:
            return index, str(path)
    return len(given), str(path)


def _folder(folder: Path) -> list[_Place]:
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".mcap")
    except OSError as error:
        raise LogError(f"{folder}: {error.strerror}") from error
    places = []
    for path in paths:
        try:
            places.append(_place(path))
        except LogError as error:
            complain(f"left out: {error}")
    if not places:
        raise ToolError(f"{folder} is a folder without a readable .mcap file; name one that has")
    return places


def _by_name(argument: Path) -> list[Path]:
    """Files of the log called ``argument``, which is not a file itself."""
    stem = argument.name.removesuffix(".mcap")
    pattern = re.compile(re.escape(stem) + r"(_\d{4,})?\.mcap")
    try:
        found = [path for path in argument.parent.iterdir() if pattern.fullmatch(path.name)]
    except OSError:
        found = []
    if not found:
        raise ToolError(
            f"{argument} does not exist; name a file, a folder of logs, or what the names of the "
            f"files of one log have in common ({stem}_0000.mcap and so on)"
        )
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _place(path: Path) -> _Place:
    """Read which file of which set this is; empty if the file does not say."""
    with LogReader(path) as reader:
        for event in reader.events():
            if isinstance(event, Block):
                break
            if isinstance(event, MetadataRecord) and event.name == FILE:
                number = event.values.get("file", "")
                if number.isdecimal():
                    return _Place(path, event.values.get("set", ""), int(number))
    return _Place(path, "", 0)


def siblings(series: Series) -> list[Path]:
    """Other files of the same log beside these, for a hint."""
    if not series.identity:
        return []
    path = series.paths[0]
    stem = re.sub(r"_\d{4,}$", "", path.name.removesuffix(".mcap"))
    pattern = re.compile(re.escape(stem) + r"(_\d{4,})?\.mcap")
    found = []
    try:
        beside = sorted(p for p in path.parent.iterdir() if pattern.fullmatch(p.name))
    except OSError:
        return []
    for other in beside:
        if other in series.paths:
            continue
        try:
            if _place(other).identity == series.identity:
                found.append(other)
        except LogError:
            continue
    return found
