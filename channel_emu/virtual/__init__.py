"""The same links simulated in virtual time, and benchmarks of accuracy against cost."""
