"""Numba kernels of the voxel grid."""
