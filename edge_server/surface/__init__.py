"""From a radiance field to a triangle mesh (thesis 3.1.1: 3.8-3.10, and 3.12-3.15).

Depth maps of any representation (``depth``) -> truncated signed distances (``volume``), or a signed distance
function with the eikonal term (``sdf``) -> marching cubes and cleaning (``mesh``). This package is imported only when
a mesh is requested.
"""

from __future__ import annotations


class SurfaceError(ValueError):
    """A surface cannot be made with these settings; the message says what to change."""
