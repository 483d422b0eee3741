"""Drivers of real arms, each in a process of its own that speaks the topics ``arm/NAME/...``."""
