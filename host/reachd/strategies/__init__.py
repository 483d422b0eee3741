"""Reaching strategies: the paper's five, and the door for others."""

from reachd.strategies.base import ReachingStrategy, ReportsEvents, StrategyEvent
from reachd.strategies.registry import Answer, StrategyError, ask, available, begin, load_strategy

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
