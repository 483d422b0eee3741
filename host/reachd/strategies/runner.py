"""Load a strategy by name, entry point or ``module:Class``; call it so that it cannot fail."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar, cast

import numpy as np

from reachd.interfaces import ArmState, Goal, Strategy, Touch, Twist
from reachd.strategies.builtin import (
    Burrow,
    Excavate,
    HybridClock,
    HybridEvent,
    Straight,
    StrategyEvent,
)
from reachd.strategies.learned import Learned
from reachd.strategies.parameter_fields import Parameters
from reachd.strategies.quick_sweep import QuickSweep
from tactile_core.types import Instant, record

GROUP = "tactile_reach.strategies"
"""Entry-point group of the strategies of installed packages."""

T = TypeVar("T")

Factory = Callable[[Parameters, np.random.Generator], Strategy]

PrivilegedFactory = Callable[[Parameters, np.random.Generator, object], Strategy]
"""One that is told the truth of a simulated world, see `load_strategy`."""

BUILT_IN: dict[str, Factory] = {
    "straight": Straight,
    "burrow": Burrow,
    "excavate": Excavate,
    "hybrid_clock": HybridClock,
    "hybrid_event": HybridEvent,
    "quick_sweep": QuickSweep,
    "learned": Learned,
}


class StrategyError(ValueError):
    """Strategy could not be loaded: which, what is available, what to do."""


def available() -> tuple[str, ...]:
    """Names for `load_strategy`: the built-in ones, then those of installed packages."""
    return (*BUILT_IN, *sorted(e.name for e in _offered() if e.name not in BUILT_IN))


def load_strategy(
    spec: str,
    parameters: Parameters,
    rng: np.random.Generator,
    truth: Callable[[], object] | None = None,
) -> Strategy:
    """Make the strategy ``spec``: a built-in name, an entry point's name, or ``module:Class``.

    A class is called with (parameters, rng). A package cannot replace a built-in name. One that
    says ``privileged = True`` of itself is called with (parameters, rng, truth()): what a
    simulation knows of its world, and no arm does. Raises StrategyError, for a privileged one also
    where there is no ``truth``.
    """
    strategy = _guarded(spec, lambda: _made(spec, parameters, rng, truth))
    missing = [name for name in ("start", "step", "activity") if not hasattr(strategy, name)]
    if missing:
        raise StrategyError(
            f"strategy {spec!r} has no {' and no '.join(missing)}; docs/strategies.md shows one"
        )
    return strategy


def is_privileged(spec: str) -> bool:
    """Whether ``spec`` must be told the truth of a simulated world; StrategyError."""
    return getattr(_guarded(spec, lambda: _factory(spec)), "privileged", False) is True


@record
class Answer:
    """Result of one step: twist, activity and events, or in ``failure`` how the strategy failed."""

    twist: Twist | None
    activity: str
    events: tuple[StrategyEvent, ...] = ()
    failure: str | None = None


def begin(strategy: Strategy, goal: Goal, now: Instant) -> str | None:
    """Start a reach; returns the error in words, or None."""
    try:
        strategy.start(goal, now)
    except Exception as error:  # noqa: BLE001 - a plug-in may raise anything
        return f"{type(error).__name__}: {error}"
    return None


def ask(strategy: Strategy, touch: Touch, arm: ArmState, goal: Goal, now: Instant) -> Answer:
    """One step of a strategy. Never raises: an error is in `Answer.failure`."""
    try:
        said = strategy.step(touch, arm, goal, now)
        if not isinstance(said, Twist):
            raise TypeError(f"step() returned {type(said).__name__}, not a Twist")
        twist = Twist(float(said.vx), float(said.vy), float(said.omega))
        activity = str(strategy.activity)
        # Not isinstance of a Protocol: in every cycle it costs as much as the strategy itself.
        events = tuple(strategy.take_events()) if hasattr(strategy, "take_events") else ()
    except Exception as error:  # noqa: BLE001 - a plug-in may raise anything
        return Answer(None, "failed", failure=f"{type(error).__name__}: {error}")
    return Answer(twist, activity, events)


def _offered() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))


def _factory(spec: str) -> Factory:
    """Find the class or function that makes the strategy ``spec``."""
    if spec in BUILT_IN:
        return BUILT_IN[spec]
    for entry in _offered():
        if entry.name == spec:
            return cast(Factory, entry.load())
    module, colon, name = spec.partition(":")
    if not colon or not module or not name:
        raise StrategyError(
            f"unknown strategy {spec!r}; available: {', '.join(available())}; load your own as "
            "module:Class"
        )
    made = getattr(import_module(module), name, None)
    if not callable(made):
        raise StrategyError(f"strategy {spec!r}: module {module!r} has no class {name!r}")
    return cast(Factory, made)


def _made(
    spec: str,
    parameters: Parameters,
    rng: np.random.Generator,
    truth: Callable[[], object] | None,
) -> Strategy:
    factory = _factory(spec)
    if getattr(factory, "privileged", False) is not True:
        return factory(parameters, rng)
    if truth is None:
        raise StrategyError(
            f"strategy {spec!r} is privileged: it must be told where every object is, which only "
            "a simulation in lockstep can; run it with tactile reach, experiment or benchmark, "
            "and choose another for an arm"
        )
    return cast("PrivilegedFactory", factory)(parameters, rng, truth())


def _guarded(spec: str, make: Callable[[], T]) -> T:
    """Call ``make``; whatever it raises becomes a StrategyError."""
    try:
        return make()
    except StrategyError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise StrategyError(
            f"strategy {spec!r} cannot be loaded ({type(error).__name__}: {error}); available: "
            f"{', '.join(available())}"
        ) from error
