"""Reaching strategies: the paper's five, `quick_sweep`, and loading of others."""

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
