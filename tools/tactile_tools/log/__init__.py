"""``tactile log``: one module per subcommand, and the modules that they share."""
