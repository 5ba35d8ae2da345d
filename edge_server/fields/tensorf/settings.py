"""Settings of the vector-matrix field; their texts become help and error messages."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from edge_server.fields.common.settings import TrainerSettings
from freshfield.settings import about


class TensorfSettings(TrainerSettings, frozen=True):
    """What can be chosen about a ``TensorfField``.

    Tuned: components of density and of color for each orientation (multiples of 8); vertices a side of planes
    and lines at the start, and the steps (rising) after which they are refined; learning rate of planes and
    lines at the start of a fit; standard deviation ``first`` of their first values.
    """

    name = "tensorf"

    resolution: Annotated[
        Annotated[int, Meta(ge=4, le=1024)] | None,
        about("vertices a side in the end; not given: about a pixel, 256 at most"),
    ] = None
    density_rank: int = 8
    color_rank: int = 16
    resolution_start: int = 48
    upsample: tuple[int, ...] = (100, 200, 400)
    rate: float = 2e-2
    rate_net: float = 4e-2
    epsilon: float = 1e-3
    first: float = 0.1


SETTINGS = TensorfSettings
