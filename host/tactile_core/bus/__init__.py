"""The bus: topics, messages, sessions, who may do what, commands with proof."""
