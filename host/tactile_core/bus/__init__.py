"""The bus: topics, messages, sessions, access rights, and authenticated commands."""
