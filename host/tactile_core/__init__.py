"""What daemons, simulator and tools agree on: instants, topics, messages, sessions, logs."""
