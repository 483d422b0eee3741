"""What a log needs so that it can be run again to the bit, and running it."""
