"""Simulated boards: firmware, wires, faults."""
