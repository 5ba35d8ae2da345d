"""Hot loops of the radiance fields: small numba kernels, each compared with plain torch in the tests.

Every kernel that runs on several threads takes a ``counter`` (int64, starts at 0) from which workers draw
task numbers, and a ``worker`` number that selects scratch memory. What a task computes depends on its number
only, tasks do not depend on the number of threads, and sums over tasks are taken in the order of the tasks:
results are equal bit for bit for any number of threads.
"""
