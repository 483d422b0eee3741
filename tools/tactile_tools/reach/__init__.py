"""Reaches in lockstep on virtual time, and as real processes."""
