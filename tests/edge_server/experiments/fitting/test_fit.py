"""Fits as a library has them."""

from __future__ import annotations

import numpy as np
import pytest

import freshfield as ff
from edge_server.export import ExportError
from freshfield.geometry import look_at
from tests.edge_server.experiments.sets import write_photos

SMALL = {"gaussians": 512, "start": 256, "seed_cells": 16, "threads": 1}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[ff.Fit, object]:
    folder = tmp_path_factory.mktemp("fit")
    write_photos(folder / "set", 9)
    seen = []
    data = ff.load(folder / "set", holdout=3, scale=2)
    fit = ff.fit(data, seconds=1.0, field="splat", options=SMALL, progress=seen.append)
    assert seen == fit.rows and len(data.held_out) == 3
    fit.save(folder / "out")
    return fit, folder


def test_what_was_saved_loads_and_renders_the_same(made):
    fit, folder = made
    again = ff.load(folder / "out")
    pose = look_at((0.3, 0.1, 0.4), (0.0, 0.0, 0.0))
    color, depth = fit.render(pose, size=(40, 30)), fit.depth(pose, size=(40, 30))
    assert color.shape == (30, 40, 3) and color.dtype == np.float32 and 0.0 <= color.min() <= color.max() <= 1.0
    assert depth.shape == (30, 40) and depth.max() > 0.0
    np.testing.assert_array_equal(again.render(pose, size=(40, 30)), color)
    assert fit.seed == ff.Fit(fit.data, "splat", SMALL).seed == 0
    assert fit.psnr.shape == (len(fit.rows), 2) and fit.psnr[-1, 0] == pytest.approx(1.0, rel=0.3)


@pytest.mark.stability
@pytest.mark.parametrize("camera", ["nobody", np.eye(3), np.full((4, 4), np.nan)])
def test_what_is_no_camera_is_refused(made, camera):
    with pytest.raises(ExportError, match="camera"):
        made[0].render(camera)
    with pytest.raises(ExportError, match="expected pixels"):
        made[0].render(np.eye(4), size=(0, 10**6))
