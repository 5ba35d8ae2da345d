"""The Gaussian field on the device that its settings ask for."""

from __future__ import annotations

from typing import Any

from edge_server.fields import Field
from edge_server.fields.splat.cpu_field import SplatField
from edge_server.fields.splat.settings import make_settings

__all__ = ["SplatField", "make"]


def make(options: dict[str, Any], seed: int = 0) -> Field:
    """A field from plain options (see ``settings.make_settings``): in layers, with gsplat for device
    ``cuda``, or else a single one on the CPU. ValueError: a wrong option, no CUDA device, or no gsplat."""
    settings = make_settings(options, seed)
    if settings.layers:
        from edge_server.fields.splat.layers.layered_field import LayeredField  # imported only where used

        return LayeredField(settings)
    if settings.device != "cuda":
        return SplatField(settings)
    from edge_server.fields.splat.gsplat_field import make_cuda  # imports torch

    return make_cuda(settings)
