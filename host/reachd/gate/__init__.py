"""The safety gate: the final check on every command."""
