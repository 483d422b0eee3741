"""Logs: writing them crash-safe, reading any, salvaging damaged ones."""
