"""``tactile ros2``: a bridge to ROS 2 over zenoh, and the message package for a ROS workspace."""

from tactile_tools.ros2.cli import add_parser

__all__ = ["add_parser"]
