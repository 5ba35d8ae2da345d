"""Numba kernels of the simulator, imported only by its kernel engine. Each has a plain counterpart in
``channel_emu.model``; the tests compare the two decision for decision."""
