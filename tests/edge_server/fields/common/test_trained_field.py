"""What representations with a network share: which regularizers reach the kernels, bounds of what they render."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.kernels.volume_rendering import Weights
from tests.edge_server.fields.small import SEEN, small, tiny


@pytest.mark.parametrize("name", ["ngp", "nerfacto", "tensorf"])
def test_shipped_settings_regularize(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The weights that a field gives its kernels where nothing is asked for."""
    field, given = small(name), []
    run = field.pool.run

    def noted(kernel, *args) -> None:
        given.extend(arg for arg in args if isinstance(arg, Weights))
        run(kernel, *args)

    monkeypatch.setattr(field.pool, "run", noted)
    field.fit(SEEN, Budget(steps=1))
    assert given[0].distortion == np.float32(0.01) and given[0].guide == np.float32(0.1)


@pytest.mark.parametrize("name", ["ngp", "nerfacto", "tensorf"])
def test_rounding_takes_no_opacity_past_one(name: str) -> None:
    """Of random parameters: without a bound, the weights of dozens of these pixels sum to 1 and a last digit."""
    field, rng, most = tiny(name, threads=1), np.random.default_rng(0), 0.0
    field.fit(SEEN[:1], Budget(steps=1))
    kept = field.snapshot()
    for _ in range(6):  # some draws are transparent everywhere
        net, table = (rng.normal(size=a.shape).astype(np.float32) for a in (kept.net.params, kept.encoding.table))
        drawn = replace(kept, net=kept.net._replace(params=net), encoding=kept.encoding._replace(table=table))
        opacity = np.stack([drawn.render(v.camera_to_world, v.intrinsics).opacity for v in SEEN])
        assert opacity.min() >= 0.0
        most = max(most, float(opacity.max()))
    assert most == 1.0
