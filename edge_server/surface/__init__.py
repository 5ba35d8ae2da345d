"""From a radiance field to a triangle mesh (thesis 3.1.1: 3.8-3.10, and 3.12-3.15).

depth maps of any representation (``depth``) -> truncated signed distances (``volume``), or a signed distance
function with the eikonal term (``sdf``) -> marching cubes and cleaning (``mesh``). ``metrics`` measures what
came out against the exact surface of a synthetic scene. Nothing here is imported until a mesh is asked for.
"""

from __future__ import annotations


class SurfaceError(ValueError):
    """A surface that cannot be made as asked; the message says what to change."""
