"""For developers: benchmarks, fuzzers, kills, mutation, fidelity. Not part of a user's wheel."""
