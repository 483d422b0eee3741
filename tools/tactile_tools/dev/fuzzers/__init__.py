"""Fuzzers of `tactile fuzz`, one module per codec."""
