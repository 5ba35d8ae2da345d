"""Numba kernels of the layers."""
