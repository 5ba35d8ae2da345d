"""The optimizer step over several blocks and cameras, against the same in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, BLOCK, COLOR, OPACITY, QUATERNION, SCALE
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, as_gaussians, binned, random_params

COUNT = 2 * BLOCK + 44  # two full blocks and a part of one
LENS = Pinhole(48, 40, 50.0, 50.0, 24.0, 20.0, (-0.05, 0.01, 0.002, -0.001))
EYES = ((1.0, -2.5, 0.8), (-2.0, 1.5, 1.0))
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-8


def _raster(params: NDArray[np.float32]) -> tuple[RasterBuffers, NDArray[np.float32]]:
    cams = camera_rows([look_at(eye, (0.05, 0.0, 0.1)) for eye in EYES], [LENS] * 2, BOX)
    raster = binned(cams, params)
    # Some are seen by one camera alone, every fifth by none.
    raster.lists.own_count[0, :COUNT:3] = raster.lists.own_count[1, 1:COUNT:4] = 0
    raster.lists.own_count[:, :COUNT:5] = 0
    rng = np.random.default_rng(4)
    raster.sums[...] = rng.normal(size=raster.sums.shape) * 0.01
    return raster, cams


def _moments(width: int, filled: bool) -> OptimizerState:
    rng = np.random.default_rng(7)
    m, v = rng.normal(size=(COUNT, width)) * 0.1, rng.uniform(0.0, 0.1, (COUNT, width))
    age = rng.integers(0, 6, COUNT) if filled else np.zeros(COUNT)
    flat = [np.zeros(COUNT, np.float32) for _ in range(3)]
    share = 1.0 if filled else 0.0
    return OptimizerState((share * m).astype(np.float32), (share * v).astype(np.float32), age.astype(np.int32), *flat)


def _adam_parameters(width: int, rate: float) -> AdamParameters:
    rates = rate * (1.0 + np.arange(width)) / width
    corrections = np.array([[9.0, 9.0, 9.0], [3.0, 2.5, 1.0], [2.0, 1.8, 0.9], [1.5, 1.2, 0.8]])
    return AdamParameters(rates.astype(np.float32), corrections.astype(np.float32), np.float32(EPSILON))


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_a_step_is_adams(sh_degree: int) -> None:
    params = random_params(COUNT, sh_degree, 3)
    raster, cams = _raster(params)
    width = params.shape[1]
    moments = _moments(width, filled=False)
    raster.step(cams, as_gaussians(params.copy()), moments, _adam_parameters(width, 0.0))
    g = (moments.m / np.float32(1.0 - BETA1)).astype(np.float64)  # from Adam's first moment after one step from 0
    seen = (raster.lists.own_count[:, :COUNT] > 0).any(axis=0)
    assert 0 < (~seen).sum() < COUNT // 2 and (np.abs(g[seen]).max(axis=1) > 0).all()
    moments, after = _moments(width, filled=True), params.copy()
    before = OptimizerState(*(np.array(array, np.float64) for array in moments))
    rule = _adam_parameters(width, 1e-3)
    assert raster.step(cams, as_gaussians(after), moments, rule) == 0

    m = BETA1 * before.m + (1.0 - BETA1) * g
    v = BETA2 * before.v + (1.0 - BETA2) * g * g
    first, second, calm = rule.corrections[np.minimum(before.age + 1, 3).astype(int)].T.astype(np.float64)
    rate = rule.rates * calm[:, None] * np.ones((COUNT, width))
    rate[:, :3] *= np.maximum(np.abs(params[:, :3]).max(axis=1), 1.0)[:, None]
    moved = rate * m * first[:, None] / (np.sqrt(v * second[:, None]) + EPSILON)
    np.testing.assert_allclose(moments.m[seen], m[seen], rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(moments.v[seen], v[seen], rtol=2e-5, atol=1e-9)
    np.testing.assert_allclose((params - after)[seen], moved[seen], rtol=1e-3, atol=2e-6)
    np.testing.assert_array_equal(moments.age[seen], before.age[seen] + 1)
    for array, was in ((after, params), (moments.m, before.m), (moments.v, before.v), (moments.age, before.age)):
        np.testing.assert_array_equal(array[~seen], was[~seen].astype(array.dtype))


@pytest.mark.parametrize(("column", "broken"), [(1, np.nan), (1, np.inf), (7, -np.inf)])
def test_what_is_not_finite_is_dropped_and_counted(column: int, broken: float) -> None:
    params = random_params(COUNT, seed=3)
    raster, cams = _raster(params)
    victim = int(np.flatnonzero(raster.lists.own_count[0, :COUNT] > 0)[40])
    rule, sound = _adam_parameters(BASE, 1e-3), params.copy()
    moments = _moments(BASE, filled=True)
    raster.step(cams, as_gaussians(sound), moments, rule)
    raster.sums[0, raster.lists.own_first[0, victim], column] = broken
    hurt, moments = params.copy(), _moments(BASE, filled=True)
    was = moments.m[victim].copy()
    lost = raster.step(cams, as_gaussians(hurt), moments, rule)
    assert 1 <= lost <= BASE and np.isfinite(hurt).all() and np.isfinite(moments.m).all()
    others = np.arange(COUNT) != victim
    np.testing.assert_array_equal(hurt[others], sound[others])
    dropped = hurt[victim] == params[victim]
    assert dropped.sum() >= lost  # neither the number nor its moment moves
    assert (moments.m[victim][dropped] == was[dropped]).sum() >= lost
    if column == 7:  # a color's sum reaches that color alone
        assert lost == 1 and dropped[COLOR + 1]


def test_parameters_are_kept_within_their_bounds() -> None:
    """In numbers: what lies within stays as it is to the last bit."""
    params = random_params(5, seed=3)
    params[:, OPACITY] = 8.0, -8.5, 50.0, -50.0, np.nan
    params[1, :3], params[2, SCALE:QUATERNION] = (500.0, -500.0, 1.0), 3.0
    params[3, SCALE:QUATERNION] = -1.0, -9.0, -1.0
    params[2, QUATERNION:OPACITY], params[3, COLOR] = 0.0, 7.0
    before = params.copy()
    clamp_gaussians(params)
    np.testing.assert_array_equal(params[0], before[0])
    np.testing.assert_array_equal(params[:, OPACITY], np.float32([8.0, -8.5, 9.0, -9.0, -9.0]))
    np.testing.assert_array_equal(params[1, :3], np.float32([100.0, -100.0, 1.0]))
    far = max(1.0, np.abs(before[2, :3]).max())
    np.testing.assert_allclose(params[2, SCALE:QUATERNION], np.log(0.5 * far), rtol=1e-5)
    assert np.ptp(params[3, SCALE:QUATERNION]) == pytest.approx(np.log(20.0), abs=1e-5)
    np.testing.assert_array_equal(params[2, QUATERNION:OPACITY], [1.0, 0.0, 0.0, 0.0])
    assert params[3, COLOR] == 1.5
