"""Scores of what is shown: held-out frames, the instants that they show, and what scoring may cost."""
