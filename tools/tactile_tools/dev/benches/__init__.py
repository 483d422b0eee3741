"""Benchmarks of `tactile bench`, one module per group."""
