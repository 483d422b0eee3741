"""Boards behind a port: their identification, clocks and frames. Pure."""
