"""Settings of the hash-grid field; their texts become help and error messages."""

from __future__ import annotations

from typing import Annotated

from edge_server.fields.common.settings import TrainerSettings
from freshfield.settings import within


class NgpSettings(TrainerSettings, frozen=True):
    """What can be chosen about an ``NgpField``.

    Tuned: cells a side of the coarsest and of the finest level (None: about a pixel); learning rate of the
    tables at the start of a fit; ``levels_start`` levels are in use at the start, and one more is switched on each
    ``levels_every`` steps: few views cannot be explained by fine noise at once.
    """

    name = "ngp"

    levels: Annotated[int, within(1, 24, "levels of the hash grid, coarse to fine")] = 8
    log2_table: Annotated[int, within(8, 24, "maximum number of vertices that a level stores, as a power of two")] = 16
    base_resolution: int = 16
    finest_resolution: int | None = None
    rate_net: float = 3e-2
    levels_start: int = 4
    levels_every: int = 30
    samples_start: int = 32


SETTINGS = NgpSettings
