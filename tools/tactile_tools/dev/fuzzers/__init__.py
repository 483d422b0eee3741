"""What `tactile fuzz` spoils, a module a codec."""
