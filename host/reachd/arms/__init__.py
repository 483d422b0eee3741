"""Drivers of arms behind one interface, `reachd.arms.base.Arm`."""

from reachd.arms.base import Arm, ArmError
from reachd.arms.bus_arm import BusArm

__all__ = ["Arm", "ArmError", "BusArm"]
