"""Equalizes the exposures of fixed cameras, from a young still field's renderings of their plates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edge_server.fields import Rendering
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.observations import FixedCamera


def equalize_exposures(cameras: Mapping[str, FixedCamera], renderings: Mapping[str, Rendering]) -> bool:
    """Correct the cameras' exposures by the difference of their plates to the still field's renderings after its first
    steps. A field trained for longer hides the difference: Gaussians that only one camera sees adopt its exposure.
    The geometric mean of the exposures stays, and a camera with too few well exposed pixels is not changed. Returns
    whether they agreed already.

    renderings: of the still field, from every camera.
    """
    ratios = {name: camera.plate.exposure_over(renderings[name].color) for name, camera in cameras.items()}
    logs = {name: np.log(ratio) for name, ratio in ratios.items() if ratio is not None}
    spread = np.stack(list(logs.values())) if logs else np.zeros((1, 3), np.float32)
    if spread.std(axis=0).max() < tuned.EXPOSURES_AGREE:
        return True
    for name, log_ratio in logs.items():
        ratio = np.exp(tuned.EXPOSURE_RATE * (log_ratio - spread.mean(axis=0)))
        cameras[name].correct_exposure(ratio.astype(np.float32))
    return False
