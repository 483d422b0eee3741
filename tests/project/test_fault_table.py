"""The fault table in ``tests/README.md`` names existing tests for every row."""

from __future__ import annotations

import ast
import re

import pytest

from tests.support.paths import TESTS

ROW = re.compile(r"\| (\d+) \|")
NAMED = re.compile(r"`((?:[a-z_0-9]+/)+test_\w+\.py)(?:::(test_\w+))?`")
ROWS = 56
"""Number of rows."""


def table() -> dict[int, list[tuple[str, str]]]:
    """File and function (or "") of each test named in a row."""
    found: dict[int, list[tuple[str, str]]] = {}
    for line in (TESTS / "README.md").read_text(encoding="utf-8").splitlines():
        if row := ROW.match(line):
            found[int(row[1])] = NAMED.findall(line)
    return found


def test_every_fault_has_a_row_with_a_test() -> None:
    rows = table()
    assert set(rows) == set(range(1, ROWS + 1))
    assert [row for row, named in rows.items() if not named] == []


@pytest.mark.parametrize("row", sorted(table()))
def test_tests_named_by_a_row_exist(row: int) -> None:
    for file, function in table()[row]:
        tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
        functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert not function or function in functions, f"{file} has no {function}"
