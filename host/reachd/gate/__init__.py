"""The safety gate: the last check on every command."""
