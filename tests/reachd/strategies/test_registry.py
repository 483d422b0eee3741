"""Strategies are found by name, entry point or module:Class, and cannot break the loop."""

from __future__ import annotations

import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reachd.interfaces import Goal, Strategy, Twist
from reachd.strategies import StrategyError, ask, available, begin, load_strategy, runner
from reachd.strategies.parameters import HARDWARE
from tactile_core.geometry import Side
from tactile_core.types import Instant
from tests.support.paths import ROOT

DOCUMENT = ROOT / "docs" / "strategies.md"
GOAL = Goal(0.358, 0.03, 0.0075, 40.0)
NOW = Instant(5_000_000_000)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], None]]:
    """Write an importable module."""
    monkeypatch.syspath_prepend(str(tmp_path))
    written: list[str] = []

    def write(name: str, text: str) -> None:
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(text), encoding="utf-8")
        written.append(name)

    yield write
    for name in written:
        sys.modules.pop(name, None)


def load(spec: str) -> Strategy:
    return load_strategy(spec, HARDWARE, np.random.default_rng(0))


def test_built_in_strategies_are_available() -> None:
    names = (
        "straight",
        "burrow",
        "excavate",
        "hybrid_clock",
        "hybrid_event",
        "quick_sweep",
        "learned",
    )
    assert available()[: len(names)] == names
    for name in names:
        assert load(name).activity == "straight"


@pytest.mark.parametrize("spec", ["sraight", "", ":", "reachd:", ":Straight", "no such"])
def test_unknown_strategy_lists_available_ones(spec: str) -> None:
    with pytest.raises(StrategyError) as error:
        load(spec)
    for word in (repr(spec), "straight", "burrow", "hybrid_event", "module:Class"):
        assert word in str(error.value)


def test_example_of_the_documentation_runs(
    module: Callable[[str, str], None], fly: Callable, make_touch: Callable, make_arm: Callable
) -> None:
    code = re.search(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.S)
    assert code
    lines = [line for line in code[1].splitlines() if line.strip()]
    assert lines[0] == "# my_strategies.py"
    body = [line for line in lines if line.startswith("        ")]
    assert len(body) <= 20, "twenty lines are promised"
    module("my_strategies", code[1])
    strategy = load("my_strategies:Wiggle")
    flown = fly(strategy, GOAL, 9.0)
    assert np.hypot(*(flown["end"] - [GOAL.x, GOAL.y])) < 0.0075, "it reaches in free air"
    pressed = make_touch(NOW, peak_force=6.0, peak_side=Side.LEFT, peak_y=0.02)
    answer = ask(strategy, pressed, make_arm(NOW), GOAL, NOW)
    assert (answer.activity, answer.failure, answer.events) == ("wiggle", None, ())
    assert answer.twist is not None
    assert answer.twist.vy < 0.0, "away from what presses on the left"
    invalid = make_touch(NOW, valid=False)
    assert ask(strategy, invalid, make_arm(NOW), GOAL, NOW).activity == "wiggle"


def test_package_provides_strategies_by_entry_point(
    module: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    module(
        "offered",
        """
        class Mine:
            activity = "mine"
            def __init__(self, parameters, rng): self.given = parameters, rng
            def start(self, goal, now): pass
            def step(self, touch, arm, goal, now): pass
        """,
    )
    found = (
        EntryPoint("straight", "offered:Mine", runner.GROUP),
        EntryPoint("mine", "offered:Mine", runner.GROUP),
    )
    monkeypatch.setattr(runner, "entry_points", lambda *, group: found)
    assert available() == (*runner.BUILT_IN, "mine")
    strategy: Any = load("mine")
    assert strategy.activity == "mine"
    assert strategy.given[0] is HARDWARE
    assert type(load("straight")).__name__ == "Straight", "a built-in name is not taken over"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1/0", ["ZeroDivisionError", "available: straight"]),
        ("class Other: pass", ["no class 'Mine'"]),
        ("Mine = 3", ["no class 'Mine'"]),
        ("class Mine:\n  def __init__(self): pass", ["TypeError"]),
        (
            "class Mine:\n  def __init__(self, p, r): pass\n  def start(self, goal, now): pass",
            ["no step and no activity", "docs/strategies.md"],
        ),
    ],
)
def test_broken_plugin_is_named(
    text: str, words: list[str], module: Callable[[str, str], None]
) -> None:
    module("broken", text)
    with pytest.raises(StrategyError) as error:
        load("broken:Mine")
    for word in [*words, "broken:Mine"]:
        assert word in str(error.value)


def test_missing_module_is_named() -> None:
    with pytest.raises(StrategyError, match="no_such_module"):
        load("no_such_module:Mine")


class Bad:
    """A strategy that returns or raises what it was made with."""

    def __init__(self, answer: Any, activity: Any = "bad") -> None:
        self.answer, self._activity = answer, activity

    def start(self, goal: Goal, now: Instant) -> None:
        if isinstance(self.answer, Exception):
            raise self.answer

    def step(self, *inputs: object) -> Any:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    @property
    def activity(self) -> Any:
        if isinstance(self._activity, Exception):
            raise self._activity
        return self._activity


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (Bad(ValueError("lost")), "ValueError: lost"),
        (Bad(None), "NoneType"),
        (Bad((1.0, 2.0, 3.0)), "tuple"),
        (Bad(Twist(1.0, "x", 0.0)), "ValueError"),  # type: ignore[arg-type]  # that is the mistake
        (Bad(Twist(0.0, 0.0, 0.0), KeyError("no word")), "KeyError"),
    ],
)
def test_any_strategy_failure_is_described(
    bad: Any, words: str, make_touch: Callable, make_arm: Callable
) -> None:
    answer = ask(bad, make_touch(), make_arm(), GOAL, NOW)
    assert answer.twist is None
    assert answer.failure is not None
    assert words in answer.failure


def test_strategy_that_cannot_start_says_why() -> None:
    bad: Any = Bad(ValueError("no"))
    assert begin(bad, GOAL, NOW) == "ValueError: no"
    assert begin(load("burrow"), GOAL, NOW) is None


def test_numpy_numbers_become_plain_ones(make_touch: Callable, make_arm: Callable) -> None:
    bad: Any = Bad(Twist(np.float32(0.25), np.float64(0.5), 1))
    answer = ask(bad, make_touch(), make_arm(), GOAL, NOW)
    assert answer.twist == Twist(0.25, 0.5, 1.0)
    assert type(answer.twist.vx) is float
    bad = Bad(Twist(math.nan, 0.0, 0.0))
    nan = ask(bad, make_touch(), make_arm(), GOAL, NOW)
    assert nan.failure is None, "the gate refuses what is not finite"
