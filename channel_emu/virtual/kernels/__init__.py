"""Numba kernels of the simulator, imported only by its kernel engine. Each has a plain Python counterpart in
``channel_emu.model``; tests compare every decision of the two."""
