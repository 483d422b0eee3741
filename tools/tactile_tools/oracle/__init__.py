"""The ceiling of a scene set: a planner that sees every object. In simulation only."""

from tactile_tools.oracle.strategy import PrivilegedPlanner

__all__ = ["PrivilegedPlanner"]
