"""Kernels of depth plates and of what is drawn from them."""
