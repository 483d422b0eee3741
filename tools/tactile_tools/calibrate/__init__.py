"""``tactile calibrate``: models of a board's own force, fitted to recordings and judged."""
