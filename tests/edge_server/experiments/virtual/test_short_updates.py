"""A field survives any update time: the same steps a second in many short updates, or in a few long ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.settings import ComputeConfig
from freshfield.scenario import parse
from tests.edge_server.fields.small import small

pytestmark = pytest.mark.stability

SETTLED_S, END_S = 2.5, 4.5


def _mean_psnr(field: Any, cameras: int, size: int, steps: int, update_ms: float) -> float:
    """PSNR at publication, dB, of a person walking in ``room``, with ``steps`` in each update."""
    room = {
        "name": "short updates",
        "seed": 3,
        "cameras": {"count": cameras, "held_out": ["cam00"]},
        "source": {"kind": "world", "scene": "room", "width": size, "height": size, "fps": 15},
        "channel": {"preset": "ch5"},
        "edge": {"updates": "cycle"},
    }
    settings = RunSettings(
        150,  # of the first update
        compute=ComputeConfig(ms_per_update=0.9 * update_ms),
        epoch_ms=update_ms,
        score_every_ms=200.0,
        grace_ms=500.0,
    )

    def published(publication: Any) -> None:
        deployment.settings = replace(settings, steps=steps)

    deployment = build_deployment(parse(room, Path("short")), settings, field=field, on_published=published)
    scores = [p.psnr_db for p in deployment.run(END_S) if p.t_s > SETTLED_S]
    return float(np.mean([s for s in scores if s is not None]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["splat", "ngp"])  # networks share what an update does
def test_short_updates_are_as_good_as_long_ones(name: str) -> None:
    long_db = _mean_psnr(small(name), 9, 64, steps=15, update_ms=250.0)
    short_db = _mean_psnr(small(name), 9, 64, steps=1, update_ms=17.0)
    assert short_db > long_db - 0.3
