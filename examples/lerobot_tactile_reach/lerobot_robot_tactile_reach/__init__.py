"""Touch of tactile-reach boards as observations of any LeRobot robot."""

from .config_tactile_reach import TactileReachConfig
from .tactile_reach import TactileReach

__all__ = ["TactileReach", "TactileReachConfig"]
