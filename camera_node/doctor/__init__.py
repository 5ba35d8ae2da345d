"""What a scenario needs on this machine, and what its depth, poses and cameras are worth: ``camera-node doctor``."""
