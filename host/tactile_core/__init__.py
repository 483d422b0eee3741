"""Shared by daemons, simulator and tools: time, topics, messages, sessions, calibration, logs."""
