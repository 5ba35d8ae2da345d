"""Numba kernels of the surface; their plain references stand in tests/edge_server/surface."""
