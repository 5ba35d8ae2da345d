"""A lens that no glass has: its undistortion diverges, and must not reach a kernel as NaN."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import Budget, View
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields_for_tests import tiny_field

POSE = look_at([2.0, 0.0, 0.5], [0, 0, 0])
pytestmark = pytest.mark.stability


def view(camera: Pinhole) -> View:
    return View("cam01", np.full((64, 64, 3), 60, np.uint8), POSE, camera)


@pytest.mark.parametrize(
    "lens", [(0.0, 0.0, 78.0, 69.6), (100.0, 100.0, 100.0, 100.0), (-100.0, 100.0, 0.0, 0.0), (1e30, 0.0, 0.0, 0.0)]
)
def test_a_lens_that_cannot_be_undone_is_refused_and_the_field_goes_on(lens):
    field = tiny_field()
    with pytest.raises(ValueError, match=r"cam01: its distortion"):
        field.fit([view(Pinhole(64, 64, 12.2, 12.2, 32.0, 32.0, lens))], Budget(steps=2))
    straight = Pinhole(64, 64, 60.0, 60.0, 32.0, 32.0)
    assert field.fit([view(straight)], Budget(steps=2)).steps == 2
    assert np.isfinite(field.render(POSE, straight).color).all()


def test_a_real_lens_is_welcome():
    lens = (-0.046183, 0.139983, 0.000608, 0.00069)
    assert tiny_field().fit([view(Pinhole(64, 64, 60.0, 60.0, 32.0, 32.0, lens))], Budget(steps=2)).steps == 2
