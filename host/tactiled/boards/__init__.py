"""Boards behind a port: who they are, their clocks, their frames in order. Pure."""
