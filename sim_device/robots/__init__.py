"""Robots of several vendors as their clients see them: for testing `armd` without a robot."""
