"""The sensing core: field to force to contact features. Pure."""
