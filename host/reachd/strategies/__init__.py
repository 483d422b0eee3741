"""Reaching strategies: the paper's five, and the door for others."""

from reachd.strategies.base import ReachingStrategy, ReportsEvents, StrategyEvent
from reachd.strategies.registry import StrategyError, ask, available, load_strategy

__all__ = [
    "ReachingStrategy",
    "ReportsEvents",
    "StrategyError",
    "StrategyEvent",
    "ask",
    "available",
    "load_strategy",
]
