"""Simulated cupboard: scenes and planar physics."""
