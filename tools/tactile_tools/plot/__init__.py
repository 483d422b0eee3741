"""What `tactile plot` draws, and the series it draws from."""
