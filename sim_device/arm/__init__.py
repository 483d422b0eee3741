"""The simulated arm and its cupboard."""
