"""``tactile log``: one module a subcommand, over what all of them share."""
