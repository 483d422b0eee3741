"""Inspect, recover and plot logs, run the demo and the benchmarks: the ``tactile`` command."""
