"""Numba kernels of the vector-matrix factors."""
