"""Views that were carried forward in time: fields go by the instant they show, not by that of capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.common.kernels.camera import TIME
from edge_server.fields.common.view_outliers import pixel_weights
from edge_server.fields.splat.field import SplatField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import ring

MS = 1_000_000
SMALL = SplatSettings(gaussians=300, start=200, seed_cells=12, threads=2)
OLD = [replace(view, generated_ns=(1000 - 20 * k) * MS) for k, view in enumerate(ring(6, size=24))]
CARRIED = [replace(view, carried_to_ns=1010 * MS) for view in OLD]


def test_the_splat_takes_them_as_seen_at_the_instant_they_show():
    for views, times_s in ((OLD, -0.02 * np.arange(6)), (CARRIED, np.zeros(6))):
        field = SplatField(SMALL)
        field.fit(views, Budget(steps=2))
        assert np.allclose(field._cams[:, TIME], times_s, atol=1e-6)
        assert field._now_ns == views[0].shows_ns


def test_they_are_not_doubted_for_an_age_that_they_no_longer_have():
    settings = replace(SMALL, age_tau_ms=50.0)
    assert pixel_weights(OLD, {}, settings)[5].max() < 0.2
    assert pixel_weights(CARRIED, {}, settings) is None


def test_weights_of_their_own_multiply_with_those_of_age():
    half = [replace(view, weight=np.full((24, 24), 0.5, np.float32)) for view in OLD]
    alone = pixel_weights(OLD, {}, replace(SMALL, age_tau_ms=50.0))
    both = pixel_weights(half, {}, replace(SMALL, age_tau_ms=50.0))
    assert all(np.allclose(b, 0.5 * a) for a, b in zip(alone, both))
    assert half[0].weight.max() == 0.5, "a view's own weight is left alone"


def test_a_saved_field_goes_on_with_them_bit_for_bit():
    first = SplatField(SMALL)
    first.fit(CARRIED, Budget(steps=6))
    second = SplatField(SMALL)
    second.load_state(first.state())
    for field in (first, second):
        field.fit([replace(view) for view in CARRIED], Budget(steps=4))
    a, b = first.state(), second.state()
    assert all(np.array_equal(a[name], b[name]) for name in a)
