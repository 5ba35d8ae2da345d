"""Limits on the threads that numeric libraries (BLAS, OpenMP, numba, OpenCV) start in each process of a run.

Libraries start a thread for each core by default. Nodes and emulator get only one, because they gain nothing
from more, which would compete with the edge's threads. The edge may use every core.
"""

from __future__ import annotations

import os

from freshfield.machine_load import usable_cores

_EDGE_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_VARIABLES = (*_EDGE_VARIABLES, "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def one_thread() -> dict[str, str]:
    """Environment of a process whose libraries run on one thread."""
    return _unless_set(_VARIABLES, 1)


def all_cores() -> dict[str, str]:
    """Environment of the edge server: a thread for each core that this process may use."""
    return _unless_set(_EDGE_VARIABLES, usable_cores())


def _unless_set(variables: tuple[str, ...], threads: int) -> dict[str, str]:
    """Values for the variables that the user has not set."""
    return {name: str(threads) for name in variables if name not in os.environ}
