"""Simulated taxel boards: field model, firmware, faults, and the ports they are reached at."""
