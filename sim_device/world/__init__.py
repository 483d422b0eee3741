"""The cupboard without hardware: scenes, planar physics and the simulated arm."""
