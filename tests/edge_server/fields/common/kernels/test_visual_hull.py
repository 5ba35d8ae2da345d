"""Points in a view's foreground, against the project's own lens model."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.visual_hull import count_points
from edge_server.fields.common.threads.thread_pool import Pool
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat.kernels.small_cloud import BOX

LENS = Pinhole(40, 30, 30.0, 31.0, 19.0, 16.0, distortion=(-0.12, 0.03, 0.01, -0.015))


def test_points_are_counted_where_the_lens_puts_them() -> None:
    rng, pose = np.random.default_rng(0), look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))
    points = rng.normal(scale=1.2, size=(700, 3)).astype(np.float32)
    mask = (rng.random((30, 40)) < 0.4).astype(np.uint8)
    seen, marked = np.ones(700, np.int32), np.zeros(700, np.int32)
    Pool(2, 0).run(count_points, camera_rows([pose], [LENS], BOX), points, mask, seen, marked)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    u, v = LENS.project(local).T
    inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < 40) & (v < 30)
    edge = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v))) < 1e-3  # rounding decides
    np.testing.assert_array_equal((seen == 2)[~edge], inside[~edge])
    hit = np.zeros(700, bool)
    hit[inside] = mask[v[inside].astype(int), u[inside].astype(int)] > 0
    np.testing.assert_array_equal((marked == 1)[~edge], hit[~edge])
    assert 100 < inside.sum() < 650
