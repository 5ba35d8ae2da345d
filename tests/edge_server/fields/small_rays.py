"""The fields with rays in the sizes of the tests that ask all representations the same (``small``)."""

from __future__ import annotations

from typing import Any

from edge_server.fields.nerfacto.field import NerfactoField
from edge_server.fields.nerfacto.settings import NerfactoSettings
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from edge_server.fields.tensorf.field import TensorfField
from edge_server.fields.tensorf.settings import TensorfSettings

_SMALL: dict[str, Any] = {"hidden": 16, "rays": 1024, "batch_samples": 8192, "cells": 32, "threads": 2}
_TINY: dict[str, Any] = {"hidden": 16, "rays": 512, "batch_samples": 4096, "cells": 16, "threads": 2}
_HASHED: dict[str, Any] = {"levels": 6, "log2_table": 12, "finest_resolution": 64}
_MARCHED: dict[str, Any] = {"samples": 96, "samples_ramp": 100}
_PROPOSED: dict[str, Any] = {"samples": 12, "samples_start": 16, "bins": 48}

CLASSES = {"ngp": NgpField, "nerfacto": NerfactoField, "tensorf": TensorfField}
SMALL = {
    "ngp": NgpSettings(**_SMALL, **_HASHED, **_MARCHED, levels_every=15),
    "nerfacto": NerfactoSettings(**_SMALL, **_HASHED, **_PROPOSED, proposal_cells=32, anneal=60),
    "tensorf": TensorfSettings(
        **_SMALL, **_MARCHED, color_rank=8, resolution_start=16, resolution=64, upsample=(20, 60, 120)
    ),
}
_COARSE: dict[str, Any] = {**_TINY, "samples": 48, "samples_ramp": 100}
TINY = {
    "ngp": NgpSettings(**_COARSE, levels=4, levels_every=10, log2_table=11, finest_resolution=32),
    "nerfacto": NerfactoSettings(
        **_TINY,
        **_PROPOSED,
        levels=5,
        log2_table=11,
        base_resolution=8,
        finest_resolution=48,
        proposal_cells=16,
        anneal=40,
    ),
    "tensorf": TensorfSettings(**_COARSE, color_rank=8, resolution_start=12, resolution=32, upsample=(10, 25)),
}
_CASES = ("held out", "moved", "one view", "after noise", "moving cameras", "after no weights")
REACHED_DB = {
    "ngp": dict(zip(_CASES, (23.25, 21.77, 32.25, 18.21, 26.95, 20.97))),
    "nerfacto": dict(zip(_CASES, (23.0, 21.15, 26.81, 20.17, 27.14, 22.32))),
    "tensorf": dict(zip(_CASES, (24.76, 24.16, 20.18, 19.19, 27.27, 18.68))),
}
