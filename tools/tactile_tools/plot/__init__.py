"""``tactile plot``: pictures of logs, and the series that they are drawn from."""
