"""Experiments with camera node, emulator and edge together: virtual deployments, benches, studies, training.
No live code imports this package."""
