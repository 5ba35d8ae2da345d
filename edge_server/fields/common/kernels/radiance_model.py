"""The interface of a representation to the shared kernels: density, color and gradients at samples.

``train``, ``render`` and ``occupancy`` are written once for all representations that are an encoding and a
small network. An encoding is a named tuple; the module that defines it overloads the three functions below
for its type (``numba.extending.overload``), so each representation compiles only its own. Their bodies are
never run.

acts: float32 (units, N); the first net.widths[0] rows are the network's input, the last net.widths[-1] rows
its output: density in row 0 (before ``activate_density``), color in rows 1 to 3, then harmonics.
"""

from __future__ import annotations

from typing import Any

from numba import types


def is_a(encoding: Any, kind: type) -> bool:
    """Whether numba's type ``encoding`` is that of named tuple ``kind``: for use in overloads."""
    return isinstance(encoding, types.BaseNamedTuple) and encoding.instance_class is kind


def query_density(encoding, levels, net, x, start, end, acts):  # type: ignore[no-untyped-def]
    """Write the raw density of samples start to end (x: float32 (3, N), unit cube) to the output's row 0; all
    rows, if density and color come from one network."""
    raise NotImplementedError("runs compiled only")


def query_color(encoding, levels, net, x, start, end, acts):  # type: ignore[no-untyped-def]
    """Write the raw colors of samples start to end to the output's rows 1 on, after ``query_density`` of the
    same samples; row 0, now activated, is kept."""
    raise NotImplementedError("runs compiled only")


def query_backward(encoding, net, acts, d_acts, n, d_params, d_features):  # type: ignore[no-untyped-def]
    """Gradients of n samples: from the last rows of d_acts (like acts) to d_params (float32, like
    net.params, added to) and d_features (float32 (rows, N)), which the encoding's scatter kernel reads."""
    raise NotImplementedError("runs compiled only")
