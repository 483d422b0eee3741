"""Logs: crash-safe writing, reading any MCAP file, salvaging damaged ones."""
