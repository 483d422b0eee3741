"""The simulated skin: contacts to counts of its magnetometers."""
