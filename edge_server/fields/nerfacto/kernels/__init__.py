"""Numba kernels of proposal sampling."""
