"""Studies of learned schedulers."""
