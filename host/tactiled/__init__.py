"""From taxel boards to contact features: decode, compensate, calibrate, publish, log."""
