"""The Gaussian field on the device that its settings ask for."""

from __future__ import annotations

from edge_server.fields import Field
from edge_server.fields.splat.cpu_field import SplatField
from edge_server.fields.splat.settings import SplatSettings


def make(settings: SplatSettings) -> Field:
    """A field in layers, with gsplat for device ``cuda``, or else a single one on the CPU. ValueError: no
    CUDA device, or no gsplat."""
    if settings.layers:
        from edge_server.fields.splat.layers.layered_field import LayeredField  # imported only where used

        return LayeredField(settings)
    if settings.device != "cuda":
        return SplatField(settings)
    from edge_server.fields.splat.gsplat_field import make_cuda  # imports torch

    return make_cuda(settings)
