"""On which line of a TOML text each key stands. For error messages; `tomllib` checks the syntax."""

from __future__ import annotations

import re
from bisect import bisect_left

Path = tuple[str | int, ...]

BARE = re.compile(r"[A-Za-z0-9_-]+")
SPACE = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
SCALAR = re.compile(r"[^,\]}\s#]+(?:[ ]\d[^,\]}\s#]*)?")  # a date may have a space before its time
MULTILINE_QUOTES = ('"""', "'''")


class _Scanner:
    """Walks over valid TOML, noting the line of each key, table and element of an array."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.lines: dict[Path, int] = {}
        self.arrays: dict[Path, int] = {}  # tables so far in each array of tables
        self._breaks = [match.start() for match in re.finditer("\n", text)]

    def note(self, path: Path, at: int) -> None:
        self.lines.setdefault(path, bisect_left(self._breaks, at) + 1)

    def skip_space(self) -> None:
        match = SPACE.match(self.text, self.at)
        if match is not None:
            self.at = match.end()

    def looking_at(self, token: str) -> bool:
        return self.text.startswith(token, self.at)

    def string(self) -> str:
        """A quoted string; its raw text, which is the key itself unless it has escapes."""
        quote = self.text[self.at]
        if self.text[self.at : self.at + 3] in MULTILINE_QUOTES:
            quote = self.text[self.at : self.at + 3]
        start = self.at + len(quote)
        end = start
        while not self.text.startswith(quote, end):
            end += 2 if quote[0] == '"' and self.text[end] == "\\" else 1
        while len(quote) == 3 and self.text[end + 3 : end + 4] == quote[0]:
            end += 1  # quotes right before the closing ones belong to the text
        self.at = end + len(quote)
        return self.text[start:end]

    def key(self) -> tuple[str, ...]:
        """A key, maybe dotted."""
        parts = []
        while True:
            self.skip_space()
            match = BARE.match(self.text, self.at)
            if match is None:
                parts.append(self.string())
            else:
                parts.append(match.group())
                self.at = match.end()
            self.skip_space()
            if not self.looking_at("."):
                return tuple(parts)
            self.at += 1

    def absolute(self, key: tuple[str, ...]) -> Path:
        """Full path of a table's key: within arrays of tables, that of the last table."""
        path: Path = ()
        for part in key:
            path = (*path, part)
            if path in self.arrays:
                path = (*path, self.arrays[path] - 1)
        return path

    def pair(self, table: Path) -> None:
        """``key = value``."""
        start = self.at
        path: Path = table
        for part in self.key():
            path = (*path, part)
            self.note(path, start)
        self.at += 1  # the equals sign
        self.skip_space()
        self.value(path)

    def value(self, path: Path) -> None:
        if self.looking_at("["):
            self.at += 1
            index = 0
            while True:
                self.skip_space()
                if self.looking_at(","):
                    self.at += 1
                elif self.looking_at("]"):
                    self.at += 1
                    return
                else:
                    self.note((*path, index), self.at)
                    self.value((*path, index))
                    index += 1
        elif self.looking_at("{"):
            self.at += 1
            while True:
                self.skip_space()
                if self.looking_at(","):
                    self.at += 1
                elif self.looking_at("}"):
                    self.at += 1
                    return
                else:
                    self.pair(path)
        elif self.text[self.at] in "\"'":
            self.string()
        else:
            match = SCALAR.match(self.text, self.at)
            if match is not None:
                self.at = match.end()

    def run(self) -> None:
        table: Path = ()
        while True:
            self.skip_space()
            if self.at >= len(self.text):
                return
            start = self.at
            if not self.looking_at("["):
                self.pair(table)
                continue
            double = self.looking_at("[[")
            self.at += 2 if double else 1
            *parents, last = self.key()
            table = (*self.absolute(tuple(parents)), last)
            for depth in range(1, len(table) + 1):
                self.note(table[:depth], start)
            if double:
                self.arrays[table] = self.arrays.get(table, 0) + 1
                table = (*table, self.arrays[table] - 1)
                self.note(table, start)
            elif table in self.arrays:
                table = (*table, self.arrays[table] - 1)
            self.at += 2 if double else 1


def key_lines(text: str) -> dict[Path, int]:
    """Line (from 1) of every key, table and array element of a valid TOML text, by its path."""
    scanner = _Scanner(text)
    scanner.run()
    return scanner.lines
