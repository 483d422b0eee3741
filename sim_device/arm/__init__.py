"""Simulated arm, and the simulated cupboard it reaches into."""
