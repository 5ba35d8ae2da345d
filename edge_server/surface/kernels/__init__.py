"""Numba kernels of the surface; tests/edge_server/surface has their reference implementations."""
