"""Commands for those who work on the project; nothing a rig needs."""
