"""What `tactile bench` measures, a module a group."""
