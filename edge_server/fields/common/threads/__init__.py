"""How kernels run side by side: a pool of threads, its work queue, and compiling ahead on every core."""
