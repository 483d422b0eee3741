"""From contact features to velocity commands: primitives, strategies and the safety gate."""
