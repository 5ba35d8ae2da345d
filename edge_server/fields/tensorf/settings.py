"""Settings of the vector-matrix field; their texts become help and error messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_server.fields.common.trainer_settings import TrainerSettings, option


@dataclass(frozen=True)
class TensorfSettings(TrainerSettings):
    """What can be chosen about a ``TensorfField``. Lengths in meters; None: found from the cameras."""

    name = "tensorf"

    density_rank: int = option(8, "components of density for each orientation, a multiple of 8")
    color_rank: int = option(16, "components of color for each orientation, a multiple of 8")
    resolution_start: int = option(48, "vertices a side of planes and lines at the start")
    resolution: int | None = option(None, "vertices a side in the end; None: about a pixel, 256 at most")
    upsample: tuple[int, ...] = option((100, 200, 400), "steps after which planes and lines are refined")
    rate: float = option(2e-2, "learning rate of planes and lines at the start of a fit")
    rate_net: float = option(4e-2, "learning rate of the network at the start of a fit")
    epsilon: float = option(1e-3, "Adam's epsilon: larger trusts rarely seen vertices less")
    decay: float = option(0.0, "weight decay of planes and lines, per step, times the learning rate")
    first: float = option(0.1, "standard deviation of the factors' initial values")

    def __post_init__(self) -> None:
        self._within(
            ("density_rank", 8, 64),
            ("color_rank", 8, 64),
            ("resolution_start", 4, 1024),
            ("first", 1e-4, 1.0),
            ("rate", 0.0, 10.0),
            ("decay", 0.0, 1e3),
            ("resolution", 4, 1024),
        )
        for rank in ("density_rank", "color_rank"):
            if getattr(self, rank) % 8:
                raise ValueError(f"tensorf: {rank} must be a multiple of 8, not {getattr(self, rank)}")
        if list(self.upsample) != sorted(set(self.upsample)) or any(step < 1 for step in self.upsample):
            raise ValueError(f"tensorf: upsample must be rising step numbers, not {list(self.upsample)}")
        super().__post_init__()


SETTINGS = TensorfSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"color_rank": 8, "resolution": 96, "hidden": 16, "batch_samples": 8192, "samples": 96},
    "medium": {},
    "high": {"density_rank": 16, "color_rank": 24, "hidden": 64, "batch_samples": 32768, "rays": 8192, "samples": 256},
}
