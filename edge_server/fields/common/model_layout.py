"""Sizes and initial values of a hash grid's levels (Mueller et al. 2022) and of the network behind it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from edge_server.fields.common.hash_grid_settings import HashGridSettings
from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, Grid
from edge_server.fields.common.kernels.mlp import Net, param_count
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.trainer_settings import TrainerSettings

FINENESS = 1.0  # cells of the finest level per pixel
FIRST_DENSITY = 0.3  # a scene unit of fog dims by a quarter: every sample gets a gradient at first


def _multiple_of_4(n: int) -> int:
    return (n + 3) // 4 * 4


def finest_resolution(settings: HashGridSettings, box: SceneBox | None) -> int:
    """As set, or about one cell a pixel: finer levels would only learn noise."""
    if settings.finest_resolution is not None:
        return settings.finest_resolution
    pixels = FINENESS * box.pixels_across if box is not None else 256.0
    return int(np.clip(pixels, settings.base_resolution, 512))


def make_grid(settings: HashGridSettings, box: SceneBox | None, rng: np.random.Generator) -> Grid:
    """Levels growing geometrically from base to finest resolution, tables near zero."""
    share = np.arange(settings.levels) / max(settings.levels - 1, 1)
    ratio = finest_resolution(settings, box) / settings.base_resolution
    resolution = np.round(settings.base_resolution * ratio**share).astype(np.int32)
    most = 1 << settings.log2_table
    vertices = (resolution.astype(np.int64) + 1) ** 3
    dense = vertices <= most
    sizes = np.where(dense, (vertices + SEGMENT - 1) // SEGMENT * SEGMENT, most)
    first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    table = rng.uniform(-1e-4, 1e-4, size=(int(first[-1]), FEATURES)).astype(np.float32)
    return Grid(resolution, first, dense, table)


def init_net(inputs: int, settings: TrainerSettings, rng: np.random.Generator) -> Net:
    """He initialization with a small output: thin gray fog everywhere. Widths are padded to 4: ``inputs`` features in;
    density, color, the color's harmonics and three numbers for each dimension of the appearance out."""
    outputs = _multiple_of_4(4 + 9 * settings.sh_degree + 3 * settings.appearance)
    hidden = [settings.hidden] * settings.hidden_layers
    widths = np.array([_multiple_of_4(inputs), *hidden, outputs], dtype=np.int64)
    params = np.zeros(param_count(widths), np.float32)
    first = 0
    for layer, (n_in, n_out) in enumerate(pairwise(widths)):
        last = layer == len(widths) - 2
        spread = np.sqrt(2.0 / n_in) * (0.1 if last else 1.0)
        params[first : first + n_in * n_out] = rng.normal(0.0, spread, int(n_in * n_out))
        if last:
            params[first + n_in * n_out] = np.log(FIRST_DENSITY)
        first += int(n_in * n_out + n_out)
    return Net(widths, params)
