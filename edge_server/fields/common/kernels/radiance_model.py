"""The interface of a representation to the shared kernels: where samples lie, their density, color and gradients.

``train``, ``render`` and ``occupancy`` are written once for all representations that are an encoding and a
small network. An encoding is a named tuple; the module that defines it has the functions below for its type
(``implements``), so each representation compiles only its own. Their bodies here are never run. Samples of an encoding
without a field ``sampling`` lie in the occupied cells that a ray passes (``render``, ``train``).

acts: float32 (units, N); the first net.widths[0] rows are the network's input, the last net.widths[-1] rows
its output: density in row 0 (before ``activate_density``), color in rows 1 to 3, then harmonics, then three numbers
for each dimension of the cameras' appearance.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import overload


def implements(function: Callable[..., Any], field: str, there: bool = True) -> Callable[[Any], Any]:
    """Decorate what ``function``, one of those below, is for encodings that have, or do not have, a field."""

    def register(implementation: Any) -> Any:
        def choose(encoding: Any, *_: Any) -> Any:
            known = isinstance(encoding, types.BaseNamedTuple)
            return implementation if known and (field in encoding.fields) == there else None

        overload(function, strict=False)(choose)
        return implementation

    return register


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


def sample_rays(encoding, space, o, travel, active, count, x, line, first):  # type: ignore[no-untyped-def]
    """Rendering: place the next samples of rays active[:count] from o, as many as there is room for. Returns how many
    of the rays that is.

    travel: float32 (R, 6), direction, distance reached and distance of leaving of each ray. The distance reached is
    moved on; where it is that of leaving, the ray has no more samples.
    x: float32 (3, N), unit cube; line: float32 (3, N), distance and length of each sample. first: int64 (R + 1,), the
    first sample of each of the active rays.
    """
    raise NotImplementedError("runs compiled only")


def fill_chunk(  # type: ignore[no-untyped-def]
    encoding, views, ray_sampling, space, net, chunk, worker, x, line, acts, ray, travel, span, bins
):
    """Training: fill a chunk with rays, their samples and what ``query_density`` returns for them, activated.

    line, ray, travel, span: see ``train.Scratch``. bins: what the representation needs beside.
    Returns rays drawn, columns, spans, and rays whose sampling is not finite. Rays that have not ended must not be
    used.
    """
    raise NotImplementedError("runs compiled only")


def learn_sampling(encoding, bins, chunk, worker, r, w, line, a, b, good):  # type: ignore[no-untyped-def]
    """Training: what ray r, whose samples a to b have weights w, teaches about where samples should lie. good: False
    where the ray is not finite, and left out."""
    raise NotImplementedError("runs compiled only")
