"""Train the strategy `learned` in the planar engine."""
