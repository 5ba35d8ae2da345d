"""Compiled kernels are kept by name."""

from __future__ import annotations

import pytest

from edge_server.fields.common.kernels.jit import kernel


def test_a_kernel_within_a_function_needs_a_name_of_its_own() -> None:
    """Two of one name would share the code of the first."""

    def named(counter, worker, out):
        out[0] = 1.0

    with pytest.raises(ValueError, match=r"locals.*needs a __qualname__ of its own"):
        kernel(named)
