"""Settings of the proposal-sampled field; their texts become help and error messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_server.fields.common.trainer_settings import HashGridSettings, option


@dataclass(frozen=True)
class NerfactoSettings(HashGridSettings):
    """What can be chosen about a ``NerfactoField``. Lengths in meters; None: found from the cameras."""

    name = "nerfacto"

    rate_net: float = option(2e-2, "learning rate of the network at the start of a fit")
    samples: int = option(24, "samples of a ray, placed by the proposal density")
    samples_start: int = option(24, "initial value of ``samples``")
    samples_ramp: int = option(200, "training steps after which ``samples`` is reached")
    bins: int = option(96, "bins of a ray, one lookup of proposal density in each")
    proposal_cells: int = option(64, "cells a side of the proposal's grid")
    interlevel: float = option(5.0, "weight of the interlevel loss, which trains the proposal; 0: uniform samples")
    proposal_decay: float = option(3e-2, "pull of the proposal's raw densities back to thin fog")
    even: float = option(0.4, "share of a ray's samples that is allocated uniformly")
    anneal: int = option(40, "steps over which the uniform share falls from 1 to ``even``")
    smooth: float = option(3e-3, "weight of the total variation of the levels that are not hashed")
    appearance: int = option(0, "numbers learned for each camera's appearance (exposure, tint); 0: none")

    def __post_init__(self) -> None:
        self._within(
            ("bins", 8, 1024),
            ("samples", 8, 512),
            ("samples_start", 8, 512),
            ("proposal_cells", 8, 256),
            ("interlevel", 0.0, 1e3),
            ("proposal_decay", 0.0, 1e3),
            ("even", 0.0, 1.0),
            ("anneal", 0, 1 << 30),
            ("appearance", 0, 16),
        )
        if self.proposal_cells % 4:
            raise ValueError(f"{self.name}: proposal_cells must be a multiple of 4, not {self.proposal_cells}")
        if self.appearance and self.exposure:
            # Measured: they compensate each other, and the field is worse than with neither.
            raise ValueError(f"{self.name}: appearance and exposure explain the same thing: choose one")
        super().__post_init__()


SETTINGS = NerfactoSettings
EFFORTS: dict[str, dict[str, Any]] = {
    "low": {
        "levels": 6,
        "log2_table": 14,
        "finest_resolution": 96,
        "batch_samples": 8192,
        "samples": 16,
        "samples_start": 16,
    },
    "medium": {},
    "high": {
        "log2_table": 17,
        "hidden": 64,
        "batch_samples": 32768,
        "rays": 8192,
        "samples": 32,
        "samples_start": 32,
        "bins": 128,
    },
}
