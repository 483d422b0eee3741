"""Reaching strategies: the built-in ones, and loading of others."""

from reachd.strategies.builtin import ReachingStrategy, ReportsEvents, StrategyEvent
from reachd.strategies.runner import Answer, StrategyError, ask, available, begin, load_strategy

__all__ = [
    "Answer",
    "ReachingStrategy",
    "ReportsEvents",
    "StrategyError",
    "StrategyEvent",
    "ask",
    "available",
    "begin",
    "load_strategy",
]
