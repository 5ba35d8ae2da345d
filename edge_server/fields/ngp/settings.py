"""Settings of the hash-grid field: one dataclass whose texts become help and error messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_server.fields.common.trainer_settings import TrainerSettings, help_of, option, settings_from

STATE_SHAPE = (
    "levels", "log2_table", "base_resolution", "finest_resolution", "hidden", "hidden_layers", "harmonics",
    "cells", "samples",
)  # fmt: skip
"""Settings that decide the shape of a saved state: those of a loaded one must be equal."""


@dataclass(frozen=True)
class NgpSettings(TrainerSettings):
    """What can be chosen about an ``NgpField``. Lengths in metres; None means: found from the cameras."""

    name = "ngp"

    levels: int = option(8, "levels of the hash grid, coarse to fine")
    log2_table: int = option(16, "largest number of vertices a level stores, as a power of two")
    base_resolution: int = option(16, "cells a side of the coarsest level")
    finest_resolution: int | None = option(None, "cells a side of the finest level; None: about a pixel")
    rate: float = option(8e-2, "learning rate of the hash tables at the start of a fit")
    rate_net: float = option(3e-2, "learning rate of the network at the start of a fit")
    decay: float = option(0.0, "pull of the tables' entries towards zero, per step and rate")
    smooth: float = option(1.5e-3, "weight of the total variation of the levels that are not hashed")
    levels_start: int = option(4, "levels in use at first; the finer ones follow (coarse to fine)")
    levels_every: int = option(30, "steps after which one more level is switched on")
    samples_start: int = option(32, "``samples`` at first: fog is cheaper to see through in long steps")

    def __post_init__(self) -> None:
        self._within(
            ("levels", 1, 24),
            ("log2_table", 8, 24),
            ("base_resolution", 2, 512),
            ("levels_start", 1, 24),
            ("levels_every", 0, 1 << 30),
            ("rate", 0.0, 10.0),
            ("decay", 0.0, 1e3),
            ("smooth", 0.0, 1e3),
        )
        if self.finest_resolution is not None:
            self._within(("finest_resolution", 2, 4096))
        super().__post_init__()


EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"levels": 6, "log2_table": 14, "finest_resolution": 96, "batch_samples": 8192, "samples": 96},
    "medium": {},
    "high": {"log2_table": 17, "hidden": 64, "batch_samples": 32768, "rays": 8192, "samples": 256},
}


def make_settings(options: dict[str, Any], seed: int = 0) -> NgpSettings:
    """Settings from plain options: see ``trainer_settings.settings_from``."""
    return settings_from(NgpSettings, EFFORTS, options, seed)


def help_text() -> dict[str, str]:
    """Option name -> what it means, for command lines and documentation."""
    return help_of(NgpSettings)
