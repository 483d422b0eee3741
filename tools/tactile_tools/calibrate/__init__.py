"""``tactile calibrate``: fit and judge force models of a board from recordings."""
