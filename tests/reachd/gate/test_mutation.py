"""The mutation runner makes the stated changes, and tells killed mutants from survivors."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tactile_tools.cli import main
from tactile_tools.dev import mutation

SOURCE = """
LIMIT = 3

def within(a: float, b: float = 2.0) -> bool:
    if not a < b and True:
        return min(a, -b) + 1 > 0
    return a is None
"""


def changes() -> set[tuple[str, str]]:
    return {(m.before, m.after) for m in mutation.mutants("x.py", SOURCE)}


@pytest.mark.parametrize(
    "change",
    [
        ("a < b", "a <= b"),
        ("a < b", "a > b"),
        ("not a < b", "a < b"),
        ("not a < b and True", "not a < b or True"),
        ("True", "False"),
        ("min(a, -b) + 1", "min(a, -b) - 1"),
        ("min", "max"),
        ("-b", "b"),
        ("1", "2"),
        ("min(a, -b) + 1 > 0", "min(a, -b) + 1 >= 0"),
        ("a is None", "a is not None"),
    ],
)
def test_every_mutation_kind_is_applied(change: tuple[str, str]) -> None:
    assert change in changes()


def test_every_mutant_is_a_different_program() -> None:
    made = mutation.mutants("x.py", SOURCE)
    original = ast.unparse(ast.parse(SOURCE))
    assert len({m.source for m in made}) == len(made)
    for mutant in made:
        ast.parse(mutant.source)
        assert mutant.source != original
        assert mutant.source.count("\n") == original.count("\n")
    assert ("3", "4") not in changes(), "module constants are left alone"


def test_detected_mutant_is_killed_and_another_survives(tmp_path: Path) -> None:
    test = tmp_path / "test_it.py"
    test.write_text(
        "from reachd.gate.limits import approach_left\n"
        "def test_it(): assert approach_left(0.9, 0.8) < 0.6 and approach_left(0.5, 0.8) == 1.0\n",
        encoding="utf-8",
    )
    source = (mutation.PACKAGE / "gate/limits.py").read_text(encoding="utf-8")
    made = [m for m in mutation.mutants("gate/limits.py", source) if "part" in m.before]
    caught = next(m for m in made if m.after == "1.0 + part")
    missed = next(
        m for m in mutation.mutants("gate/limits.py", source) if m.before == "force > 0.0"
    )
    assert mutation.judge(mutation.PACKAGE, caught, [str(test)], 60.0) == "killed"
    assert mutation.judge(mutation.PACKAGE, missed, [str(test)], 60.0) == "survived"


def test_copied_tests_pass_on_the_unchanged_gate(tmp_path: Path) -> None:
    """All fixtures are found beside the copies."""
    gate = mutation.copy_tests(tmp_path)
    assert {path.name for path in gate.glob("test_*.py")} >= set(mutation.TESTS)
    tests = [str(gate / name) for name in ("test_gate_ages.py", "test_gate_arming.py")]
    assert mutation.judge(mutation.PACKAGE, None, tests, 120.0) == "survived"


def test_verdicts_are_kept_for_the_same_code_alone(tmp_path: Path) -> None:
    out, package, tests = tmp_path / "out.json", tmp_path / "package", tmp_path / "tests"
    for folder in (package, tests):
        folder.mkdir()
        (folder / "x.py").write_text(SOURCE, encoding="utf-8")
    code = mutation.digest(package, tests, ["x.py"])
    every = mutation.mutants("x.py", SOURCE)
    mutation._write(out, every, {0: "killed", 2: "survived"}, code)
    assert mutation.read_fates(out, code) == {0: "killed", 2: "survived"}
    (tests / "x.py").write_text(SOURCE + "# more", encoding="utf-8")
    assert mutation.read_fates(out, mutation.digest(package, tests, ["x.py"])) == {}
    out.write_text('{"mutants": 359, "survivors": []}', encoding="utf-8")
    assert mutation.read_fates(out, code) == {}


def test_a_result_that_cannot_be_written_is_said_before_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in (tmp_path, tmp_path / "file" / "out.json"):
        (tmp_path / "file").touch()
        assert main(["mutation", "--file", "gate/limits.py", "--out", str(place)]) == 3
        assert "name another file" in capsys.readouterr().err
