"""Studies of age and fidelity (thesis chapters 5 and 6)."""
