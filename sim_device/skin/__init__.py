"""Simulated skin: from contacts to the counts of its magnetometers."""
