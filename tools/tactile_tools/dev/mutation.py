"""``tactile mutation``: make small changes to the safety gate and see whether its tests notice.

A mutant that no test fails on is a survivor: either a test is missing, or the change makes no
difference that matters. It needs the tests, so it works only in a checkout. The result is written
after each mutant, and a run that was cut off goes on where it ended, as long as gate and tests are
the same.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from tactile_core.cli import REFUSED, CommandError

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "host" / "reachd"
FILES = ("gate/gate.py", "gate/limits.py", "gate/motion.py")
TESTS = (
    "test_gate_limits.py",
    "test_gate_workspace.py",
    "test_gate_wrench.py",
    "test_gate_constraints.py",
    "test_gate_geometry.py",
    "test_gate_inputs.py",
    "test_gate_ages.py",
    "test_gate_arming.py",
    "test_gate_motion.py",
    "test_gate_loads.py",
    "test_gate_tracking.py",
    "test_gate_path.py",
    "test_gate_directions.py",
    "test_gate_counts.py",
    "test_gate_echo.py",
    "test_gate_random.py",
)
RANDOM_INPUTS = "2000"
"""Inputs of the random test for each mutant: what it finds, it finds among the first."""

SWAPS: dict[type[ast.AST], tuple[type[Any], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
}
NAMES = {"min": "max", "max": "min", "cos": "sin", "sin": "cos"}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: where, and the expression before and after."""

    file: str
    line: int
    before: str
    after: str
    source: str


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """Small changes of one node, each a new node."""
    match node:
        case ast.Compare(ops=ops):
            for index, op in enumerate(ops):
                for other in SWAPS.get(type(op), ()):
                    changed = copy.deepcopy(node)
                    changed.ops[index] = other()
                    yield changed
        case ast.BoolOp(op=op) | ast.BinOp(op=op):
            for other in SWAPS.get(type(op), ()):
                changed_op = copy.deepcopy(node)
                changed_op.op = other()
                yield changed_op
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield copy.deepcopy(operand)
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1)
        case ast.Name(id=name) if name in NAMES:
            yield ast.Name(NAMES[name], ast.Load())
        case ast.Attribute(attr=name) if name in NAMES:
            renamed = copy.deepcopy(node)
            renamed.attr = NAMES[name]
            yield renamed
        case ast.Expr(value=ast.Call()) | ast.AugAssign():
            yield ast.Pass()


def mutants(file: str, source: str) -> list[Mutant]:
    """Every single change of ``source``, except in annotations and module constants."""
    tree = ast.parse(source)
    found = []
    for holder in ast.walk(tree):
        if not isinstance(holder, ast.FunctionDef):
            continue
        for parent in (n for statement in holder.body for n in ast.walk(statement)):
            for name, value in ast.iter_fields(parent):
                if name in ("annotation", "returns"):
                    continue
                places = value if isinstance(value, list) else [value]
                for index, node in enumerate(places):
                    if not isinstance(node, ast.AST):
                        continue
                    for changed in variants(node):
                        ast.copy_location(changed, node)
                        _put(parent, name, index, changed)
                        text = ast.unparse(tree)
                        _put(parent, name, index, node)
                        line = getattr(node, "lineno", holder.lineno)
                        before, after = ast.unparse(node), ast.unparse(changed)
                        found.append(Mutant(file, line, before, after, text))
    return found


def _put(parent: ast.AST, name: str, index: int, node: ast.AST) -> None:
    holder = getattr(parent, name)
    if isinstance(holder, list):
        holder[index] = node
    else:
        setattr(parent, name, node)


def trial(overlay: str, tests: Sequence[str]) -> None:
    """Run the tests on the package in ``overlay``; the process exits with pytest's code."""
    import pytest

    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    os.environ["REACH_RANDOM_INPUTS"] = RANDOM_INPUTS
    sys.path.insert(0, overlay)
    import reachd

    if not str(reachd.__file__).startswith(overlay):
        sys.exit(99)
    os.chdir(ROOT)
    options = ["-x", "-q", "--no-header", "-p", "no:cacheprovider", "--hypothesis-seed=1"]
    options += ["--confcutdir=/"]  # the fixtures lie in folders above
    sys.exit(pytest.main([*options, *tests]))


def judge(package: Path, mutant: Mutant | None, tests: Sequence[str], limit: float) -> str:
    """Fate of one mutant of ``package``; None: of the unchanged package."""
    context = multiprocessing.get_context("forkserver")
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        _copy(package, Path(folder) / "reachd")
        if mutant is not None:
            (Path(folder) / "reachd" / mutant.file).write_text(mutant.source, encoding="utf-8")
        process = context.Process(target=trial, args=(folder, tests), daemon=True)
        process.start()
        process.join(limit)
        if process.is_alive():
            process.kill()
            process.join()
            return "timeout"
        if process.exitcode == 99:
            raise RuntimeError("the mutated package was not the one that was imported")
        return "survived" if process.exitcode == 0 else "killed"


def _copy(source: Path, target: Path) -> None:
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))


def copy_tests(folder: Path) -> Path:
    """Copy the gate's tests and the fixtures that they use; returns the folder of the tests."""
    gate = Path("tests", "reachd", "gate")
    _copy(ROOT / gate, folder / gate)
    for above in list(gate.parents)[:-1]:
        for conftest in (ROOT / above).glob("conftest.py"):
            shutil.copy(conftest, folder / above)
    return folder / gate


def run(options: argparse.Namespace) -> int:
    """Judge every mutant, several at a time, and report the survivors."""
    folder = ROOT / "tests" / "reachd"
    if not folder.is_dir() or not PACKAGE.is_dir():
        print(
            f"no tests at {folder}: run this in a checkout of the project, not in an installation",
            file=sys.stderr,
        )
        return 3
    with tempfile.TemporaryDirectory(prefix="mutation-") as frozen:
        # Copies, so that work on the checkout does not disturb a run of many minutes.
        package = Path(frozen) / "reachd"
        _copy(PACKAGE, package)
        gate = copy_tests(Path(frozen))
        return _judge_all(package, [str(gate / name) for name in TESTS], options)


def _judge_all(package: Path, tests: Sequence[str], options: argparse.Namespace) -> int:
    every = [m for f in options.file for m in mutants(f, (package / f).read_text(encoding="utf-8"))]
    chosen: Sequence[int] = range(len(every))
    if options.sample is not None and options.sample < len(every):
        chosen = random.Random(options.seed).sample(chosen, options.sample)
    code = digest(package, Path(tests[0]).parents[2], options.file)
    try:
        fates = read_fates(options.out, code)
        if options.out:
            _write(options.out, every, fates, code)
    except OSError as error:
        raise CommandError(
            f"cannot write {options.out}: {error.strerror}; name another file", REFUSED
        ) from error
    todo = [k for k in chosen if k not in fates]
    multiprocessing.get_context("forkserver").set_forkserver_preload(
        ["pytest", "numpy", "hypothesis", "scipy.integrate"]
    )
    if judge(package, None, tests, options.patience) != "survived":
        print("the tests fail on the unchanged package: fix that first", file=sys.stderr)
        return 3
    console = Console()
    with Progress(console=console, transient=True) as bar, ThreadPoolExecutor(options.jobs) as pool:
        task = bar.add_task(
            f"{len(chosen)} of {len(every)} mutants",
            total=len(chosen),
            completed=len(chosen) - len(todo),
        )
        jobs = {pool.submit(judge, package, every[k], tests, options.patience): k for k in todo}
        try:
            for job in as_completed(jobs):
                k = jobs[job]
                fates[k] = job.result()
                if options.out:
                    _write(options.out, every, fates, code)
                bar.advance(task)
                if fates[k] == "survived":
                    console.print(_line(every[k]), markup=False, soft_wrap=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return _report({k: fates[k] for k in chosen}, len(every), console, options)


def digest(package: Path, tests: Path, files: Sequence[str]) -> str:
    """What tells a run apart whose verdicts may be kept: mutated files, tests and fixtures."""
    found = hashlib.sha256()
    for path in (*(package / file for file in files), *sorted(tests.rglob("*.py"))):
        found.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()[:16]


def read_fates(path: Path | None, code: str) -> dict[int, str]:
    """Verdicts of an earlier run on the same code, which goes on; none if it was another's."""
    if path is None or not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        fates = {int(k): str(fate) for k, fate in found["fates"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
    return fates if found.get("code") == code else {}


def _line(mutant: Mutant) -> str:
    return f"{mutant.file}:{mutant.line}: {mutant.before}  →  {mutant.after}"


def _report(
    fates: dict[int, str], total: int, console: Console, options: argparse.Namespace
) -> int:
    """Print totals. Returns 1 if more survive than allowed."""
    counts = Counter(fates.values())
    console.print(
        f"{len(fates)} mutants of {total}: {len(fates) - counts['survived']} killed "
        f"({counts['timeout']} by the time limit), {counts['survived']} survived"
    )
    allowed = options.max_survivors
    return 1 if allowed is not None and counts["survived"] > allowed else 0


def _write(path: Path, every: Sequence[Mutant], fates: dict[int, str], code: str) -> None:
    """Replace the result at once, so that one that was cut off is whole."""
    counts = Counter(fates.values())
    survivors = sorted(
        (every[k] for k, fate in fates.items() if fate == "survived"),
        key=lambda m: (m.file, m.line),
    )
    found = {
        "mutants": len(every),
        "judged": len(fates),
        "killed": len(fates) - counts["survived"],
        "timeouts": counts["timeout"],
        "survivors": [
            {k: v for k, v in asdict(mutant).items() if k != "source"} for mutant in survivors
        ],
        "code": code,
        "fates": {str(k): fates[k] for k in sorted(fates)},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.part")
    beside.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)
