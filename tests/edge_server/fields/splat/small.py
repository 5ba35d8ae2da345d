"""The Gaussian field in the sizes of the tests that ask all representations the same."""

import numpy as np

from edge_server.fields import Rendering
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.settings import ASPECT, POSITION_LIMIT, RAW_OPACITY_LIMIT, SplatSettings

FIELD = StillField
SMALL = SplatSettings(gaussians=1500, start=800, seed_cells=32, densify_every=20, threads=2)
TINY = SplatSettings(gaussians=400, start=250, seed_cells=16, densify_every=10, threads=2)
FINITE = ("params", "m", "v", "slope", "looks", "reach", "behind")
REACHED_DB = {
    "held out": 23.1,
    "moved": 22.69,
    "one view": 33.09,
    "after noise": 22.17,
    "moving cameras": 25.86,
    "after no weights": 23.01,
}


def check_bounds(field: StillField, out: Rendering) -> None:
    """Of parameters and opacity, after anything that may have happened to them."""
    params = field.state()["params"]
    assert len(params) <= field.settings.gaussians
    if len(params):
        assert np.abs(params[:, :3]).max() <= POSITION_LIMIT
        assert np.abs(params[:, OPACITY]).max() <= RAW_OPACITY_LIMIT
        sizes = params[:, SCALE:QUATERNION]
        assert (np.ptp(sizes, axis=1) <= np.log(ASPECT) + 1e-4).all(), "a needle"
    assert out.opacity.min() >= 0.0 and out.opacity.max() <= 1.0
