"""Settings of the vector-matrix field; their texts become help and error messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_server.fields.common.trainer_settings import TrainerSettings, option


@dataclass(frozen=True)
class TensorfSettings(TrainerSettings):
    """What can be chosen about a ``TensorfField``.

    Tuned: components of density and of color for each orientation (multiples of 8); vertices a side of planes
    and lines at the start, and the steps (rising) after which they are refined; learning rate of planes and
    lines at the start of a fit; standard deviation ``first`` of their first values.
    """

    name = "tensorf"

    resolution: int | None = option(None, "vertices a side in the end; None: about a pixel, 256 at most")
    density_rank: int = 8
    color_rank: int = 16
    resolution_start: int = 48
    upsample: tuple[int, ...] = (100, 200, 400)
    rate: float = 2e-2
    rate_net: float = 4e-2
    epsilon: float = 1e-3
    first: float = 0.1

    def __post_init__(self) -> None:
        self._within(("resolution", 4, 1024))
        super().__post_init__()


SETTINGS = TensorfSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"color_rank": 8, "resolution": 96, "hidden": 16, "batch_samples": 8192, "samples": 96},
    "medium": {},
    "high": {"density_rank": 16, "color_rank": 24, "hidden": 64, "batch_samples": 32768, "rays": 8192, "samples": 256},
}
