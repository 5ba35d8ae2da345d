"""The Gaussian field in layers, for fixed cameras: what moves, apart from what stands still."""
