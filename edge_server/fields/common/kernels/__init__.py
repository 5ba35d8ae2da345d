"""Hot loops of the radiance fields: small numba kernels, each compared with plain torch in the tests.

Every kernel that runs on several threads takes a ``counter`` (int64 (1,), starts at 0) from which workers
draw task numbers, and a ``worker`` number that selects scratch memory. What a task computes depends on
its own number only, tasks are cut the same way whatever the number of threads, and sums over tasks are
taken in the order of the tasks: results are equal bit for bit for any number of threads.
"""
