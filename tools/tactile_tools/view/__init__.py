"""``tactile view``: the live page with the boards' touch and the reach, also for logs."""
