"""Numba kernels of the simulator. Each has its plain counterpart in the package, which the tests compare it
with decision for decision; nothing here is imported unless a simulation asks for speed."""
