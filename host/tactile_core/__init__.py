"""Shared by daemons, simulator and tools: time, topics, messages, sessions, calibrations and
logs."""
