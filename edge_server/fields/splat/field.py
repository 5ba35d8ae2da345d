"""The Gaussian field that a scenario asks for."""

from __future__ import annotations

from edge_server.fields import Field
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.still_field import StillField


def make(settings: SplatSettings) -> Field:
    """A field in layers, or one of still Gaussians alone."""
    if settings.layers:
        from edge_server.fields.splat.layers.layered_field import LayeredField  # imported only where used

        return LayeredField(settings)
    return StillField(settings)
