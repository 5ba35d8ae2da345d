"""Kernels of the viewpoint selectors."""
