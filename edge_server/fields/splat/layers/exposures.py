"""How the exposures of fixed cameras differ, from what all of them see of the same surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.observations import FixedCamera
from edge_server.fields.splat.layers.settings import COVERED, EXPOSURE_RATE, EXPOSURES_AGREE
from edge_server.fields.splat.layers.static_layer import gaussians
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.snapshot import SplatSnapshot


def equalize_exposures(settings: SplatSettings, pool: Pool, box: SceneBox, cameras: Sequence[FixedCamera]) -> bool:
    """Correct the cameras' exposures by how their plates differ from Gaussians that are seeded from all plates and
    not trained: training would hide the difference, because a Gaussian that one camera alone sees takes over its
    exposure. The geometric mean of the exposures stays, and a camera with too few well exposed pixels is left as
    it is. Returns whether they agreed already."""
    plates = [camera.plate_image(fine=False) for camera in cameras]
    views = [replace(p.view, image=np.clip(p.color + 0.5, 0, 255).astype(np.uint8)) for p in plates]
    known = np.concatenate([p.known.ravel() for p in plates]).astype(np.float32)
    rng = np.random.default_rng([settings.seed, 3])
    seeds = seed_gaussians(settings, pool, box, views, None, known, min(settings.start, settings.gaussians), rng)
    shown = SplatSnapshot(box, gaussians(seeds, settings), np.zeros(3, np.float32), (), pool, 0)
    ratios = [camera.plate.exposure_over(_seed_color(shown, camera)) for camera in cameras]
    logs = {k: np.log(ratio) for k, ratio in enumerate(ratios) if ratio is not None}
    spread = np.stack(list(logs.values())) if logs else np.zeros((1, 3), np.float32)
    if spread.std(axis=0).max() < EXPOSURES_AGREE:
        return True
    for k, log_ratio in logs.items():
        cameras[k].correct_exposure(np.exp(EXPOSURE_RATE * (log_ratio - spread.mean(axis=0))).astype(np.float32))
    return False


def _seed_color(shown: SplatSnapshot, camera: FixedCamera) -> NDArray[np.float32]:
    """The seeds' color in a camera's pixels, float32 (H, W, 3) in [0, 1]; 0 where hardly any covers them."""
    out = shown.render(camera.view.camera_to_world, camera.view.intrinsics)
    share = out.opacity[..., None]
    return np.where(share > COVERED, np.clip(out.color / np.maximum(share, COVERED), 0.0, 1.0), 0.0).astype(np.float32)
