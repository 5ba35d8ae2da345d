"""Training of schedulers and of the detector."""
