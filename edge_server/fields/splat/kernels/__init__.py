"""Numba kernels of Gaussian splatting."""
